"""Residuals of an answer in the physical model, pair by pair, from moments.

For the direct form and the inverse form alike, the residuals are R_A t_X + t_A - t_Y - R_Y t_B / alpha and the
difference of R_A R_X and R_Y R_B (eq. 18).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.variables import Answer, scales_of


@dataclass(frozen=True, slots=True)
class Residual:
    """Root mean squares of a pair's residuals, weighted as in the cost.

    Attributes
    ----------
    number_of_measurements : int
    translation_rms_m : float
        Of |R_A t_X + t_A - t_Y - R_Y t_B / scale|, in true metres.
    rotation_rms_rad : float
        Of the angle between R_A R_X and R_Y R_B, in rad.
    """

    number_of_measurements: int
    translation_rms_m: float
    rotation_rms_rad: float


@dataclass(frozen=True)
class PairPoses:
    """An answer, pair by pair: R_X, R_Y (E, 3, 3), t_X, t_Y (E, 3) about the gauge, scale alpha (E,)."""

    R_X: Array
    t_X: Array
    R_Y: Array
    t_Y: Array
    alpha: Array

    @staticmethod
    def of(part: Part, answer: Answer) -> PairPoses:
        """Free frames from the answer, fixed ones from the part."""
        fixed = np.array(list(part.fixed.values())).reshape(-1, 4, 4)
        R, t = np.concatenate([answer.R, fixed[:, :3, :3]]), np.concatenate([answer.t, fixed[:, :3, 3]])
        target, sensor = part.ends.T
        alphas = scales_of(part, answer)
        return PairPoses(R[target], t[target], R[sensor], t[sensor], np.array([alphas[name] for name, _ in part.pairs]))


def costs_of_pairs(part: Part, poses: PairPoses) -> tuple[Array, Array]:
    """J_t and J_R of each pair (E,), eq. 18."""
    E, moments = len(part.pairs), part.moments
    J_t, J_R = np.empty(E), np.empty(E)
    for at in moments.blocks():
        G = moments.fronts(at)
        R_X, R_Y, alpha = poses.R_X[at], poses.R_Y[at], poses.alpha[at, None]
        k = len(G)
        # The residual alpha (R_A t_X + t_A - t_Y) - R_Y t_B is linear in the features [vec R_A, t_A, t_B, 1].
        linear = np.zeros((k, 3, 16))
        linear[:, :, :9] = np.einsum("ej,ik->eijk", alpha * poses.t_X[at], np.eye(3)).reshape(k, 3, 9)
        linear[:, :, 9:12] = alpha[:, :, None] * np.eye(3)
        linear[:, :, 12:15] = -R_Y
        linear[:, :, 15] = -alpha * poses.t_Y[at]
        J_t[at] = 0.5 * ((linear @ G) * linear).sum(axis=(1, 2))
        # |R_A R_X|^2 + |R_Y R_B|^2 - 2 <R_A R_X, R_Y R_B>, with sum kappa R_A[k, i] R_B[q, p] at [i, k, p, q].
        squares = moments.kappa[at] * ((R_X**2).sum(axis=(1, 2)) + (R_Y**2).sum(axis=(1, 2)))
        cross = moments.rotation[at].reshape(k, 3, 3, 3, 3)
        J_R[at] = 0.5 * squares - np.einsum("ekp,ekp->e", np.einsum("eikpq,eip->ekq", cross, R_X), R_Y)
    return np.maximum(J_t, 0.0), np.maximum(J_R, 0.0)  # zero may round to a negative number


def residuals_of_pairs(part: Part, poses: PairPoses, J_t: Array, J_R: Array) -> dict[Pair, Residual]:
    """Costs as root mean squares in metres and radians."""
    rms = np.sqrt(2.0 * J_t / part.moments.weight) / np.abs(poses.alpha)
    chord = np.sqrt(2.0 * J_R / part.moments.kappa)  # |R_A R_X - R_Y R_B|_F = sqrt(8) sin(angle / 2)
    angle = 2.0 * np.arcsin(np.minimum(1.0, chord / np.sqrt(8.0)))
    found = map(Residual, part.moments.count.tolist(), rms.tolist(), angle.tolist())
    return dict(zip(part.pairs, found, strict=True))
