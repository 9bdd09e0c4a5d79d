"""Proof, in double precision, that a small matrix is positive semidefinite."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array

#: Rounding that a Cholesky factorisation in double of a 9 x 9 matrix can hide, of unit diagonal (Higham 2002,
#: Theorem 10.7: 9 gamma_10 = 1e-14), and that of forming its entries.
HIDDEN = 1.2e-14


def proven(K: Array) -> bool:
    """Whether K (n, n), n <= 9, is proven to be positive semidefinite. Changes K's diagonal.

    A factorisation that runs through proves it of a matrix that differs by up to ``HIDDEN`` of each diagonal entry
    (of the products of their roots, off the diagonal); that much is taken off beforehand.
    """
    diagonal = K.diagonal().copy()
    np.fill_diagonal(K, diagonal * (1.0 - HIDDEN))
    try:
        np.linalg.cholesky(K)
    except np.linalg.LinAlgError:
        return False
    return True
