"""The DQ paper's cost (eq. 8) as three 4 x 4 matrices: one pass over the motions, whatever alpha is.

A_i = L(q_C) - R(q_H) is linear in seven numbers of a motion and B_i in seven of its dual parts
(``Motions.rows``), so the sums over motions of A'A, B'B and B'A are linear in one 14 x 14 matrix of moments.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gtsam_rwhec.geometry.poses import Array

#: Motions worked on at once: memory beyond the input stays bounded.
BLOCK = 32768

#: A = sum_k a_k E_k with a = [v_C + v_H, v_C - v_H, w_C - w_H]: entry [k] is E_k (4, 4).
E = np.zeros((7, 4, 4))
for _k in range(3):
    _a, _b = (_k + 1) % 3, (_k + 2) % 3
    E[_k, _b, _a], E[_k, _a, _b] = 1.0, -1.0
    E[3 + _k, _k, 3], E[3 + _k, 3, _k] = 1.0, -1.0
E[6] = np.eye(4)
#: Row 7 k + l is vec(E_k' E_l): turns moments sum a_k b_l into sum A'B.
_PRODUCTS = np.einsum("kji,ljm->klim", E, E).reshape(49, 16)
_STACKED = np.ascontiguousarray(E.transpose(1, 0, 2).reshape(28, 4))


@dataclass(frozen=True)
class MotionMoments:
    """Sums over the motions (4, 4 each), alpha left out: ``AA`` = A'A, ``BA`` = B'A, ``BB`` = B'B."""

    AA: Array
    BA: Array
    BB: Array
    count: int

    def cost(self, alpha: float) -> DualQuaternionCost:
        """The cost (8) with alpha (1/m)."""
        square = alpha * alpha
        return DualQuaternionCost(self.AA + square * self.BB, square * self.AA, square * self.BA, self.count)


@dataclass(frozen=True)
class DualQuaternionCost:
    """q'S q + 2 q'W q_dual + q_dual'M q_dual, the cost (8) as eq. 9 writes it.

    Attributes
    ----------
    S, M, W : (4, 4) arrays
        Below eq. 9: S = A'A + alpha^2 B'B, M = alpha^2 A'A, W = alpha^2 B'A.
    count : int
        Number of motions.
    """

    S: Array
    M: Array
    W: Array
    count: int

    @cached_property
    def spectrum(self) -> tuple[Array, Array]:
        """Eigenvalues (4,), ascending, and eigenvectors (4, 4) of M."""
        values, vectors = np.linalg.eigh(self.M)
        return values, vectors

    @cached_property
    def _halves(self) -> tuple[Array, Array]:
        # M^-1/2 and W M^-1/2, in M's eigenvectors: products with M^-1 itself would cancel and lose digits.
        values, vectors = self.spectrum
        half = vectors / np.sqrt(values)
        return half, self.W @ half

    @cached_property
    def Z2(self) -> Array:
        """M^-1 (eq. 13), for an M that is not singular."""
        half, _ = self._halves
        result: Array = half @ half.T
        return result

    @cached_property
    def Z1(self) -> Array:
        """W M^-1 + M^-1 W' (eq. 13)."""
        half, W_half = self._halves
        product = W_half @ half.T
        result: Array = product + product.T
        return result

    @cached_property
    def Z0(self) -> Array:
        """S - W M^-1 W' (eq. 13)."""
        _, W_half = self._halves
        result: Array = self.S - W_half @ W_half.T
        return result

    def Z(self, mu: float) -> Array:
        """Z(mu) = Z0 + mu Z1 - mu^2 Z2 (eq. 12)."""
        matrix: Array = self.Z0 + mu * (self.Z1 - mu * self.Z2)
        return matrix

    def value(self, q: Array, q_dual: Array) -> float:
        """The cost of one dual quaternion, parts (4,) each; loses digits where it is small beside tr S."""
        return float(q @ self.S @ q + 2.0 * (q @ self.W @ q_dual) + q_dual @ self.M @ q_dual)

    def lagrangian(self, q: Array, q_dual: Array, lam: float, mu: float) -> float:
        """L of eq. 9."""
        return self.value(q, q_dual) + lam * (1.0 - float(q @ q)) - 2.0 * mu * float(q @ q_dual)


def motion_moments(rows: Array, weights: Array | None = None) -> MotionMoments:
    """The sums of eq. 9 over ``Motions.rows`` (14, N), alpha left out; weights (N,) multiply each motion's terms."""
    if weights is None:
        gram = rows @ rows.T
    else:
        gram = np.zeros((14, 14))
        for first in range(0, rows.shape[1], BLOCK):
            block = rows[:, first : first + BLOCK]
            gram += (block * weights[first : first + BLOCK]) @ block.T
    by_part = gram.reshape(2, 7, 2, 7).transpose(0, 2, 1, 3).reshape(4, 49) @ _PRODUCTS
    AA, _, BA, BB = by_part.reshape(4, 4, 4)
    return MotionMoments(AA, BA, BB, rows.shape[1])


def residuals(rows: Array, q: Array, q_dual: Array) -> Array:
    """A_i q (first four rows) and B_i q + A_i q' (last four) of each motion of ``Motions.rows`` (14, N): (8, N)."""
    P, P_dual = (_STACKED @ q).reshape(4, 7), (_STACKED @ q_dual).reshape(4, 7)
    linear = np.zeros((8, 14))
    linear[:4, :7] = linear[4:, 7:] = P
    linear[4:, :7] = P_dual
    result: Array = linear @ rows
    return result
