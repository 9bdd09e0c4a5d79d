"""The reduced form Q' (RWHEC paper eq. 48): translations and scales eliminated, rotations and h left.

x = [vec R of each frame, h], with h the homogenising entry. Q' is one dense matrix: for parts with few frames, and
for all that needs it as a matrix (small dual, relaxation). The search of larger parts follows the graph (`graph_form`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.block_matrix import BlockMatrix
from gtsam_rwhec.solver.rotations import tangent_curvature

#: With a unit diagonal, a smaller eigenvalue of the eliminated block is rounding error. The pseudo-inverse of eq. 48
#: leaves its direction out.
RANK_TOLERANCE = 1e-14
#: A variable with a smaller diagonal, relative to the largest, is absent. This is the square of the rounding of a zero,
#: and it is far below any ratio of weights.
ABSENT = 1e-26
#: A null direction moves a scale if the scale's component is larger than this fraction of the direction's length.
MOVES = 1e-6


@dataclass(frozen=True)
class ReducedForm:
    """Q' (9 n + 1, 9 n + 1), exactly symmetric, and the way back to translations and scales.

    The best [t, own scale] of each frame and alpha are -factor (G x), (4 n + 1,). ``null`` (4 n + 1, m): directions in
    these variables that no measurement determines, at any rotations.
    """

    Q: Array
    G: Array
    factor: Array
    null: Array

    @staticmethod
    def of(full: BlockMatrix) -> ReducedForm:
        """Eliminate translations and scales from Q, 13 numbers a frame and the tail [alpha, h]."""
        n, Q = len(full.frames), full.dense()
        at = 13 * np.arange(n)[:, None]
        inner = np.append(at + np.arange(4), 13 * n)
        outer = np.append(at + np.arange(4, 13), 13 * n + 1)
        factor, null = generalised_inverse_factor(Q[inner[:, None], inner])
        G = factor.T @ Q[inner[:, None], outer]
        reduced = Q[outer[:, None], outer] - G.T @ G
        return ReducedForm(0.5 * (reduced + reduced.T), G, factor, null)

    @staticmethod
    def of_rotations(Q: Array) -> ReducedForm:
        """A form that has no translations and no scales."""
        n = (len(Q) - 1) // 9
        return ReducedForm(Q, np.zeros((0, len(Q))), np.zeros((4 * n + 1, 0)), np.zeros((4 * n + 1, 0)))

    @property
    def rotations(self) -> int:
        """Number of free frames."""
        return (len(self.Q) - 1) // 9

    @property
    def size(self) -> int:
        """9 n + 1."""
        return len(self.Q)

    @cached_property
    def magnitude(self) -> float:
        """A scale for costs: the sum of the diagonal is about the cost of a grossly wrong answer."""
        return float(np.trace(self.Q) + (self.G**2).sum())

    @cached_property
    def _blocks(self) -> Array:
        """Q' without h as blocks (n, n, 9, 9)."""
        n = self.rotations
        return np.ascontiguousarray(self.Q[:-1, :-1].reshape(n, 9, n, 9).transpose(0, 2, 1, 3))

    def apply(self, x: Array) -> Array:
        """Q' x."""
        return self.Q @ x

    def recover(self, x: Array) -> tuple[Array, float]:
        """[t, own scale] of each frame (n, 4), and alpha, of the optimum given the rotations (eq. 47).

        Where the measurements leave a scale free, the pseudo-inverse may choose zero, which is not a valid scale. Then
        the scale becomes 1, and the translations follow at the same cost.
        """
        w = -self.factor @ (self.G @ x)
        scales = np.append(np.arange(3, len(w), 4), len(w) - 1)
        along = self.null[scales]
        is_open = (np.abs(along) > MOVES * np.linalg.norm(self.null, axis=0)).any(axis=1)
        if is_open.any():
            w += self.null @ np.linalg.lstsq(along[is_open], 1.0 - w[scales][is_open], rcond=1e-9)[0]
        is_absent = ~(self.factor[scales].any(axis=1) | along.any(axis=1))
        w[scales[is_absent]] = 1.0  # nothing depends on it
        return w[:-1].reshape(-1, 4), float(w[-1])

    def newton(self, R: Array, basis: Array, q: Array) -> Callable[[Array, float], Array | None]:
        """Newton's step (n, 3) as a function of half the gradient (n, 3) and of a damping.

        At R (n, 3, 3), with its tangents' basis (n, 9, 3) and q = Q' x. The step is None where the Hessian is not
        positive definite.
        """
        n = self.rotations
        blocks = basis.transpose(0, 2, 1)[:, None] @ self._blocks @ basis
        blocks[np.arange(n), np.arange(n)] += tangent_curvature(R, q)
        hessian = blocks.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)

        def step(gradient: Array, damping: float) -> Array | None:
            damped = hessian + damping * np.eye(3 * n) if damping else hessian
            lower, failed = scipy.linalg.lapack.dpotrf(damped, lower=1)
            if failed or not np.isfinite(np.diagonal(lower)).all():
                return None
            solved: Array = scipy.linalg.lapack.dpotrs(lower, gradient.ravel(), lower=1)[0]
            return -solved.reshape(n, 3)

        return step

    def solver(self, shift: float) -> Callable[[Array], Array] | None:
        """Solve with Q' + shift I, without h, for vectors (9 n,); None where it is not positive definite."""
        lower, failed = scipy.linalg.lapack.dpotrf(self.Q[:-1, :-1] + shift * np.eye(self.size - 1), lower=1)
        if failed:
            return None
        return lambda right: np.asarray(scipy.linalg.lapack.dpotrs(lower, right, lower=1)[0])

    def smallest_eigenpair(self, Lambda: Array) -> tuple[float, Array]:
        """The smallest eigenvalue of Q' - Lambda without h, and its vector (9 n,); Lambda (n, 9, 9)."""
        M = self.Q[:-1, :-1].copy()
        n = self.rotations
        np.einsum("iaib->iab", M.reshape(n, 9, n, 9))[...] -= Lambda
        values, vectors = scipy.linalg.eigh(M, subset_by_index=[0, 0], check_finite=False)
        return float(values[0]), vectors[:, 0]


def generalised_inverse_factor(M: Array) -> tuple[Array, Array]:
    """F (m, k), where F F' is a generalised inverse of a positive semidefinite M (m, m), and M's null vectors (m, l).

    Rows and columns are scaled to a unit diagonal first, so that metres and scales compare. Variables that the problem
    does not have (zero diagonal) are in neither.
    """
    diagonal = np.diagonal(M)
    used = np.flatnonzero(diagonal > ABSENT * diagonal.max(initial=0.0))
    if not len(used):
        return np.zeros((len(M), 0)), np.zeros((len(M), 0))
    unit = 1.0 / np.sqrt(diagonal[used])
    scaled = M[used[:, None], used] * unit[:, None] * unit
    np.fill_diagonal(scaled, 1.0)
    least = RANK_TOLERANCE * len(M)
    lower, failed = scipy.linalg.lapack.dpotrf(scaled, lower=1, clean=1)
    if not failed and (np.diagonal(lower) ** 2).min(initial=1.0) > least:
        root, null = scipy.linalg.lapack.dtrtri(lower, lower=1)[0].T, np.zeros((len(used), 0))
    else:
        values, vectors = np.linalg.eigh(scaled)
        keep = values > least
        root, null = vectors[:, keep] / np.sqrt(values[keep]), vectors[:, ~keep]
    result = np.zeros((len(M), root.shape[1])), np.zeros((len(M), null.shape[1]))
    for out, columns in zip(result, (root, null), strict=True):
        out[used] = columns * unit[:, None]
    return result
