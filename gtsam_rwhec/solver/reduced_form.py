"""The reduced form Q' (RWHEC paper eq. 48): translations and scales eliminated, rotations and h left.

x = [vec R of the leaves, vec R of the centers, h]. Each leaf's own translation is eliminated first, which keeps the
arrow shape. The centers' translations and the shared scale couple everything: their elimination subtracts a product of
few rows, Q' = arrow(D, C, E) - G'G. The time grows linearly with the leaves, whether they are targets or sensors.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver import arrow
from gtsam_rwhec.solver.full_form import FullForm

#: With a unit diagonal, a smaller eigenvalue of the eliminated block is rounding error. The pseudo-inverse of eq. 48
#: leaves its direction out.
RANK_TOLERANCE = 1e-12
#: A variable with a smaller diagonal, relative to the largest, is absent. This is the square of the rounding of a zero,
#: and it is far below any ratio of weights.
ABSENT = 1e-26


@dataclass(frozen=True)
class ReducedForm:
    """Q' = arrow(D, C, E) - G'G over x = [leaves (9 L), centers (9 P), h (1)], and the way back to translations.

    D (L, 9, 9) and E (9 P + 1, 9 P + 1), exactly symmetric, C (L, 9, 9 P + 1), G (k, 9 L + 9 P + 1). The factors and
    rows give the eliminated variables; the null vectors are the translations and scales that no measurement
    determines, at any rotations.
    """

    D: Array
    C: Array
    E: Array
    G: Array
    border_factor: Array
    leaf_factor: Array
    leaf_rows: Array
    border_null: Array
    leaf_null: Array

    @property
    def leaves(self) -> int:
        """Number of leaves."""
        return len(self.D)

    @property
    def rotations(self) -> int:
        """Number of free frames."""
        return len(self.D) + (len(self.E) - 1) // 9

    @property
    def size(self) -> int:
        """9 n + 1."""
        return 9 * self.rotations + 1

    @cached_property
    def wide(self) -> Array:
        """C as one matrix (9 L, 9 P + 1)."""
        return arrow.flat(self.C)

    @cached_property
    def G_leaf(self) -> Array:
        """G's columns of the leaves, (k, L, 9)."""
        return self.G[:, : 9 * self.leaves].reshape(len(self.G), self.leaves, 9)

    @cached_property
    def G_border(self) -> Array:
        """G's columns of the centers and h."""
        return self.G[:, 9 * self.leaves :]

    @cached_property
    def magnitude(self) -> float:
        """A scale for costs: the sum of the diagonal is about the cost of a grossly wrong answer."""
        return float(np.einsum("lii->", self.D) + np.trace(self.E))

    def apply(self, x: Array) -> Array:
        """Q' x."""
        split = 9 * self.leaves
        leaf, border = x[:split], x[split:]
        result = np.empty_like(x)
        result[:split] = np.matmul(self.D, leaf.reshape(-1, 9, 1)).ravel() + self.wide @ border
        result[split:] = self.wide.T @ leaf + self.E @ border
        result -= self.G.T @ (self.G @ x)
        return result

    def dense(self) -> Array:
        """Q' as one array; for small problems and for the semidefinite relaxation."""
        full = arrow.dense(self.D, self.C, self.E) - self.G.T @ self.G
        symmetric: Array = 0.5 * (full + full.T)
        return symmetric

    def recover(self, x: Array) -> tuple[Array, Array, Array]:
        """Translations and scales of the optimum given the rotations (eq. 47): leaf (L, 4), center (P, 4), alpha.

        The four numbers are [t, own scale]. Where the measurements leave a scale free, the pseudo-inverse may choose
        zero, which is not a valid scale. Then the scale becomes 1, and the translations follow at the same cost.
        """
        split = 9 * self.leaves
        w = -self.border_factor @ (self.G @ x)
        scales = np.r_[3 : len(w) : 4, len(w) - 1]
        w += _toward_unit_scale(w, self.border_null, scales)
        absent = ~(self.border_factor[scales].any(axis=1) | self.border_null[scales].any(axis=1))
        w[scales[absent]] = 1.0  # nothing depends on it
        border = np.concatenate([w, x[split:]])
        inner = np.concatenate([x[:split].reshape(-1, 9), np.broadcast_to(border, (self.leaves, len(border)))], axis=1)
        leaf = -np.matmul(self.leaf_factor, np.matmul(self.leaf_rows, inner[:, :, None]))[:, :, 0]
        leaf[~(self.leaf_factor[:, 3].any(axis=1) | self.leaf_null[:, 3].any(axis=1)), 3] = 1.0
        for i in np.flatnonzero(self.leaf_null[:, 3].any(axis=1)):
            leaf[i] += _toward_unit_scale(leaf[i], self.leaf_null[i], np.array([3]))
        return leaf, w[:-1].reshape(-1, 4), w[-1:]


def reduce(form: FullForm) -> ReducedForm:
    """Eliminate translations and scales from Q (eq. 48)."""
    L, P = form.leaves, form.centers
    w = 4 * P + 1
    b = w + 9 * P + 1
    # The border's order: [t, s of the centers], alpha, [vec R of the centers], h.
    leaf_center = form.leaf_center
    leaf_border = np.empty((L, 13, b))
    leaf_border[:, :, : 4 * P] = leaf_center[..., :4].transpose(0, 2, 1, 3).reshape(L, 13, 4 * P)
    leaf_border[:, :, 4 * P] = form.leaf_tail[..., 0]
    leaf_border[:, :, w : b - 1] = leaf_center[..., 4:].transpose(0, 2, 1, 3).reshape(L, 13, 9 * P)
    leaf_border[:, :, b - 1] = form.leaf_tail[..., 1]
    E = np.zeros((b, b))
    for p in range(P):
        at = np.r_[4 * p : 4 * p + 4, w + 9 * p : w + 9 * p + 9]
        E[at[:, None], at] = form.center[p]
        E[at, w - 1] = E[w - 1, at] = form.center_tail[p, :, 0]
        E[at, b - 1] = E[b - 1, at] = form.center_tail[p, :, 1]
    corner = [w - 1, b - 1]
    E[np.ix_(corner, corner)] += form.tail

    leaf_factor, leaf_null = generalised_inverse_factor(form.leaf[:, :4, :4])
    own = np.concatenate([form.leaf[:, :4, 4:], leaf_border[:, :4]], axis=2)
    rows = np.matmul(leaf_factor.transpose(0, 2, 1), own)  # (L, 4, 9 + b)
    to_self, to_border = rows[:, :, :9], rows[:, :, 9:]
    D = form.leaf[:, 4:, 4:] - np.matmul(to_self.transpose(0, 2, 1), to_self)
    C = leaf_border[:, 4:] - np.matmul(to_self.transpose(0, 2, 1), to_border)
    flat = arrow.flat(to_border)
    E -= flat.T @ flat

    (factor,), (null,) = generalised_inverse_factor(E[None, :w, :w])
    factor = factor[:, np.abs(factor).max(axis=0) > 0.0]
    null = null[:, np.abs(null).max(axis=0) > 0.0]
    G = np.empty((factor.shape[1], 9 * L + b - w))
    G[:, : 9 * L] = np.matmul(C[:, :, :w], factor).reshape(9 * L, factor.shape[1]).T
    G[:, 9 * L :] = factor.T @ E[:w, w:]
    # Exactly symmetric: a factorisation reads one triangle, and its proof must be about the form as it is evaluated.
    symmetric = 0.5 * (E[w:, w:] + E[w:, w:].T)
    D = 0.5 * (D + D.transpose(0, 2, 1))
    return ReducedForm(D, np.ascontiguousarray(C[:, :, w:]), symmetric, G, factor, leaf_factor, rows, null, leaf_null)


def generalised_inverse_factor(M: Array) -> tuple[Array, Array]:
    """F (s, m, m), where F F' is a generalised inverse of each positive semidefinite M (s, m, m), and M's null vectors.

    Rows and columns are scaled to a unit diagonal first, so that metres and scales compare. F has zero columns for the
    directions that the measurements leave free, and the second matrix has these directions as columns, zero elsewhere.
    Variables that the problem does not have (zero diagonal) are in neither.
    """
    diagonal = np.einsum("sii->si", M)
    largest = diagonal.max(axis=1, keepdims=True, initial=0.0)
    used = diagonal > ABSENT * largest
    d = np.where(used, 1.0 / np.sqrt(np.where(used, diagonal, 1.0)), 0.0)
    scaled = M * d[:, :, None] * d[:, None, :]
    np.einsum("sii->si", scaled)[...] = 1.0
    values, vectors = np.linalg.eigh(scaled)
    keep = values > RANK_TOLERANCE * M.shape[1]
    inverse_root = np.where(keep, 1.0 / np.sqrt(np.where(keep, values, 1.0)), 0.0)
    vectors *= d[:, :, None]
    return vectors * inverse_root[:, None, :], vectors * ~keep[:, None, :]


def _toward_unit_scale(w: Array, null: Array, scales: np.ndarray) -> Array:
    """The step along null directions that brings each scale that they move to 1; zero if they move none."""
    along = null[scales]
    size = np.linalg.norm(null, axis=0)
    open_ones = (np.abs(along) > 1e-6 * np.where(size > 0.0, size, 1.0)).any(axis=1) if null.size else np.zeros(0, bool)
    if not open_ones.any():
        return np.zeros_like(w)
    step: Array = null @ np.linalg.lstsq(along[open_ones], 1.0 - w[scales][open_ones], rcond=1e-9)[0]
    return step
