"""The reduced form Q' of a part with many frames. It is never formed as a matrix: products use the full form's graph.

Q' x = Q_rr x - Q_rt Q_tt^-1 Q_tr x, with t the translations and scales. Where eliminating the translations would
couple every frame with every other, Q_tt itself has no more couplings than there are pairs. So products with Q' solve
with the factor of Q_tt (`block_matrix`), and Newton's step in the rotations is that of the form in rotations' tangents,
translations and scales together, whose Schur complement it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.block_matrix import BlockFactor, BlockMatrix
from gtsam_rwhec.solver.reduced_form import ABSENT, RANK_TOLERANCE
from gtsam_rwhec.solver.rotations import tangent_curvature

#: Where a pivot of the eliminated block is only rounding error, a direction is free. Then this fraction of the diagonal
#: is added; it changes costs by its square.
DAMPING = 1e-11
#: Lanczos steps for an estimate of the smallest eigenvalue, which the search for a bound corrects later.
LANCZOS_STEPS = 80


@dataclass(frozen=True)
class GraphForm:
    """Q' as a product; ``full`` is Q over 13 numbers a frame and the tail [alpha, h]."""

    full: BlockMatrix
    translations: BlockFactor
    #: (4 n + 1,): what was added to the diagonal of Q_tt before it was factored.
    added: Array
    #: (4 n + 1,): the part of it that pulls scales to 1 where the measurements may leave them free.
    pull: Array

    @staticmethod
    def of(full: BlockMatrix) -> GraphForm | None:
        """The form that follows a graph; None where Q_tt has no factor.

        Free translations stay near the gauge's origin, and free scales near 1. Scales that the problem does not have
        are 1.
        """
        frames, n = full.frames, len(full.frames)
        tt = BlockMatrix(
            full.order, frames[:, :4, :4], full.couplings[:, :4, :4], full.tails[:, :4, :1], full.tail[:1, :1]
        )
        diagonal = tt.diagonal
        absent = diagonal <= ABSENT * diagonal.max(initial=0.0)
        is_scale = np.append(np.tile([False, False, False, True], n), True)
        for damping in (0.0, DAMPING):
            added = np.where(absent, 1.0, damping * diagonal)
            factor = tt.plus(added).factor()
            if damping or (factor is not None and (factor.pivots**2 > RANK_TOLERANCE * (diagonal + added)).all()):
                break
        return None if factor is None else GraphForm(full, factor, added, np.where(is_scale, added, 0.0))

    @property
    def rotations(self) -> int:
        """Number of free frames."""
        return len(self.full.frames)

    @property
    def size(self) -> int:
        """9 n + 1."""
        return 9 * self.rotations + 1

    @cached_property
    def magnitude(self) -> float:
        """A scale for costs: the sum of the diagonal is about the cost of a grossly wrong answer."""
        return float(np.einsum("nii->", self.full.frames[:, 4:, 4:]) + self.full.tail[1, 1])

    def apply(self, x: Array) -> Array:
        """Q' x."""
        return self._solved(x)[1]

    def recover(self, x: Array) -> tuple[Array, float]:
        """[t, own scale] of each frame (n, 4), and alpha, of the optimum given the rotations (eq. 47)."""
        w = self._solved(x)[0]
        return w[:-1].reshape(-1, 4), float(w[-1])

    def _solved(self, x: Array) -> tuple[Array, Array]:
        """The best translations and scales (4 n + 1,) for x, and Q' x."""
        n = self.rotations
        numbers = np.zeros((n, 13))
        numbers[:, 4:] = x[:-1].reshape(n, 9)
        product = self.full.times(np.r_[numbers.ravel(), 0.0, x[-1]])
        by_frame = product[:-2].reshape(n, 13)
        right = np.append(by_frame[:, :4].ravel(), product[-2]) - x[-1] * self.pull
        w = -self.translations.solve_vector(right)
        numbers[:, 4:] = 0.0
        numbers[:, :4] = w[:-1].reshape(n, 4)
        rest = self.full.times(np.r_[numbers.ravel(), w[-1], 0.0])
        by_frame = by_frame + rest[:-2].reshape(n, 13)
        return w, np.append(by_frame[:, 4:].ravel(), product[-1] + rest[-1])

    def _without_h(self, of_rotations: float = 0.0) -> BlockMatrix:
        """Q over the frames' numbers and alpha, plus diagonals: one makes Q_tt definite, one is for the rotations."""
        n = self.rotations
        matrix = replace(self.full, tails=self.full.tails[:, :, :1], tail=self.full.tail[:1, :1])
        added = np.full((n, 13), of_rotations)
        added[:, :4] = self.added[:-1].reshape(n, 4)
        return matrix.plus(np.append(added.ravel(), self.added[-1]))

    def newton(self, R: Array, basis: Array, q: Array) -> Callable[[Array, float], Array | None]:
        """Newton's step, as that of `ReducedForm`: over [t, own scale, tangent] (7) of each frame, and alpha."""
        n = self.rotations
        T = np.zeros((n, 13, 7))
        T[:, :4, :4] = np.eye(4)
        T[:, 4:, 4:] = basis
        joint = self._without_h().congruent(T)
        joint.frames[:, 4:, 4:] += tangent_curvature(R, q)

        def step(gradient: Array, damping: float) -> Array | None:
            damped = np.append(np.tile(np.repeat([0.0, damping], [4, 3]), n), 0.0)
            factor = (joint.plus(damped) if damping else joint).factor()
            if factor is None:
                return None
            right = np.zeros((n, 7))
            right[:, 4:] = gradient
            return -factor.solve_vector(np.append(right.ravel(), 0.0))[:-1].reshape(n, 7)[:, 4:]

        return step

    def solver(self, shift: float) -> Callable[[Array], Array] | None:
        """Solve with Q' + shift I, without h, for vectors (9 n,); None where it is not positive definite."""
        n, factor = self.rotations, self._without_h(shift).factor()
        if factor is None:
            return None

        def solved(right: Array) -> Array:
            numbers = np.zeros((n, 13))
            numbers[:, 4:] = right.reshape(n, 9)
            return factor.solve_vector(np.append(numbers.ravel(), 0.0))[:-1].reshape(n, 13)[:, 4:].ravel()

        return solved

    def smallest_eigenpair(self, Lambda: Array) -> tuple[float, Array]:
        """The smallest eigenvalue of Q' - Lambda without h, and its vector (9 n,): a close estimate from above.

        Lambda (n, 9, 9). By Lanczos' method with full orthogonalisation.
        """
        n = self.rotations
        size = 9 * n
        steps = min(LANCZOS_STEPS, size)
        basis = np.zeros((steps, size))
        diagonal, beside = np.zeros(steps), np.zeros(steps)
        v = np.random.default_rng(0).standard_normal(size)
        v /= np.linalg.norm(v)
        for k in range(steps):
            basis[k] = v
            product = self.apply(np.append(v, 0.0))[:-1] - np.matmul(Lambda, v.reshape(n, 9, 1)).ravel()
            diagonal[k] = float(v @ product)
            for _ in range(2):  # twice is enough (Parlett 1998, section 6.9)
                product -= basis[: k + 1].T @ (basis[: k + 1] @ product)
            beside[k] = float(np.linalg.norm(product))
            if beside[k] <= 1e-12 * self.magnitude:
                steps = k + 1
                break
            v = product / beside[k]
        values, vectors = scipy.linalg.eigh_tridiagonal(
            diagonal[:steps], beside[: steps - 1], select="i", select_range=(0, 0)
        )
        vector: Array = basis[:steps].T @ vectors[:, 0]
        return float(values[0]), vector / np.linalg.norm(vector)
