"""Arrow algebra against dense algebra, for every shape that the library makes."""

from __future__ import annotations

import numpy as np
import pytest

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver import arrow

SHAPES = [(0, 9, 4), (1, 1, 1), (3, 2, 0), (5, 3, 4), (2, 9, 19), (40, 3, 7)]


def definite_arrow(leaves: int, m: int, b: int, seed: int = 0) -> tuple[Array, Array, Array]:
    """A positive definite arrow matrix: every leaf's coupling is made up for in the border."""
    generator = np.random.default_rng(seed)
    A = generator.standard_normal((leaves, m, m + 2))
    D = A @ A.transpose(0, 2, 1) + 0.1 * np.eye(m)
    C = generator.standard_normal((leaves, m, b))
    E = np.eye(b) + np.einsum("lib,lij,ljc->bc", C, np.linalg.inv(D), C)
    return D, C, 0.5 * (E + E.T)


@pytest.mark.parametrize("shape", SHAPES)
def test_factor_solves_as_dense_algebra_does(shape: tuple[int, int, int]) -> None:
    D, C, E = definite_arrow(*shape)
    full = arrow.dense(D, C, E)
    factor = arrow.cholesky(D, C, E)
    assert factor is not None
    right = np.random.default_rng(1).standard_normal((len(full), 3))
    split = shape[0] * shape[1]
    leaf, border = factor.solve(right[:split].reshape(shape[0], shape[1], 3), right[split:])
    np.testing.assert_allclose(full @ np.r_[arrow.flat(leaf), border], right, atol=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
def test_factor_is_the_dense_cholesky_factor(shape: tuple[int, int, int]) -> None:
    D, C, E = definite_arrow(*shape)
    factor = arrow.cholesky(D, C, E)
    assert factor is not None
    lower = np.linalg.cholesky(arrow.dense(D, C, E))
    split = shape[0] * shape[1]
    np.testing.assert_allclose(arrow.flat(factor.coupling), lower[split:, :split].T, atol=1e-9)
    np.testing.assert_allclose(np.tril(factor.border), lower[split:, split:], atol=1e-9)


@pytest.mark.parametrize("where", ["leaf", "border"])
def test_indefinite_has_no_factor(where: str) -> None:
    D, C, E = definite_arrow(5, 3, 4)
    (D[2] if where == "leaf" else E)[1, 1] = -1e-3
    assert arrow.cholesky(D, C, E) is None


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("where", ["leaf", "leaf diagonal", "coupling", "border", "border diagonal"])
def test_what_is_not_finite_has_no_factor(where: str, value: float) -> None:
    D, C, E = definite_arrow(5, 3, 4)
    matrix, at = {
        "leaf": (D, (2, 1, 0)),
        "leaf diagonal": (D, (2, 2, 2)),
        "coupling": (C, (4, 0, 1)),
        "border": (E, (3, 0)),
        "border diagonal": (E, (1, 1)),
    }[where]
    matrix[at] = value
    with np.errstate(invalid="ignore"):
        assert arrow.cholesky(D, C, E) is None


@pytest.mark.parametrize("size", [0.1, 0.99, 1.01, 10.0])
def test_low_rank_is_subtracted(size: float) -> None:
    """T - G'G is definite exactly when the wider arrow matrix is, and is what its Schur complement solves."""
    D, C, E = definite_arrow(5, 3, 4)
    T = arrow.dense(D, C, E)
    G = np.random.default_rng(2).standard_normal((2, len(T)))
    root = np.linalg.cholesky(T)
    G *= size / np.linalg.norm(np.linalg.solve(root, G.T), 2)  # the largest eigenvalue of T^-1 G'G is size^2
    wide, square = arrow.with_low_rank(C, E, G[:, :15].reshape(2, 5, 3), G[:, 15:])
    factor = arrow.cholesky(D, wide, square)
    assert (factor is not None) == (size < 1.0)
    if factor is not None:
        right = np.random.default_rng(3).standard_normal((len(T), 1))
        leaf, border = factor.solve(right[:15].reshape(5, 3, 1), np.r_[right[15:], np.zeros((2, 1))])
        np.testing.assert_allclose((T - G.T @ G) @ np.r_[arrow.flat(leaf), border[:4]], right, atol=1e-9)


def test_no_rows_of_low_rank_change_nothing() -> None:
    _, C, E = definite_arrow(5, 3, 4)
    wide, square = arrow.with_low_rank(C, E, np.zeros((0, 5, 3)), np.zeros((0, 4)))
    np.testing.assert_array_equal(wide, C)
    np.testing.assert_array_equal(square, E)
