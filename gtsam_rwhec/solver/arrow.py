"""Linear algebra on block-arrow matrices, which is the fill that Appendix B of the RWHEC paper shows.

The graph is bipartite. With the larger side as *leaves* and the smaller side as *border*, every matrix here is::

    [ D_1            C_1 ]        D (L, m, m)   one block a leaf; leaves never meet
    [      ...       ... ]        C (L, m, b)
    [           D_L  C_L ]        E (b, b)
    [ C_1' ...  C_L'   E ]

Where eliminated translations couple everything, a product G'G with few rows is subtracted. That is an arrow matrix
again, with the border larger by the rows of G: [[T, G'], [G, I]] is positive definite exactly when T - G'G is. The
time to factor grows linearly with the leaves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from gtsam_rwhec.geometry.poses import Array


@dataclass(frozen=True)
class ArrowFactor:
    """Cholesky factor of a block-arrow matrix: leaves (L, m, m), coupling (L, m, b), border (b, b), all lower."""

    leaves: Array
    coupling: Array
    border: Array

    def solve(self, leaf: Array, border: Array) -> tuple[Array, Array]:
        """Solve for right-hand sides leaf (L, m, c) and border (b, c)."""
        y = forward_substitution(self.leaves, leaf)
        wide = flat(self.coupling)
        y_border = border - wide.T @ flat(y)
        z_border = scipy.linalg.cho_solve((self.border, True), y_border, check_finite=False)
        z_leaf = y - (wide @ z_border).reshape(y.shape)
        return backward_substitution(self.leaves, z_leaf), z_border

    def solve_vector(self, v: Array) -> Array:
        """Solve for one vector (L m + b,)."""
        L, m = self.leaves.shape[:2]
        leaf, border = self.solve(v[: L * m].reshape(L, m, 1), v[L * m :, None])
        return np.concatenate([leaf.ravel(), border.ravel()])


def flat(stack: Array) -> Array:
    """A stack (L, m, c) as one matrix (L m, c); for L = 0 or c = 0 too."""
    return stack.reshape(stack.shape[0] * stack.shape[1], stack.shape[2])


def with_low_rank(C: Array, E: Array, G_leaf: Array, G_border: Array) -> tuple[Array, Array]:
    """Coupling and border of the arrow matrix that stands for (D, C, E) - G'G; G_leaf (k, L, m), G_border (k, b)."""
    C_wide = np.concatenate([C, G_leaf.transpose(1, 2, 0)], axis=2)
    E_wide = np.block([[E, G_border.T], [G_border, np.eye(len(G_border))]])
    return C_wide, E_wide


def cholesky(D: Array, C: Array, E: Array) -> ArrowFactor | None:
    """Factor the arrow matrix; None when a pivot is not a positive, finite number."""
    try:
        leaves = np.linalg.cholesky(D)
        coupling = forward_substitution(leaves, C)
        wide = flat(coupling)
        border = np.linalg.cholesky(E - wide.T @ wide)
    except np.linalg.LinAlgError:
        return None
    # LAPACK may let NaN and infinity pass as pivots; the diagonal then has them.
    if not (np.isfinite(np.einsum("lii->li", leaves)).all() and np.isfinite(np.diagonal(border)).all()):
        return None
    return ArrowFactor(leaves, coupling, border)


def forward_substitution(lower: Array, right: Array) -> Array:
    """Solve lower y = right for stacks (L, m, m) and (L, m, c): each row of all L systems at once."""
    y = np.empty_like(right)
    for i in range(lower.shape[1]):
        row = right[:, i, :]
        if i:
            row = row - np.matmul(lower[:, i, None, :i], y[:, :i, :])[:, 0]
        y[:, i, :] = row / lower[:, i, i, None]
    return y


def backward_substitution(lower: Array, right: Array) -> Array:
    """Solve lower' y = right for stacks."""
    y = np.empty_like(right)
    m = lower.shape[1]
    for i in reversed(range(m)):
        row = right[:, i, :]
        if i + 1 < m:
            row = row - np.matmul(lower[:, i + 1 :, i][:, None, :], y[:, i + 1 :, :])[:, 0]
        y[:, i, :] = row / lower[:, i, i, None]
    return y


def dense(D: Array, C: Array, E: Array) -> Array:
    """The arrow matrix as one array."""
    L, m = D.shape[:2]
    size = L * m
    full = np.zeros((size + len(E), size + len(E)))
    np.einsum("lilj->lij", full[:size, :size].reshape(L, m, L, m))[...] = D
    full[:size, size:] = C.reshape(size, len(E))
    full[size:, :size] = full[:size, size:].T
    full[size:, size:] = E
    return full
