"""Verified tests of positive definiteness in floating point (Rump 2006), for matrices that follow a graph.

A Cholesky factorisation that completes in double precision proves that the matrix plus its backward error is positive
definite. The backward error has an a-priori bound (Higham 2002, theorem 10.3, any order of summation; Rump 2006,
"Verification of positive definiteness", lemma 2.1), entry by entry::

    |dA_ij| <= g / (1 - g) sqrt(a_ii a_jj),   g = gamma_{k+1} = (k + 1) u / (1 - (k + 1) u)

with k the number of terms in the sum that makes the entry of the factor, and dA_ij = 0 outside the fill. So the
diagonal matrix of a_ii times the row sums of g / (1 - g) dominates dA (`elimination.Elimination.spread`): in a star, a
leaf's rows lose what few terms lose, however many leaves there are. This matrix, and a bound on the rounding of forming
the matrix, are subtracted from the diagonal first. If the factorisation then succeeds, the matrix as stated is positive
definite. A failure proves nothing.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import UNIT
from gtsam_rwhec.solver.block_matrix import BlockFactor, BlockMatrix

#: This number is added to a bound; underflow can lose less.
_TINY = 1e-290


def cholesky_allowance(matrix: BlockMatrix, diagonal: Array) -> Array:
    """A bound on the rounding in the factorisation of a matrix with this graph and diagonal, as a diagonal matrix."""
    _, m, q = matrix.tails.shape
    of_frames, of_tail = matrix.order.spread(m, q)
    allowance: Array = np.r_[np.repeat(of_frames, m), np.full(q, of_tail)] * np.abs(diagonal) + _TINY
    return allowance


def proof_that_it_exceeds(matrix: BlockMatrix, margin: Array | float = 0.0) -> BlockFactor | None:
    """The proof that a matrix, exactly as stored, minus diag(margin) is positive definite: the factor of a smaller one.

    None proves nothing. A negative margin makes a weaker test.
    """
    return _smaller(matrix, margin).factor()


def is_proven_to_exceed(matrix: BlockMatrix, margin: Array | float = 0.0) -> bool:
    """Whether there is such a proof, which is not kept."""
    return _smaller(matrix, margin).has_factor()


def _smaller(matrix: BlockMatrix, margin: Array | float) -> BlockMatrix:
    diagonal = matrix.diagonal
    # The subtraction rounds by at most u times its result.
    reach = np.abs(diagonal) + np.abs(margin)
    return matrix.plus(-(margin + cholesky_allowance(matrix, reach) + 4.0 * UNIT * reach))
