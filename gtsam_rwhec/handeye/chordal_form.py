"""The costs of eq. 30: as quadratic forms of a rotation's entries and a translation, and of one pose."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.handeye.cost import blocks
from gtsam_rwhec.handeye.motions import Motions


def chordal_moments(motions: Motions, weights: Array | None = None) -> tuple[Array, Array]:
    """The two forms of eq. 30, summed over the motions in one pass.

    Rotation (9, 9): |R_C R - R R_H|^2 as a form of vec R. Here vec takes rows: R_C (x) I - I (x) R_H'. Translation
    (13, 13): |(R_C - 1) T - R T_H + T_C|^2 as a form of (vec R, T, 1).
    """
    rotation, translation = np.zeros((9, 9)), np.zeros((13, 13))
    for block in blocks(len(motions)):
        C, H = motions.C[block], motions.H[block]
        w = np.ones(len(C)) if weights is None else weights[block]
        # (R_C (x) I - I (x) R_H')'(...) = 2 I - R_C' (x) R_H' - R_C (x) R_H. Entry (i, j), (k, l) of R_C (x) R_H is
        # R_C[i, k] R_H[j, l].
        K = np.einsum("n,nik,njl->ijkl", w, C[:, :3, :3], H[:, :3, :3], optimize=True).reshape(9, 9)
        rotation += 2.0 * w.sum() * np.eye(9) - K - K.T
        # Row r of the residual is -t_H . R[r] + (R_C - 1)[r] . T + t_C[r]: seven numbers f_r times the unknowns.
        f = np.empty((len(C), 3, 7))
        f[:, :, :3] = -H[:, None, :3, 3]
        f[:, :, 3:] = C[:, :3] - np.eye(3, 4)
        for r in range(3):
            used = [3 * r, 3 * r + 1, 3 * r + 2, 9, 10, 11, 12]
            translation[np.ix_(used, used)] += (f[:, r] * w[:, None]).T @ f[:, r]
    return rotation, translation


def chordal_residuals(motions: Motions, X: Array, weights: Array | None = None) -> tuple[float, float]:
    """The sums of |R_C R - R R_H|^2 and |(R_C - 1) T - R T_H + T_C|^2 of a pose (4, 4), from the motions' residuals."""
    by_column = np.zeros(4)  # three of the rotation, one of the translation
    for block in blocks(len(motions)):
        E = motions.C[block] @ X - X @ motions.H[block]
        squares = (E[:, :3] ** 2).sum(axis=1)
        by_column += squares.sum(axis=0) if weights is None else weights[block] @ squares
    return float(by_column[:3].sum()), float(by_column[3])
