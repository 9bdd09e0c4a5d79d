"""Proof, in double precision, that a small matrix is positive semidefinite, and lower bounds from such proofs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gtsam_rwhec.geometry.poses import Array

#: Rounding error that a Cholesky factorisation of a 9 x 9 matrix of unit diagonal can hide in double precision (Higham
#: 2002, Theorem 10.7: 9 gamma_10 = 1e-14), together with the rounding errors of the matrix's own entries.
HIDDEN = 1.2e-14


def proven(K: Array) -> bool:
    """Whether K (n, n), n <= 9, is proven to be positive semidefinite. K's diagonal is changed.

    If the Cholesky factorisation succeeds, a matrix near K is positive semidefinite. Its entries (i, j) differ from K's
    by up to ``HIDDEN`` sqrt(K_ii K_jj). So the diagonal is first multiplied by 1 - ``HIDDEN``.
    """
    np.fill_diagonal(K, K.diagonal() * (1.0 - HIDDEN))
    try:
        np.linalg.cholesky(K)
    except np.linalg.LinAlgError:
        return False
    return True


def proven_bound(form: Callable[[float], Array], value: float, step: float) -> float:
    """The first proven bound among value - step, value - 4 step, value - 16 step, ...; 0 if no positive one is proven.

    ``form`` gives, for a candidate bound, a new matrix (n, n), n <= 9. The bound holds when the matrix is positive
    semidefinite. ``value`` is the optimum, up to rounding, of a sum of squares, so 0 is always a bound.
    """
    lower = value - step
    while lower > 0.0:
        if proven(form(lower)):
            return lower
        step *= 4.0
        lower = value - step
    return 0.0
