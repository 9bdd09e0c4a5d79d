"""The DQ paper's cost (eq. 8) of motions: as a quadratic form, and as sums of their own squared residuals."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.handeye.cost import DualQuaternionCost, E, blocks, motion_moments, residuals
from gtsam_rwhec.handeye.motions import Motions
from gtsam_rwhec.handeye.weights import check_alpha, check_covariances, check_one_kind, check_weights


def covariance_cost(motions: Motions, covariances: Array) -> DualQuaternionCost:
    """The cost with a covariance (N or 1, 8, 8) of (A q, B q + A q') inside the norm (Section 3.1), without alpha."""
    total = np.zeros((8, 8))
    for block in blocks(len(motions), matrices=8):
        rows = motions.rows[:, block]
        J = np.zeros((rows.shape[1], 8, 8))
        J[:, :4, :4] = J[:, 4:, 4:] = np.einsum("kn,kij->nij", rows[:7], E)
        J[:, 4:, :4] = np.einsum("kn,kij->nij", rows[7:], E)
        information = np.linalg.inv(covariances if len(covariances) == 1 else covariances[block])
        total += np.einsum("nji,njk->ik", J, information @ J)
    total = 0.5 * (total + total.T)
    return DualQuaternionCost(total[:4, :4], total[4:, 4:], total[:4, 4:], len(motions))


def cost_of(
    motions: Motions, alpha: float = 1.0, weights: ArrayLike | None = None, covariances: ArrayLike | None = None
) -> DualQuaternionCost:
    """The cost (8) of motions.

    Parameters
    ----------
    motions : Motions
    alpha : float
        Positive, 1/m; not used with ``covariances``.
    weights : (N,) array, optional
        Factor of each motion's terms.
    covariances : (N, 8, 8) or (8, 8) array, optional
        Of the residuals (A q, B q + A q'), in place of alpha and weights.

    Raises
    ------
    OptionError, CountError, NoiseError
        For an alpha, weights or covariances that cannot be used.
    """
    check_one_kind(weights, covariances)
    w, checked = check_weights(weights, len(motions)), check_covariances(covariances, len(motions))
    if checked is not None:
        return covariance_cost(motions, checked)
    return motion_moments(motions.rows, w).cost(check_alpha(alpha))


def squared_residuals(motions: Motions, q: Array, q_dual: Array, weights: Array | None = None) -> tuple[float, float]:
    """The weighted sums of |A q|^2 and |B q + A q'|^2 over the motions. As sums of squares, they lose no digits."""
    by_row = np.zeros(8)
    for block in blocks(len(motions)):
        squares = residuals(motions.rows[:, block], q, q_dual) ** 2
        by_row += squares.sum(axis=1) if weights is None else squares @ weights[block]
    return float(by_row[:4].sum()), float(by_row[4:].sum())


def squared_mahalanobis(motions: Motions, q: Array, q_dual: Array, covariances: Array) -> float:
    """The sum of e' covariance^-1 e over the motions, with e their residuals (8,)."""
    e = residuals(motions.rows, q, q_dual).T
    whitened = np.linalg.solve(covariances, e[:, :, None])[:, :, 0]
    return float((e * whitened).sum())
