"""The factor of a block-tridiagonal precision against dense matrices."""

from __future__ import annotations

import numpy as np
import pytest

from gtsam_rwhec.fitting.drift import ChainFactor


def blocks_of(T: int, s: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The precision of a random walk with measurements: its blocks, and the whole."""
    chance = np.random.default_rng(T)
    root = chance.normal(size=(T, s, s))
    diagonal, below = root @ root.transpose(0, 2, 1) + np.eye(s), np.zeros((T - 1, s, s))
    F = chance.normal(size=(T - 1, s, s))
    diagonal[:-1] += F.transpose(0, 2, 1) @ F
    below[:] = -F
    whole = np.zeros((T, s, T, s))
    at = np.arange(T)
    whole[at, :, at] = diagonal
    whole[at[1:], :, at[:-1]] = below
    whole[at[:-1], :, at[1:]] = below.transpose(0, 2, 1)
    return diagonal, below, whole.reshape(T * s, T * s)


@pytest.mark.parametrize(("T", "s"), [(1, 3), (2, 1), (6, 7), (9, 14)])
def test_it_is_that_of_the_dense_matrix(T: int, s: int) -> None:
    diagonal, below, whole = blocks_of(T, s)
    factor = ChainFactor.of(diagonal, below)
    L, inverse = np.linalg.cholesky(whole), np.linalg.inv(whole)
    assert factor.log_det == pytest.approx(np.linalg.slogdet(whole)[1])
    B = np.random.default_rng(1).normal(size=(T, s, 4))
    half = factor.half(factor.inverse @ B)
    np.testing.assert_allclose(half.reshape(T * s, 4), np.linalg.solve(L, B.reshape(T * s, 4)), atol=1e-9)
    np.testing.assert_allclose(factor.whole(half).reshape(T * s, 4), inverse @ B.reshape(T * s, 4), atol=1e-9)
    by_block = inverse.reshape(T, s, T, s)
    own, beside = factor.inverse_blocks()
    at = np.arange(T)
    np.testing.assert_allclose(own, by_block[at, :, at], atol=1e-9)
    np.testing.assert_allclose(beside, by_block[at[1:], :, at[:-1]], atol=1e-9)


def test_an_indefinite_one_is_refused() -> None:
    diagonal, below, _ = blocks_of(4, 3)
    diagonal[2] = -np.eye(3)
    with pytest.raises(np.linalg.LinAlgError):
        ChainFactor.of(diagonal, below)
