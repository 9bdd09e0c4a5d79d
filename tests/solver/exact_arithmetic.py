"""The stored quadratic form in exact arithmetic: doubles are fractions, and rational quaternions rotate exactly."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import tangent_basis, unvec

#: Rational quaternions are rounded to this.
GRID = 2**120


def fractions(array: Array) -> np.ndarray:
    """An array of doubles as fractions, exactly."""
    flat = [Fraction(float(value)) for value in np.ravel(array)]
    result = np.empty(len(flat), dtype=object)
    result[:] = flat
    return result.reshape(np.shape(array))


def stored_matrix(form: ReducedForm) -> np.ndarray:
    """Q' as it is stored, as fractions (9 n + 1 square)."""
    return fractions(form.Q)


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
    q = fractions(np.linalg.eigh(K)[1][:, -1])
    return q


def homogeneous(R: list[np.ndarray]) -> np.ndarray:
    """x = [vec R_1, ..., vec R_n, 1] of rational rotations."""
    return np.concatenate([*(each.T.ravel() for each in R), np.array([Fraction(1)], dtype=object)])


def cost(Q: np.ndarray, quaternions: list[np.ndarray]) -> Fraction:
    """x' Q x at exact rotations."""
    x = homogeneous([rotation(q) for q in quaternions])
    return x @ (Q @ x)


def random_quaternions(count: int, generator: np.random.Generator) -> list[np.ndarray]:
    """Rational quaternions, for feasible points anywhere."""
    return [fractions(q) for q in generator.standard_normal((count, 4))]


def lowest_cost(form: ReducedForm, R: Array, steps: int = 4) -> Fraction:
    """The cost at the bottom of the valley that R (n, 3, 3) is in, to some 40 digits: Newton with exact gradients."""
    Q, n = stored_matrix(form), len(R)
    rounded = form.Q[:-1, :-1]
    quaternions = [rational_quaternion(each) for each in R]
    best = cost(Q, quaternions)
    for _ in range(steps):
        exact = [rotation(q) for q in quaternions]
        gradient = (Q @ homogeneous(exact))[:-1]
        near = np.array([each.astype(float) for each in exact])
        basis = [basis_of(each) for each in exact]
        g = np.array([b.T @ gradient[9 * i : 9 * i + 9] for i, b in enumerate(basis)], dtype=float).ravel()
        step = -np.linalg.pinv(_hessian(rounded, near, gradient.astype(float)), rcond=1e-13, hermitian=True) @ g
        quaternions = [_turned(q, w) for q, w in zip(quaternions, step.reshape(n, 3), strict=True)]
        best = min(best, cost(Q, quaternions))
    return best


def basis_of(R: np.ndarray) -> np.ndarray:
    """(9, 3) tangents of a rational rotation, as ``rotations.tangent_basis`` has them."""
    zero = np.zeros(3, dtype=object)
    c0, c1, c2 = R[:, 0], R[:, 1], R[:, 2]
    return np.stack(
        [np.concatenate([zero, c2, -c1]), np.concatenate([-c2, zero, c0]), np.concatenate([c1, -c0, zero])], axis=1
    )


def _hessian(Q: Array, R: Array, gradient: Array) -> Array:
    """Half the Riemannian Hessian (3 n, 3 n), dense."""
    n = len(R)
    M = unvec(gradient).transpose(0, 2, 1) @ R
    basis = np.zeros((9 * n, 3 * n))
    curvature = np.zeros((3 * n, 3 * n))
    for i, each in enumerate(tangent_basis(R)):
        at = slice(3 * i, 3 * i + 3)
        basis[9 * i : 9 * i + 9, at] = each
        curvature[at, at] = 0.5 * (M[i] + M[i].T) - np.trace(M[i]) * np.eye(3)
    return basis.T @ Q @ basis + curvature


def _turned(q: np.ndarray, w: Array) -> np.ndarray:
    """q times (1, w / 2), rounded to the grid."""
    a, (b, c, d) = Fraction(1), (Fraction(float(value)) / 2 for value in w)
    p, x, y, z = q
    product = [
        p * a - x * b - y * c - z * d,
        p * b + x * a + y * d - z * c,
        p * c - x * d + y * a + z * b,
        p * d + x * c - y * b + z * a,
    ]
    result = np.empty(4, dtype=object)
    result[:] = [Fraction(round(value * GRID), GRID) for value in product]
    return result


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
