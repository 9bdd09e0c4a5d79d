"""The reduced form Q' of a part with many frames, which is never written down: the graph of the full form is followed.

Q' x = Q_rr x - Q_rt Q_tt^-1 Q_tr x, with t the translations and scales. Where eliminating the translations would
couple every frame with every other, Q_tt itself has no more couplings than there are pairs. So products with Q' solve
with the factor of Q_tt (`block_matrix`), and Newton's step in the rotations is that of the form in rotations' tangents,
translations and scales together, whose Schur complement it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.block_matrix import BlockFactor, BlockMatrix
from gtsam_rwhec.solver.elimination import Elimination
from gtsam_rwhec.solver.full_form import FullForm
from gtsam_rwhec.solver.rotations import unvec

#: With a unit diagonal, a smaller pivot of the eliminated block is rounding error: a direction is free.
RANK_TOLERANCE = 1e-12
#: Then this part of the diagonal is added, which changes costs by its square.
DAMPING = 1e-11
#: This is the square of the rounding of a zero: a variable with a smaller diagonal, relative to the largest, is absent.
ABSENT = 1e-26
_I3 = np.eye(3)


@dataclass(frozen=True)
class GraphForm:
    """Q' as a product; ``whole`` is Q over 13 numbers a frame and the tail [alpha, h]."""

    whole: BlockMatrix
    leaves: int
    translations: BlockFactor
    #: (4 n + 1,): what was added to the diagonal of Q_tt before it was factored.
    added: Array
    #: (4 n + 1,): translations and scales that the problem does not have.
    absent: np.ndarray

    @staticmethod
    def of(form: FullForm, order: Elimination, *, has_scales: bool) -> GraphForm | None:
        """The form that follows a graph; None where the measurements leave a scale free, or moments are not finite.

        Free translations cost nothing: they stay near the gauge's origin. A free scale has to be 1 (`reduced_form`).
        """
        frames = form.frames
        whole = BlockMatrix(order, frames, form.couplings, form.tails, form.tail)
        tt = BlockMatrix(order, frames[:, :4, :4], form.couplings[:, :4, :4], form.tails[:, :4, :1], form.tail[:1, :1])
        diagonal = tt.diagonal
        if not np.isfinite(diagonal).all():
            return None
        absent = diagonal <= ABSENT * diagonal.max(initial=0.0)
        added = np.where(absent, 1.0, 0.0)
        factor = tt.plus(added).factor()
        if factor is None or not (factor.pivots**2 > RANK_TOLERANCE * (diagonal + added)).all():
            if has_scales:
                return None
            added = np.where(absent, 1.0, DAMPING * diagonal)
            factor = tt.plus(added).factor()
        return None if factor is None else GraphForm(whole, form.leaves, factor, added, absent)

    @property
    def rotations(self) -> int:
        """Number of free frames."""
        return len(self.whole.frames)

    @property
    def size(self) -> int:
        """9 n + 1."""
        return 9 * self.rotations + 1

    @cached_property
    def magnitude(self) -> float:
        """A scale for costs: the sum of the diagonal is about the cost of a grossly wrong answer."""
        return float(np.einsum("nii->", self.whole.frames[:, 4:, 4:]) + self.whole.tail[1, 1])

    def apply(self, x: Array) -> Array:
        """Q' x for x = [vec R_1, ..., vec R_n, h]."""
        return self._solved(x)[1]

    def recover(self, x: Array) -> tuple[Array, Array, Array]:
        """Translations and scales of the optimum given the rotations (eq. 47): leaf (L, 4), center (P, 4), alpha.

        The four numbers are [t, own scale]; scales that the problem does not have are 1.
        """
        w = self._solved(x)[0]
        w[self.absent & ~np.append(np.tile([True, True, True, False], self.rotations), False)] = 1.0
        frames = w[:-1].reshape(-1, 4)
        return frames[: self.leaves], frames[self.leaves :], w[-1:]

    def _solved(self, x: Array) -> tuple[Array, Array]:
        """The best translations and scales (4 n + 1,) for x, and Q' x."""
        n = self.rotations
        numbers = np.zeros((n, 13))
        numbers[:, 4:] = x[:-1].reshape(n, 9)
        product = self.whole.times(np.r_[numbers.ravel(), 0.0, x[-1]])
        by_frame = product[:-2].reshape(n, 13)
        w = -self.translations.solve_vector(np.append(by_frame[:, :4].ravel(), product[-2]))
        numbers[:, 4:] = 0.0
        numbers[:, :4] = w[:-1].reshape(n, 4)
        rest = self.whole.times(np.r_[numbers.ravel(), w[-1], 0.0])
        by_frame = by_frame + rest[:-2].reshape(n, 13)
        return w, np.append(by_frame[:, 4:].ravel(), product[-1] + rest[-1])

    def without_h(self) -> BlockMatrix:
        """Q over the numbers of the frames and alpha, with what makes Q_tt definite."""
        n = self.rotations
        whole = replace(self.whole, tails=self.whole.tails[:, :, :1], tail=self.whole.tail[:1, :1])
        added = np.zeros((n, 13))
        added[:, :4] = self.added[:-1].reshape(n, 4)
        return whole.plus(np.append(added.ravel(), self.added[-1]))

    def hessian(self, R: Array, basis: Array, q: Array) -> GraphHessian:
        """Half the Hessian at R (n, 3, 3), with its tangents' basis (n, 9, 3) and q = Q' x."""
        n = self.rotations
        M = unvec(q[:-1]).transpose(0, 2, 1) @ R
        curvature = 0.5 * (M + M.transpose(0, 2, 1)) - np.einsum("nii->n", M)[:, None, None] * _I3
        T = np.zeros((n, 13, 7))
        T[:, :4, :4] = np.eye(4)
        T[:, 4:, 4:] = basis
        joint = self.without_h().congruent(T)
        joint.frames[:, 4:, 4:] += curvature
        return GraphHessian(joint)


@dataclass(frozen=True)
class GraphHessian:
    """Half the Hessian over translation, scale and tangent of each frame, and alpha: [t, s, w] (7) a frame."""

    joint: BlockMatrix

    def step(self, gradient: Array, damping: float) -> Array | None:
        """Newton's step in the rotations (n, 3) for half the gradient (n, 3); None where it is not definite."""
        n = len(gradient)
        joint = self.joint
        if damping:
            joint = joint.plus(np.append(np.tile(np.r_[np.zeros(4), np.full(3, damping)], n), 0.0))
        factor = joint.factor()
        if factor is None:
            return None
        right = np.zeros((n, 7))
        right[:, 4:] = gradient
        step: Array = -factor.solve_vector(np.append(right.ravel(), 0.0))[:-1].reshape(n, 7)[:, 4:]
        return step
