"""Matrices that follow a graph: the same products and solutions as dense ones, and proofs that are never fooled."""

from __future__ import annotations

from fractions import Fraction

import exact_arithmetic as exact
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.block_matrix import BlockMatrix, cholesky_allowance, proof_that_it_exceeds, sum_into
from gtsam_rwhec.solver.elimination import Elimination


def random_edges(n: int, share: float, generator: np.random.Generator) -> np.ndarray:
    """Couplings (F, 2) of n frames, each first < second."""
    edges = np.argwhere(np.triu(generator.random((n, n)) < share, 1))
    return edges[generator.permutation(len(edges))]


def integer_matrix(
    n: int, m: int, q: int, share: float, generator: np.random.Generator, few: int = 0
) -> tuple[BlockMatrix, Array]:
    """J'J of integers, which is exact, for residuals of two frames and the tail each; and a null vector of it.

    Every residual is zero for the null vector: it is 1 for every variable, and each row of J sums to zero.
    """
    edges = random_edges(n, share, generator)
    frames, tails = np.zeros((n, m, m)), np.zeros((n, m, q))
    couplings, tail = np.zeros((len(edges), m, m)), np.zeros((q, q))
    pairs = [*(tuple(edge) for edge in edges.tolist()), *((i, i) for i in range(n))]
    for e, (i, j) in enumerate(pairs):
        J = generator.integers(-3, 4, (m + 1, 2 * m + q)).astype(float)
        if i == j:
            J[:, m : 2 * m] = 0.0
        J[:, 0] -= J.sum(axis=1)
        Ji, Jj, Jq = J[:, :m], J[:, m : 2 * m], J[:, 2 * m :]
        frames[i] += Ji.T @ Ji
        tails[i] += Ji.T @ Jq
        if i != j:
            frames[j] += Jj.T @ Jj
            tails[j] += Jj.T @ Jq
            couplings[e] = Ji.T @ Jj
        tail += Jq.T @ Jq
    order = Elimination.of(n, edges[:, 0], edges[:, 1], few=few)
    return BlockMatrix(order, frames, couplings, tails, tail), np.ones(n * m + q)


@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 40),
    m=st.integers(1, 4),
    q=st.integers(0, 2),
    share=st.sampled_from([0.0, 0.03, 0.1, 0.4]),
    few=st.sampled_from([0, 5]),
)
@settings(max_examples=60, deadline=None)
def test_products_factors_and_solutions_are_those_of_the_dense_matrix(
    seed: int, n: int, m: int, q: int, share: float, few: int
) -> None:
    generator = np.random.default_rng(seed)
    matrix, _ = integer_matrix(n, m, q, share, generator, few)
    matrix = matrix.plus(np.ones(matrix.size))
    full = matrix.dense()
    v = generator.standard_normal(matrix.size)
    np.testing.assert_array_equal(full, full.T)
    np.testing.assert_allclose(matrix.times(v), full @ v, atol=1e-11 * np.abs(full).max())
    np.testing.assert_allclose(matrix.sizes(v), np.abs(full) @ np.abs(v), rtol=1e-13)
    factor = matrix.factor()
    assert factor is not None
    np.testing.assert_allclose(full @ factor.solve_vector(v), v, atol=1e-9)
    assert 2.0 * np.log(factor.pivots).sum() == pytest.approx(np.linalg.slogdet(full)[1], abs=1e-9)
    unit = generator.uniform(0.5, 2.0, matrix.size)
    np.testing.assert_allclose(matrix.scaled(unit).dense(), full * unit[:, None] * unit, rtol=1e-14)


@given(
    seed=st.integers(0, 10**6),
    n=st.integers(2, 30),
    m=st.integers(1, 3),
    q=st.integers(0, 1),
    share=st.sampled_from([0.05, 0.2]),
    exponent=st.integers(20, 46),
)
@settings(max_examples=60, deadline=None)
def test_the_proof_is_not_fooled_and_not_timid(seed: int, n: int, m: int, q: int, share: float, exponent: int) -> None:
    """A matrix that is singular exactly, a little below, and above by a few times the allowance."""
    matrix, null = integer_matrix(n, m, q, share, np.random.default_rng(seed))
    assert not matrix.times(null).any()  # integers: exact
    shift = 2.0**-exponent
    assert proof_that_it_exceeds(matrix) is None
    assert proof_that_it_exceeds(matrix, shift) is None
    assert proof_that_it_exceeds(matrix, np.where(np.arange(matrix.size) == 0, shift, -0.0)) is None
    room = 4.0 * float(cholesky_allowance(matrix, matrix.diagonal).max()) + 1e-14 * float(matrix.diagonal.max())
    assert proof_that_it_exceeds(matrix, -room) is not None


@pytest.mark.parametrize("seed", range(6))
def test_the_allowance_covers_the_error_of_a_factorisation_that_follows_the_graph(seed: int) -> None:
    """A + dA = L L' in exact arithmetic, with the factor as it is: diag(allowance) - dA and + dA are definite."""
    generator = np.random.default_rng(seed)
    matrix, _ = integer_matrix(9, 2, 1, 0.3, generator)
    matrix = matrix.plus(generator.uniform(0.5, 1.0, matrix.size))
    factor = matrix.factor()
    assert factor is not None
    lower = exact.fractions(np.zeros((matrix.size, matrix.size)))
    order, m, q = matrix.order, 2, 1
    sequence = [int(i) for group in order.groups for i in group.frames] + order.rest.tolist()
    place = {frame: k for k, frame in enumerate(sequence)}
    at = np.array([m * frame + i for frame in sequence for i in range(m)] + list(range(9 * m, 9 * m + q)))
    for group, own, rows in zip(order.groups, factor.frames, factor.rows, strict=True):
        for k, frame in enumerate(group.frames):
            begin = m * place[int(frame)]
            lower[begin : begin + m, begin : begin + m] = exact.fractions(own[k])
            for d, other in enumerate(group.neighbours[k]):
                if other < order.n:
                    below = m * place[int(other)]
                    block = rows[k][:, d * m : d * m + m]
                    lower[below : below + m, begin : begin + m] = exact.fractions(np.ascontiguousarray(block.T))
            lower[9 * m :, begin : begin + m] = exact.fractions(np.ascontiguousarray(rows[k][:, -q:].T))
    begin = len(at) - len(factor.rest)
    lower[begin:, begin:] = exact.fractions(np.tril(factor.rest))
    error = exact.fractions(matrix.dense()[np.ix_(at, at)]) - lower @ lower.T
    allowance = exact.fractions(np.diag(cholesky_allowance(matrix, matrix.diagonal)[at]))
    assert (error != Fraction(0)).any()
    assert exact.is_positive_definite(allowance - error)
    assert exact.is_positive_definite(allowance + error)


@pytest.mark.parametrize(
    ("edges", "rest"),
    [
        ([(i, 40 + k) for i in range(40) for k in range(3)], [40, 41, 42]),  # a star: the leaves at once
        ([(i, i + 1) for i in range(199)], []),  # a chain
        ([(i, j) for i in range(40) for j in range(i + 1, 40)], list(range(40))),  # all with all
    ],
    ids=["star", "chain", "complete"],
)
def test_the_order_makes_no_needless_fill(edges: list[tuple[int, int]], rest: list[int]) -> None:
    first, second = np.array(edges).T
    n = int(second.max()) + 1
    order = Elimination.of(n, first, second, few=3)
    assert set(rest) <= set(order.rest.tolist())
    assert len(order.rest) <= max(len(rest), 3)
    assert len(order.first) <= 2 * len(edges)
    eliminated = np.concatenate([group.frames for group in order.groups] + [order.rest])
    np.testing.assert_array_equal(np.sort(eliminated), np.arange(n))


def test_the_allowance_of_a_star_does_not_grow_with_the_square_of_its_leaves() -> None:
    leaves = 3000
    first, second = np.repeat(np.arange(leaves), 2), leaves + np.tile([0, 1], leaves)
    of_frames, of_tail = Elimination.of(leaves + 2, first, second).spread(13, 1)
    size = 13 * (leaves + 2) + 1
    assert of_frames[:leaves].max() < 1e-12
    assert max(of_frames.max(), of_tail) < 0.05 * size**2 * 2.0**-53


def test_sums_into_rows_that_are_named_more_than_once() -> None:
    result = np.zeros((4, 2))
    sum_into(result, np.array([2, 0, 2]), np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]), -1.0)
    np.testing.assert_array_equal(result, [[-3.0, -4.0], [0.0, 0.0], [-6.0, -8.0], [0.0, 0.0]])
    sum_into(result, np.array([3, 1]), np.ones((2, 2)))
    np.testing.assert_array_equal(result[[1, 3]], np.ones((2, 2)))
