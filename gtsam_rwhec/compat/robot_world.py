"""Shah 2013 and Li, Wang & Wu 2010: A X = Z B by Kronecker products, in one pass over the poses."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.compat.andreff import nearest_rotation
from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.poses import Array

RobotWorld = tuple[Array, Array, Array, Array]


def shah(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> RobotWorld:
    """Shah 2013: rotations from the largest singular pair of the sum of R_B (x) R_A, translations by least squares.

    Returns
    -------
    R_X, t_X, R_Z, t_Z of A X = Z B.
    """
    count = len(R_A)
    products = (R_B.reshape(count, 9).T @ R_A.reshape(count, 9)).reshape(3, 3, 3, 3)
    U, _, Vt = np.linalg.svd(products.transpose(0, 2, 1, 3).reshape(9, 9))  # R_A R_X R_B' = R_Z, vec by columns
    R_X = _rotation_of_vec(Vt[0].reshape(3, 3).T)
    R_Z = _rotation_of_vec(U[:, 0].reshape(3, 3).T)
    # Least squares of t_Z - R_A t_X = t_A - R_Z t_B: 2 x 2 blocks, with t_Z eliminated.
    turned = t_A - t_B @ R_Z.T
    S, mean = R_A.mean(axis=0), turned.mean(axis=0)
    away = np.tensordot(turned, R_A, axes=([0, 1], [0, 1])) / count  # mean of R_A' (t_A - R_Z t_B)
    t_X = np.linalg.solve(np.eye(3) - S.T @ S, S.T @ mean - away)
    return R_X, t_X, R_Z, mean + S @ t_X


def li(R_A: Array, t_A: Array, R_B: Array, t_B: Array) -> RobotWorld:
    """Li, Wang & Wu 2010 (Kronecker form): both rotations and translations by one linear least squares.

    (R_A (x) I) vec(R_X) - (I (x) R_B') vec(R_Z) = 0 and (I (x) t_B') vec(R_Z) - R_A t_X + t_Z = t_A, vec by rows.
    Rotations are then the nearest ones; the translations stay those of the linear system, as observed of OpenCV 4.

    Returns
    -------
    R_X, t_X, R_Z, t_Z of A X = Z B.
    """
    count = len(R_A)
    flat_A = R_A.reshape(count, 9)
    # vec(R_X) is eliminated: R_A, an orthogonal factor, leaves count I in its own block.
    products = (flat_A.T @ R_B.reshape(count, 9)).reshape(3, 3, 3, 3)
    K = products.transpose(1, 3, 0, 2).reshape(9, 9)  # R_X = 1/count sum of R_A' R_Z R_B
    A_t = (flat_A.T @ t_B).reshape(3, 3, 3)  # [r, c, b] = sum R_A[r, c] t_B[b]
    sum_A, sum_t = R_A.sum(axis=0), t_B.sum(axis=0)
    normal = np.zeros((15, 15))  # vec(R_Z), t_X, t_Z
    normal[:9, :9] = count * np.eye(9) - K.T @ K / count + np.kron(np.eye(3), t_B.T @ t_B)
    normal[:9, 9:12] = -A_t.transpose(0, 2, 1).reshape(9, 3)
    normal[:9, 12:] = np.kron(np.eye(3), sum_t[:, None])
    normal[9:12, 9:12] = normal[12:, 12:] = count * np.eye(3)
    normal[9:12, 12:] = -sum_A.T
    normal[9:, :9] = normal[:9, 9:].T
    normal[12:, 9:12] = normal[9:12, 12:].T
    right = np.concatenate([(t_A.T @ t_B).reshape(9), -np.tensordot(t_A, R_A, axes=([0, 1], [0, 1])), t_A.sum(axis=0)])
    scale = 1.0 / np.sqrt(np.diag(normal))
    z = scale * np.linalg.solve(normal * scale * scale[:, None], right * scale)
    R_X = K @ z[:9]
    return nearest_rotation(R_X.reshape(3, 3)), z[9:12], nearest_rotation(z[:9].reshape(3, 3)), z[12:]


def _rotation_of_vec(V: Array) -> Array:
    """The rotation of a singular vector's matrix, which has either sign."""
    determinant = np.linalg.det(V)
    if abs(determinant) < 1e-12:
        raise UnderdeterminedError(
            "the largest singular pair of the sum of R_B (x) R_A is that of no rotation; add poses that turn about two "
            "different axes"
        )
    return nearest_rotation(V * np.sign(determinant))
