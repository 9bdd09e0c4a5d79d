"""The second derivative Z of a Lagrangian, as blocks of the graph, and proofs that it is positive definite.

Z = Q - Lambda over the form's variables without h: 13 numbers a frame, and alpha. The translations stay in it: then the
proof needs no elimination, which would lose digits. A diagonal (``rounding``) dominates the rounding error of Z.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import gamma, gammas
from gtsam_rwhec.solver.block_matrix import (
    BlockFactor,
    BlockMatrix,
    cholesky_allowance,
    is_proven_to_exceed,
    proof_that_it_exceeds,
)
from gtsam_rwhec.solver.rotations import multiplier_blocks

#: A variable that is held has this many times its own diagonal entry added.
HELD = 2.0**50
#: Above this many variables no dense matrix is decomposed.
DENSE = 1000
#: A factor with more numbers beside its dense rest than this, 40 MB, is large.
LARGE_FACTOR = 5_000_000
#: At most this many null vectors are searched for in a large matrix.
SPARSE_NULLS = 24


@dataclass(frozen=True)
class Curvature:
    """Z over the frames (13 each) and alpha, and a diagonal that dominates its rounding error."""

    matrix: BlockMatrix
    rounding: Array
    is_coupled_to_h: bool  #: whether Q has linear terms

    @staticmethod
    def of(form: BlockMatrix, rounding: Array | None = None) -> Curvature:
        """Q of a form; without ``rounding`` (13 n + 1,), of the form exactly as it is stored."""
        frames = form.frames
        coupled = form.tails[:, :, 1].any() or form.tail[0, 1] != 0.0
        if rounding is None:
            rounding = np.zeros(13 * len(frames) + 1)
        matrix = replace(form, tails=form.tails[:, :, :1], tail=form.tail[:1, :1])
        return Curvature(matrix, rounding, bool(coupled))._without_absent()

    def _without_absent(self) -> Curvature:
        """A unit diagonal for numbers that the problem does not have."""
        absent = (self.diagonal == 0.0) & (self.rounding == 0.0)
        return self.plus(absent.astype(float)) if absent.any() else self

    @property
    def size(self) -> int:
        """13 n + 1."""
        return self.matrix.size

    @property
    def diagonal(self) -> Array:
        """(13 n + 1,)."""
        return self.matrix.diagonal

    @property
    def is_rotation(self) -> np.ndarray:
        """Which of the variables are entries of rotations."""
        return np.append(np.tile(np.arange(13) >= 4, self.size // 13), False)

    def plus(self, diagonal: Array) -> Curvature:
        """The matrix with a diagonal (13 n + 1,) added."""
        return replace(self, matrix=self.matrix.plus(diagonal))

    def less(self, multipliers: Array) -> Curvature:
        """Q - Lambda for multipliers (n, 20), with the rounding of the subtraction."""
        n = len(multipliers)
        blocks, size = (each[:, :9, :9] for each in multiplier_blocks(multipliers))
        frames = self.matrix.frames.copy()
        frames[:, 4:, 4:] -= blocks
        size += np.abs(frames[:, 4:, 4:])
        # An entry sums at most 20 products, exact as the constraints have integer entries; then one subtraction.
        rounding = self.rounding.copy()
        rounding[:-1].reshape(n, 13)[:, 4:] += gamma(22) * size.sum(axis=2)
        return replace(self, matrix=replace(self.matrix, frames=frames), rounding=rounding)

    def times(self, v: Array) -> Array:
        """Z v."""
        return self.matrix.times(v)

    def rounding_of_product(self, v: Array) -> Array:
        """A bound on the rounding error of Z v, from the product and from Z's entries."""
        root = np.sqrt(self.rounding)
        of_entries = root * float(root @ np.abs(v)) + self.rounding * np.abs(v).max(initial=0.0)
        terms = np.append(np.repeat(13 * (self.matrix.order.neighbours + 1), 13), self.size) + 8
        result: Array = gammas(terms) * self.matrix.sizes(v) + of_entries
        return result

    def allowance(self, diagonal: Array) -> Array:
        """A bound on the rounding in a factorisation of a matrix with this diagonal, as a diagonal matrix."""
        return cholesky_allowance(self.matrix, diagonal)

    def with_held(self, held: np.ndarray) -> Curvature:
        """The matrix for vectors whose ``held`` entries are zero: these variables get a large diagonal."""
        if len(held) == 0:
            return self
        large = np.zeros(self.size)
        diagonal = np.abs(self.diagonal)
        large[held] = HELD * np.maximum(diagonal + self.rounding, 1e-20 * diagonal.max())[held]
        return self.plus(large)

    def proof_that_it_exceeds(self, margin: Array) -> BlockFactor | None:
        """The proof that the true Z exceeds diag(margin): the rounding error of Z is subtracted too.

        Returns the factor of a slightly smaller matrix; None where nothing is proven.
        """
        return proof_that_it_exceeds(self.matrix, margin + self.rounding)

    def is_proven_to_exceed(self, margin: Array) -> bool:
        """Whether this proof succeeds; its factor is not kept."""
        return is_proven_to_exceed(self.matrix, margin + self.rounding)

    @property
    def has_large_factor(self) -> bool:
        """Whether a factor takes so much memory that it is kept only where it is needed."""
        return 169 * self.matrix.order.eliminated > LARGE_FACTOR

    def factor(self) -> BlockFactor | None:
        """The Cholesky factor of the stored matrix; None where it is not positive definite."""
        return self.matrix.factor()

    def weakest(self, unit: Array, up_to: float) -> tuple[Array, Array]:
        """Eigenvalues up to ``up_to`` and eigenvectors of diag(unit) Z diag(unit): estimates, ascending."""
        scaled = self.matrix.scaled(unit)
        if self.size <= DENSE:
            values, vectors = np.linalg.eigh(scaled.dense())
        else:
            from scipy.sparse.linalg import LinearOperator, eigsh  # slow to import, and few problems need it

            shift = max(up_to, 1e-12)
            factor = scaled.plus(np.full(self.size, shift)).factor()
            if factor is None:  # a negative eigenvalue, which the caller knows already
                return np.array([-np.inf]), np.zeros((self.size, 1))
            operator = LinearOperator((self.size, self.size), matvec=factor.solve_vector, dtype=np.float64)
            start = np.random.default_rng(0).standard_normal(self.size)
            inverse, vectors = eigsh(operator, k=SPARSE_NULLS, which="LA", v0=start)
            values = 1.0 / inverse - shift
            order = np.argsort(values)
            values, vectors = values[order], vectors[:, order]
        few = values <= up_to
        return values[few], vectors[:, few]
