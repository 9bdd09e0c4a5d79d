"""Exact arithmetic: doubles are fractions, and rational quaternions rotate exactly."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from exact_cost import fractions

from gtsam_rwhec.geometry.poses import Array


def rotation(q: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) of a rational quaternion (w, x, y, z) of any length, exactly."""
    w, x, y, z = (Fraction(value) for value in q)
    R = np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ],
        dtype=object,
    )
    return R / (w * w + x * x + y * y + z * z)


def rational_quaternion(R: Array) -> np.ndarray:
    """A rational quaternion (4,) next to a rotation (3, 3)."""
    K = np.empty((4, 4))  # its leading eigenvector is the quaternion (Bar-Itzhack 2000)
    K[0] = np.trace(R), R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    K[1:, 0] = K[0, 1:]
    K[1:, 1:] = R + R.T - np.trace(R) * np.eye(3)
    return fractions(np.linalg.eigh(K)[1][:, -1])


def homogeneous(R: list[np.ndarray]) -> np.ndarray:
    """x = [vec R_1, ..., vec R_n, 1] of rational rotations."""
    return np.concatenate([*(each.T.ravel() for each in R), np.array([Fraction(1)], dtype=object)])


def basis_of(R: np.ndarray) -> np.ndarray:
    """(9, 3) tangents of a rational rotation, as ``rotations.tangent_basis`` has them."""
    zero = np.zeros(3, dtype=object)
    c0, c1, c2 = R[:, 0], R[:, 1], R[:, 2]
    return np.stack(
        [np.concatenate([zero, c2, -c1]), np.concatenate([-c2, zero, c0]), np.concatenate([c1, -c0, zero])], axis=1
    )


def is_positive_definite(matrix: np.ndarray) -> bool:
    """Whether a symmetric matrix of fractions is positive definite: the pivots of its LDL' factorisation, exactly."""
    A = matrix.copy()
    for k in range(len(A)):
        if A[k, k] <= 0:
            return False
        column = A[k + 1 :, k] / A[k, k]
        A[k + 1 :, k + 1 :] -= np.outer(column, A[k, k + 1 :])
    return True


def rank(matrix: np.ndarray) -> int:
    """The rank of a matrix of fractions, by elimination."""
    A = matrix.copy()
    found = 0
    for column in range(A.shape[1]):
        pivots = np.flatnonzero(A[found:, column])
        if not len(pivots):
            continue
        A[[found, found + pivots[0]]] = A[[found + pivots[0], found]]
        below = A[found + 1 :, column] / A[found, column]
        A[found + 1 :] -= np.outer(below, A[found])
        found += 1
        if found == len(A):
            break
    return found
