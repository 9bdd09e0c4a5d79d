"""Block-tridiagonal precisions: the Cholesky factor, solutions, and the blocks of the inverse that have an own place.

The inverse's blocks on and beside the diagonal follow from the factor backwards, without the others (Takahashi, Fagan
and Chin 1973). Loops over instants have one or two small products each.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky_banded

from gtsam_rwhec.geometry.poses import Array


@dataclass(frozen=True)
class ChainFactor:
    """The Cholesky factor L of a precision P = L L' of T states of s numbers, each tied to the one before.

    Attributes
    ----------
    inverse : (T, s, s) array
        Of the blocks L_tt.
    below : (T - 1, s, s) array
        The blocks L_t+1,t.
    log_det : float
        log|P|.
    """

    inverse: Array
    below: Array
    log_det: float

    @staticmethod
    def of(diagonal: Array, below: Array) -> ChainFactor:
        """Of the precision's blocks P_tt (T, s, s) and P_t+1,t (T - 1, s, s); LinAlgError if it is not definite."""
        T, s = diagonal.shape[:2]
        banded = np.zeros((2 * s, T, s))
        for j in range(s):
            banded[: s - j, :, j] = diagonal[:, j:, j].T
            banded[s - j : 2 * s - j, :-1, j] = below[:, :, j].T
        banded = cholesky_banded(banded.reshape(2 * s, T * s), lower=True, overwrite_ab=True, check_finite=False)
        by_row = banded.reshape(2 * s, T, s)
        own, before = np.zeros((s, s, T)), np.empty((T - 1, s, s))
        for j in range(s):
            own[j:, j] = by_row[: s - j, :, j]
            before[:, :, j] = by_row[s - j : 2 * s - j, :-1, j].T
        log_det = 2.0 * float(np.log(banded[0]).sum())
        return ChainFactor(np.ascontiguousarray(lower_inverse(own).transpose(2, 0, 1)), before, log_det)

    def half(self, own: Array) -> Array:
        """L^-1 B (T, s, c) in place of ``own``, which has L_tt^-1 B_t."""
        step = self.inverse[1:] @ self.below
        change, last = np.empty(own.shape[1:]), own[0]
        for here, S in zip(own[1:], step, strict=True):
            here -= np.dot(S, last, change)
            last = here
        return own

    def whole(self, half: Array) -> Array:
        """P^-1 B (T, s, c), from L^-1 B."""
        result: Array = self.inverse.transpose(0, 2, 1) @ half
        change, last = np.empty(result.shape[1:]), result[-1]
        for here, S in zip(result[-2::-1], self._gain[::-1], strict=True):
            here -= np.dot(S.T, last, change)
            last = here
        return result

    def inverse_blocks(self) -> tuple[Array, Array]:
        """The blocks (P^-1)_tt (T, s, s) and (P^-1)_t+1,t (T - 1, s, s)."""
        own: Array = self.inverse.transpose(0, 2, 1) @ self.inverse
        gain = self._gain
        below = np.empty_like(gain)
        change, last = np.empty(own.shape[1:]), own[-1]
        for here, S, mixed in zip(own[-2::-1], gain[::-1], below[::-1], strict=True):
            np.dot(last, S, mixed)
            here += np.dot(S.T, mixed, change)
            last = here
        return own, -below

    @property
    def _gain(self) -> Array:
        found: Array = self.below @ self.inverse[:-1]
        return found


def lower_inverse(L: Array) -> Array:
    """The inverses of lower triangles (n, n, N), N at once."""
    result = np.zeros_like(L)
    for i in range(len(L)):
        result[i, i] = 1.0 / L[i, i]
        if i:
            result[i, :i] = np.einsum("jn,jkn->kn", L[i, :i], result[:i, :i]) * -result[i, i]
    return result
