"""Block algebra against plain loops over whole matrices."""

from __future__ import annotations

import numpy as np
import pytest

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.rotations import CONSTRAINTS
from gtsam_rwhec.solver.small_dual import gather, gram, local_indices, scatter, traces


def symmetric(size: int, generator: np.random.Generator) -> Array:
    M = generator.standard_normal((size, size))
    return M + M.T


def random_family(n: int, c: int, generator: np.random.Generator) -> Array:
    M = generator.standard_normal((n, c, 10, 10))
    return M + M.transpose(0, 1, 3, 2)


def whole(block: Array, i: int, n: int) -> Array:
    """One local matrix (10, 10) in its place."""
    full = np.zeros((9 * n + 1, 9 * n + 1))
    at = np.r_[9 * i : 9 * i + 9, 9 * n]
    full[np.ix_(at, at)] = block
    return full


@pytest.mark.parametrize("n", [1, 2, 5])
def test_scatter_adds_local_matrices_and_gather_takes_them(n: int) -> None:
    generator = np.random.default_rng(n)
    blocks = random_family(n, 1, generator)[:, 0]
    np.testing.assert_allclose(scatter(blocks), sum(whole(block, i, n) for i, block in enumerate(blocks)), atol=1e-15)
    W = symmetric(9 * n + 1, generator)
    for i, (block, at) in enumerate(zip(gather(W), local_indices(n), strict=True)):
        np.testing.assert_array_equal(block, W[np.ix_(at, at)])
        assert at[-1] == 9 * n
        assert list(at[:9]) == list(range(9 * i, 9 * i + 9))


@pytest.mark.parametrize("n", [1, 2, 4])
def test_traces_by_plain_loops(n: int) -> None:
    generator = np.random.default_rng(n)
    family, W = random_family(n, 3, generator), symmetric(9 * n + 1, generator)
    expected = [[np.trace(whole(A, i, n) @ W) for A in family[i]] for i in range(n)]
    np.testing.assert_allclose(traces(family, W), expected, atol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("constraints", [True, False])
def test_gram_by_plain_loops(n: int, constraints: bool) -> None:
    """tr(A_p W A_q V) for two different symmetric matrices, in both orders."""
    generator = np.random.default_rng(n)
    family = np.broadcast_to(CONSTRAINTS, (n, 20, 10, 10)) if constraints else random_family(n, 3, generator)
    W, V = symmetric(9 * n + 1, generator), symmetric(9 * n + 1, generator)
    every = [whole(A, i, n) for i in range(n) for A in family[i]]
    expected = np.array([[np.trace(A @ W @ B @ V) for B in every] for A in every])
    result = gram(family, W, V)
    np.testing.assert_allclose(result, 0.5 * (expected + expected.T), atol=1e-10)
    np.testing.assert_allclose(result, gram(family, V, W), atol=1e-10)
