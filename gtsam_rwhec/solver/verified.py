"""Verified tests of positive definiteness in floating point (Rump 2006), for arrow matrices and dense matrices.

A Cholesky factorisation that completes in double precision proves that the matrix plus its backward error is positive
definite. The backward error has an a-priori bound (Higham 2002, theorem 10.3, any order of summation; Rump 2006,
"Verification of positive definiteness", lemma 2.1), entry by entry::

    |dA_ij| <= g / (1 - g) sqrt(a_ii a_jj),   g = gamma_{N+1} = (N + 1) u / (1 - (N + 1) u)

so the diagonal matrix N g / (1 - g) a_ii dominates dA. This matrix, and a bound on the rounding of forming the matrix,
are subtracted from the diagonal first. If the factorisation then succeeds, the matrix as stated is positive definite. A
failure proves nothing.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import SAFETY, UNIT, gamma
from gtsam_rwhec.solver import arrow

#: This number is added to a bound; underflow can lose less.
_TINY = 1e-290


def cholesky_allowance(diagonal: Array, size: int) -> Array:
    """A bound on the rounding in the factorisation of a matrix of this size and diagonal, as a diagonal matrix."""
    g = gamma(size + 1)
    allowance: Array = SAFETY * size * g / (1.0 - g) * np.abs(diagonal) + _TINY
    return allowance


def is_positive_definite(matrix: Array, margin: Array | float = 0.0) -> bool:
    """Whether a symmetric matrix, exactly as stored, minus diag(margin) is proven positive definite.

    Only its lower triangle is read. False proves nothing.
    """
    size = len(matrix)
    leaves = np.zeros((0, 1, 1)), np.zeros((0, 1, size))
    return arrow_is_positive_definite(*leaves, matrix, np.zeros((0, 1)), np.broadcast_to(margin, size))


def arrow_is_positive_definite(D: Array, C: Array, E: Array, leaf_margin: Array, border_margin: Array) -> bool:
    """Whether arrow(D, C, E) - diag(margin) is proven positive definite.

    D (L, m, m), C (L, m, b), E (b, b). The margins (L, m) and (b,) are subtracted from the diagonal; they are negative
    for a weaker test.
    """
    size = D.shape[0] * D.shape[1] + len(E)
    leaf_diagonal = np.einsum("lii->li", D)
    border_diagonal = np.diagonal(E)
    D_shifted, E_shifted = D.copy(), E.copy()
    for shifted, diagonal, margin in (
        (np.einsum("lii->li", D_shifted), leaf_diagonal, leaf_margin),
        (np.einsum("ii->i", E_shifted), border_diagonal, border_margin),
    ):
        # The subtraction rounds by at most u times its result.
        reach = np.abs(diagonal) + np.abs(margin)
        shifted -= margin + cholesky_allowance(reach, size) + 4.0 * UNIT * reach
    return arrow.cholesky(D_shifted, C, E_shifted) is not None
