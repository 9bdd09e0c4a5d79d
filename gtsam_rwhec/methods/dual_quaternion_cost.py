"""The DQ paper's cost (eq. 8) as three 4 x 4 matrices, from one pass over the motions that serves every alpha.

Poses are unit dual quaternions q + epsilon q' in the paper's order xyzw (Section 2): q' = (t, 0) (x) q / 2 (eq. 2).
A_i = L(q_C) - R(q_H) is linear in seven numbers of a motion, and B_i in seven numbers of the motion's dual parts
(``Motions.rows``). So the sums of A'A, B'B and B'A are linear in one 14 x 14 matrix of moments.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from rwhec_factors.se3 import pose

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import LEFT, RIGHT, of_rows, to_rotations

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


def from_rows(rows: Array) -> tuple[Array, Array]:
    """Dual quaternions of poses (12, N): vec R, column after column, then t in metres (``poses.checked_rows``).

    q and q_dual are (4, N), xyzw. The scalar part of q is not negative; q_dual has the unit m / 2.
    """
    q = of_rows(rows[:9])
    q *= np.copysign(1.0, q[3])
    half = 0.5 * rows[9:12]
    v, w = q[:3], q[3]
    q_dual = np.empty_like(q)
    q_dual[:3] = half * w + half[_NEXT] * v[_LAST] - half[_LAST] * v[_NEXT]
    q_dual[3] = -(half * v).sum(axis=0)
    return q, q_dual


def from_transforms(T: Array) -> tuple[Array, Array]:
    """Dual quaternions q, q_dual (N, 4) of poses (N, 4, 4) as in ``from_rows``. The poses are not checked."""
    q, q_dual = from_rows(T[:, :3, :].transpose(2, 1, 0).reshape(12, -1))
    return q.T, q_dual.T


def to_transform(q: Array, q_dual: Array) -> Array:
    """The pose (4, 4) of one dual quaternion, parts (4,) xyzw, of any length but zero.

    The part of q_dual along q is left out: no pose has it. Raises ValueError when q is zero or not finite.
    """
    square = float(q @ q)
    if not 0.0 < square < np.inf:
        raise ValueError(f"q = {q} has no length; a rotation needs one")
    return pose(to_rotations(q), (2.0 / square) * (times_vectors(q).T @ q_dual))  # q' = V t / 2 and V'V = |q|^2


def times_vectors(q: Array) -> Array:
    """V (4, 3) with (v, 0) (x) q = V v for one q (4,): three columns of R(q), which span q's complement."""
    x, y, z, w = q.tolist()
    return np.array([[w, z, -y], [-z, w, x], [y, -x, w], [-x, -y, -z]])


#: This many motions are worked on at once, which bounds the memory beyond the input.
BLOCK = 32768

#: Entry [k] is E_k (4, 4) of A = sum_k a_k E_k, with a = [v_C + v_H, v_C - v_H, w_C - w_H].
E = np.concatenate([0.5 * (LEFT - RIGHT)[:3], 0.5 * (LEFT + RIGHT)[:3], LEFT[3:]])
#: Row 7 k + l is vec(E_k' E_l). It turns moments sum a_k b_l into the sum of A'B.
_PRODUCTS = np.einsum("kji,ljm->klim", E, E).reshape(49, 16)
_STACKED = np.ascontiguousarray(E.transpose(1, 0, 2).reshape(28, 4))


@dataclass(frozen=True)
class MotionMoments:
    """Sums over ``count`` motions, (4, 4) each, without alpha: ``AA`` of A'A, ``BA`` of B'A, ``BB`` of B'B."""

    AA: Array
    BA: Array
    BB: Array
    count: int

    @staticmethod
    def of(moments: Array, count: int) -> MotionMoments:
        """From the ``gram`` (14, 14) of ``Motions.rows``."""
        (AA, _), (BA, BB) = by_parts(moments, _PRODUCTS)
        return MotionMoments(AA, BA, BB, count)

    def cost(self, alpha: float) -> DualQuaternionCost:
        """The cost (8) with alpha (1/m)."""
        square = alpha * alpha
        return DualQuaternionCost(self.AA + square * self.BB, square * self.AA, square * self.BA, self.count)


@dataclass(frozen=True)
class DualQuaternionCost:
    """The cost (8) as eq. 9 writes it: q'S q + 2 q'W q_dual + q_dual'M q_dual."""

    #: (4, 4): as below eq. 9: S = A'A + alpha^2 B'B, M = alpha^2 A'A, W = alpha^2 B'A.
    S: Array
    M: Array
    W: Array
    count: int  #: Number of motions

    @cached_property
    def spectrum(self) -> tuple[Array, Array]:
        """Eigenvalues (4,) of M, ascending, and its eigenvectors (4, 4)."""
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
        """M^-1 (eq. 13). M must not be singular."""
        half, _ = self._halves
        return half @ half.T

    @cached_property
    def Z1(self) -> Array:
        """W M^-1 + M^-1 W' (eq. 13)."""
        half, W_half = self._halves
        product = W_half @ half.T
        return product + product.T

    @cached_property
    def Z0(self) -> Array:
        """S - W M^-1 W' (eq. 13)."""
        _, W_half = self._halves
        return self.S - W_half @ W_half.T

    def Z(self, mu: float) -> Array:
        """Z(mu) = Z0 + mu Z1 - mu^2 Z2 (eq. 12)."""
        return self.Z0 + mu * (self.Z1 - mu * self.Z2)

    def value(self, q: Array, q_dual: Array) -> float:
        """The cost of a dual quaternion, parts (4,) each. Digits are lost where the cost is small beside tr S."""
        return float(q @ self.S @ q + 2.0 * (q @ self.W @ q_dual) + q_dual @ self.M @ q_dual)


def blocks(count: int, matrices: int = 1) -> Iterator[slice]:
    """Slices that cut ``count`` motions into blocks; smaller blocks where each motion needs several ``matrices``."""
    step = BLOCK // matrices
    return (slice(first, first + step) for first in range(0, count, step))


def gram(rows: Array, weights: Array | None = None) -> Array:
    """The sum of weight * row row' (n, n) over motions, the columns of ``rows`` (n, N)."""
    if weights is None:
        return rows @ rows.T
    total = np.zeros((len(rows), len(rows)))
    for block in blocks(rows.shape[1]):
        total += (rows[:, block] * weights[block]) @ rows[:, block].T
    return total


def by_parts(moments: Array, products: Array) -> Array:
    """Sums of P'P (2, 2, 4, 4) for P of primal and dual parts, from moments (2 n, 2 n) and vec(P_k' P_l) (n n, 16)."""
    n = len(moments) // 2
    pairs = moments.reshape(2, n, 2, n).transpose(0, 2, 1, 3).reshape(4, n * n)
    return (pairs @ products).reshape(2, 2, 4, 4)


def motion_moments(rows: Array, weights: Array | None = None) -> MotionMoments:
    """The sums of eq. 9 over ``Motions.rows`` (14, N), without alpha. Weights (N,) multiply the motions' terms."""
    return MotionMoments.of(gram(rows, weights), rows.shape[1])


def residuals(rows: Array, q: Array, q_dual: Array) -> Array:
    """A_i q (first four rows) and B_i q + A_i q' (last four rows) of motions ``Motions.rows`` (14, N): (8, N)."""
    P, P_dual = (_STACKED @ q).reshape(4, 7), (_STACKED @ q_dual).reshape(4, 7)
    linear = np.zeros((8, 14))
    linear[:4, :7] = linear[4:, 7:] = P
    linear[4:, :7] = P_dual
    return linear @ rows
