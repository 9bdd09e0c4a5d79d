"""The second derivative Z of a Lagrangian in arrow form, and proofs that it is positive definite.

Z = Q - Lambda over the form's variables without h: 13 numbers a frame, and alpha. The translations stay in it: then the
proof needs no elimination, which would lose digits. What rounding did to Z is dominated by a diagonal (``rounding``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import gamma
from gtsam_rwhec.solver import arrow
from gtsam_rwhec.solver.full_form import FullForm
from gtsam_rwhec.solver.rotations import CONSTRAINTS_FLAT
from gtsam_rwhec.solver.verified import arrow_is_positive_definite

#: A variable that is held has this many times its own diagonal entry added.
HELD = 2.0**50
#: Above this many variables no dense matrix is decomposed.
DENSE = 1000
#: So many null vectors are looked for in a large matrix.
SPARSE_NULLS = 24


@dataclass(frozen=True)
class Curvature:
    """arrow(leaf, coupling, border) over [leaves (13 L), centers (13 P), alpha], and what dominates its rounding."""

    leaf: Array
    coupling: Array
    border: Array
    rounding: Array
    is_coupled_to_h: bool  #: whether Q has linear terms

    @staticmethod
    def of(form: FullForm, rounding: Array | None = None) -> Curvature:
        """Q of a form; without ``rounding`` (13 n + 1,), of the form exactly as it is stored."""
        L, P = form.leaves, form.centers
        coupling = np.empty((L, 13, 13 * P + 1))
        coupling[:, :, :-1] = form.leaf_center.transpose(0, 2, 1, 3).reshape(L, 13, 13 * P)
        coupling[:, :, -1] = form.leaf_tail[:, :, 0]
        border = np.zeros((13 * P + 1, 13 * P + 1))
        np.einsum("papb->pab", border[:-1, :-1].reshape(P, 13, P, 13))[...] = form.center
        border[-1, :-1] = border[:-1, -1] = form.center_tail[:, :, 0].ravel()
        border[-1, -1] = form.tail[0, 0]
        leaf = 0.5 * (form.leaf + form.leaf.transpose(0, 2, 1))
        coupled = form.leaf_tail[:, :, 1].any() or form.center_tail[:, :, 1].any() or form.tail[0, 1] != 0.0
        if rounding is None:
            rounding = np.zeros(13 * (L + P) + 1)
        return Curvature(leaf, coupling, 0.5 * (border + border.T), rounding, bool(coupled))._without_absent()

    def _without_absent(self) -> Curvature:
        """A unit diagonal for numbers that the problem does not have."""
        absent = (self.diagonal == 0.0) & (self.rounding == 0.0)
        return self.plus(absent.astype(float))

    @property
    def leaves(self) -> int:
        """Number of leaves."""
        return len(self.leaf)

    @property
    def size(self) -> int:
        """13 n + 1."""
        return 13 * len(self.leaf) + len(self.border)

    @property
    def diagonal(self) -> Array:
        """(13 n + 1,)."""
        result: Array = np.r_[np.einsum("lii->li", self.leaf).ravel(), np.diagonal(self.border)]
        return result

    @property
    def is_rotation(self) -> np.ndarray:
        """Which of the variables are entries of rotations."""
        n = self.size // 13
        return np.append(np.tile(np.arange(13) >= 4, n), False)

    def plus(self, diagonal: Array) -> Curvature:
        """The matrix with a diagonal (13 n + 1,) added."""
        split = 13 * self.leaves
        leaf, border = self.leaf.copy(), self.border.copy()
        np.einsum("lii->li", leaf)[...] += diagonal[:split].reshape(-1, 13)
        np.einsum("ii->i", border)[...] += diagonal[split:]
        return replace(self, leaf=leaf, border=border)

    def less(self, multipliers: Array) -> Curvature:
        """Q - Lambda for multipliers (n, 20), with the rounding of the subtraction."""
        n, L = len(multipliers), self.leaves
        blocks = (multipliers @ CONSTRAINTS_FLAT).reshape(n, 10, 10)[:, :9, :9]
        size = (np.abs(multipliers) @ np.abs(CONSTRAINTS_FLAT)).reshape(n, 10, 10)[:, :9, :9].copy()
        leaf, border = self.leaf.copy(), self.border.copy()
        leaf[:, 4:, 4:] -= blocks[:L]
        size[:L] += np.abs(leaf[:, 4:, 4:])
        for p in range(n - L):
            at = slice(13 * p + 4, 13 * p + 13)
            border[at, at] -= blocks[L + p]
            size[L + p] += np.abs(border[at, at])
        # An entry sums at most 20 products, exact as the constraints have integer entries; then one subtraction.
        rounding = self.rounding.copy()
        rounding[:-1].reshape(n, 13)[:, 4:] += gamma(22) * size.sum(axis=2)
        return replace(self, leaf=leaf, border=border, rounding=rounding)

    def times(self, v: Array) -> Array:
        """Z v."""
        return _product(self.leaf, self.coupling, self.border, v)

    def rounding_of_product(self, v: Array) -> Array:
        """A bound on what rounding takes from Z v: that of the product, and that of Z's entries."""
        size = _product(np.abs(self.leaf), np.abs(self.coupling), np.abs(self.border), np.abs(v))
        root = np.sqrt(self.rounding)
        of_entries = root * float(root @ np.abs(v)) + self.rounding * np.abs(v).max(initial=0.0)
        result: Array = gamma(self.size + 8) * size + of_entries
        return result

    def with_held(self, held: np.ndarray) -> Curvature:
        """The matrix for vectors whose ``held`` entries are zero: these variables get a large diagonal."""
        large = np.zeros(self.size)
        diagonal = np.abs(self.diagonal)
        large[held] = HELD * np.maximum(diagonal + self.rounding, 1e-20 * diagonal.max())[held]
        return self.plus(large)

    def exceeds(self, margin: Array) -> bool:
        """Whether the true Z is proven to exceed diag(margin): what rounding did to it is taken off too."""
        split = 13 * self.leaves
        whole = margin + self.rounding
        return arrow_is_positive_definite(
            self.leaf, self.coupling, self.border, whole[:split].reshape(-1, 13), whole[split:]
        )

    def factor(self) -> arrow.ArrowFactor | None:
        """The Cholesky factor of the stored matrix; None where it is not positive definite."""
        return arrow.cholesky(self.leaf, self.coupling, self.border)

    def weakest(self, unit: Array, up_to: float) -> tuple[Array, Array]:
        """Eigenvalues up to ``up_to`` and eigenvectors of diag(unit) Z diag(unit): estimates, ascending."""
        split, b = 13 * self.leaves, len(self.border)
        leaf_unit, border_unit = unit[:split].reshape(-1, 13), unit[split:]
        leaf = self.leaf * leaf_unit[:, :, None] * leaf_unit[:, None, :]
        coupling = self.coupling * leaf_unit[:, :, None] * border_unit
        border = self.border * border_unit[:, None] * border_unit
        if self.size <= DENSE:
            values, vectors = np.linalg.eigh(arrow.dense(leaf, coupling, border))
        else:
            from scipy.sparse.linalg import LinearOperator, eigsh  # slow to import, and few problems need it

            shift = max(up_to, 1e-12)
            factor = arrow.cholesky(leaf + shift * np.eye(13), coupling, border + shift * np.eye(b))
            if factor is None:  # a negative eigenvalue, which the caller has been told of by other means
                return np.array([-np.inf]), np.zeros((self.size, 1))
            operator = LinearOperator((self.size, self.size), matvec=factor.solve_vector, dtype=np.float64)
            start = np.random.default_rng(0).standard_normal(self.size)
            inverse, vectors = eigsh(operator, k=SPARSE_NULLS, which="LA", v0=start)
            values = 1.0 / inverse - shift
            order = np.argsort(values)
            values, vectors = values[order], vectors[:, order]
        few = values <= up_to
        return values[few], vectors[:, few]


def _product(leaf: Array, coupling: Array, border: Array, v: Array) -> Array:
    split = 13 * len(leaf)
    of_leaf, of_border = v[:split], v[split:]
    wide = arrow.flat(coupling)
    first = np.matmul(leaf, of_leaf.reshape(-1, 13, 1)).ravel() + wide @ of_border
    return np.concatenate([first, wide.T @ of_leaf + border @ of_border])
