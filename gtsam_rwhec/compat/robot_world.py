"""Shah 2013 and Li, Wang & Wu 2010: A X = Z B by Kronecker products, from one matrix of moments of the poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gtsam_rwhec.compat.andreff import LENGTH_UNKNOWN, SINGULAR
from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.normal_equations import solve_scaled
from gtsam_rwhec.solver.rotations import project

RobotWorld = tuple[Array, Array, Array, Array]


class PoseMeans(NamedTuple):
    """Means over the poses of products of (R_A, t_A, 1) and (R_B, t_A, t_B, 1).

    Entry [a, b, c, d] of R_A_R_B is the mean of R_A[a, b] R_B[c, d], entry [a, b, c] of R_A_t_A that of
    R_A[a, b] t_A[c].
    """

    R_A_R_B: Array
    R_A_t_A: Array
    R_A_t_B: Array
    t_A_t_B: Array
    t_B_t_B: Array
    R_A: Array
    t_A: Array
    t_B: Array


def pose_means(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> PoseMeans:
    """Compute the means by one matrix product."""
    count = len(R_A)
    F = np.empty((count, 25))
    F[:, :9], F[:, 9:12], F[:, 12:15] = R_A.reshape(count, 9), t_A, t_B
    F[:, 15], F[:, 16:] = 1.0, R_B.reshape(count, 9)
    G = (F[:, :16].T @ F) / count
    of_R_A = G[:9].reshape(3, 3, 25)
    return PoseMeans(
        R_A_R_B=of_R_A[:, :, 16:].reshape(3, 3, 3, 3),
        R_A_t_A=of_R_A[:, :, 9:12],
        R_A_t_B=of_R_A[:, :, 12:15],
        t_A_t_B=G[9:12, 12:15],
        t_B_t_B=G[12:15, 12:15],
        R_A=of_R_A[:, :, 15],
        t_A=G[9:12, 15],
        t_B=G[12:15, 15],
    )


def shah(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> RobotWorld:
    """R_X, t_X, R_Z, t_Z of A X = Z B by Shah 2013.

    Rotations are the largest singular pair of the sum of R_B (x) R_A; translations are found by least squares.
    """
    m = pose_means(R_A, t_A, R_B, t_B)
    U, _, Vt = np.linalg.svd(m.R_A_R_B.transpose(2, 0, 3, 1).reshape(9, 9))  # R_A R_X R_B' = R_Z, vec by columns
    R_X, R_Z = _rotations_of_vec(np.array([Vt[0], U[:, 0]]))
    # Least squares of t_Z - R_A t_X = t_A - R_Z t_B =: d, t_Z = mean d + mean R_A t_X eliminated.
    mean = m.t_A - R_Z @ m.t_B
    turned = np.einsum("aba->b", m.R_A_t_A) - np.einsum("ac,abc->b", R_Z, m.R_A_t_B)  # mean of R_A' d
    t_X = np.linalg.solve(np.eye(3) - m.R_A.T @ m.R_A, m.R_A.T @ mean - turned)
    return R_X, t_X, R_Z, mean + m.R_A @ t_X


def li(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> RobotWorld:
    """R_X, t_X, R_Z, t_Z of A X = Z B by Li, Wang & Wu 2010 (Kronecker form): one linear least squares for all.

    (R_A (x) I) vec(R_X) - (I (x) R_B') vec(R_Z) = 0 and (I (x) t_B') vec(R_Z) - R_A t_X + t_Z = t_A, vec by rows.
    The nearest rotations follow. The translations stay as in the linear system, as observed of OpenCV 4. Raises
    UnderdeterminedError when the translations do not determine the rotations' length.
    """
    m = pose_means(R_A, t_A, R_B, t_B)
    # vec(R_X) is eliminated: its block is the identity, since R_A is orthogonal, and R_X = mean of R_A' R_Z R_B.
    K = m.R_A_R_B.transpose(1, 3, 0, 2).reshape(9, 9)
    normal = np.zeros((15, 15))  # vec(R_Z), t_X, t_Z
    normal[:9, :9] = np.eye(9) - K.T @ K
    of_R_Z = normal[:9].reshape(3, 3, 15)
    for row in range(3):
        of_R_Z[row, :, 3 * row : 3 * row + 3] += m.t_B_t_B
        of_R_Z[row, :, 12 + row] = m.t_B
    of_R_Z[:, :, 9:12] = -m.R_A_t_B.transpose(0, 2, 1)
    normal[9:12, 12:] = -m.R_A.T
    normal[range(9, 15), range(9, 15)] = 1.0
    right = np.concatenate([m.t_A_t_B.ravel(), -np.einsum("aba->b", m.R_A_t_A), m.t_A])
    normal = np.triu(normal) + np.triu(normal, 1).T
    z = solve_scaled(normal, right, LENGTH_UNKNOWN.format("Li's"), SINGULAR)
    R_X, R_Z = project(np.stack([K @ z[:9], z[:9]]).reshape(2, 3, 3))
    return R_X, z[9:12], R_Z, z[12:]


def _rotations_of_vec(vectors: Array) -> Array:
    """The rotations (2, 3, 3) of singular vectors (2, 9), which are multiples, of either sign, of rotations."""
    U, s, Wt = np.linalg.svd(vectors.reshape(2, 3, 3).transpose(0, 2, 1))
    if s.min() < 1e-6:
        raise UnderdeterminedError(
            "the largest singular pair of the sum of R_B (x) R_A is not a pair of rotations; add poses that turn about "
            "two different axes"
        )
    R: Array = U @ Wt
    for rotation, ((a, b, c), (d, e, f), (g, h, i)) in zip(R, R.tolist(), strict=True):
        if a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0.0:
            rotation *= -1.0
    return R
