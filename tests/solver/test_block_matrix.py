"""Matrices that follow a graph: the same products and solutions as dense ones, and proofs that are never fooled."""

from __future__ import annotations

from fractions import Fraction

import exact_arithmetic as exact
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.rounding import UNIT, gamma
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


def arrow_matrix(D: Array, C: Array, E: Array) -> BlockMatrix:
    """An arrow matrix whose leaves are eliminated one by one, and whose border is dense."""
    none = np.zeros(0, dtype=int)
    order = Elimination.of(len(D), none, none, few=0)
    return BlockMatrix(order, D, np.zeros((0, *D.shape[1:])), C, E)


def dense_matrix(matrix: Array) -> BlockMatrix:
    return arrow_matrix(np.zeros((0, 1, 1)), np.zeros((0, 1, len(matrix))), matrix)


def is_positive_definite(matrix: Array) -> bool:
    return proof_that_it_exceeds(dense_matrix(matrix)) is not None


def arrow_is_positive_definite(D: Array, C: Array, E: Array, of_leaves: Array, of_border: Array) -> bool:
    return proof_that_it_exceeds(arrow_matrix(D, C, E), np.r_[of_leaves.ravel(), of_border]) is not None


def singular_integers(size: int, rank: int, seed: int, largest: int = 3) -> Array:
    """V V' of integers, V (size, rank), every sum below 2^53: eigenvalue 0 exactly, size - rank times."""
    V = np.random.default_rng(seed).integers(-largest, largest + 1, (size, rank)).astype(float)
    return V @ V.T


def large_integers(size: int, seed: int) -> Array:
    """The same of rank size - 1, as large as doubles hold exactly."""
    return singular_integers(size, size - 1, seed, largest=int(np.sqrt(2.0**52 / size)))


@pytest.mark.parametrize("below", [1, 4, 16, 64, 256, 1024])
@pytest.mark.parametrize("size", [2, 3, 5, 10, 19, 40])
def test_an_eigenvalue_just_below_zero_does_not_pass(size: int, below: int) -> None:
    """From -1e-16 to -1e-13 of the largest, exactly -below."""
    for seed in range(20):
        singular = large_integers(size, seed)
        matrix = singular - below * np.eye(size)
        np.testing.assert_array_equal(singular - matrix, below * np.eye(size))  # nothing was rounded
        if size <= 10:
            assert not exact.is_positive_definite(exact.fractions(matrix))
        assert not is_positive_definite(matrix)


@pytest.mark.parametrize("size", [3, 5, 10, 19, 40])
def test_what_fools_a_plain_factorisation_does_not_pass(size: int) -> None:
    """One unit in the last place off one entry: LAPACK's factorisation runs through in many of these."""
    fooled = 0
    for seed in range(60):
        matrix = large_integers(size, seed)
        null = np.linalg.eigh(matrix)[1][:, 0]
        at = int(np.abs(null).argmin())
        matrix[at, at] -= 1.0  # v' A v = -v_at^2 for the exact null vector v
        assert not is_positive_definite(matrix)
        try:
            np.linalg.cholesky(matrix)
        except np.linalg.LinAlgError:
            continue
        fooled += 1
    assert fooled > 5


@pytest.mark.parametrize("seed", range(20))
def test_scaling_by_powers_of_two_hides_nothing(seed: int) -> None:
    """D A D with D from 2^-40 to 2^40 has the inertia of A, exactly, and condition numbers beyond 1e40."""
    generator = np.random.default_rng(seed)
    matrix = large_integers(12, seed) - 4.0 * np.eye(12)
    d = 2.0 ** generator.integers(-40, 41, 12)
    assert not is_positive_definite(d[:, None] * matrix * d)
    definite = singular_integers(12, 11, seed) + 2.0**-20 * np.eye(12)
    assert is_positive_definite(d[:, None] * definite * d)


@pytest.mark.parametrize("size", [1, 2, 5, 19, 40, 217])
@pytest.mark.parametrize("seed", range(5))
def test_clearly_definite_passes(size: int, seed: int) -> None:
    """Down to smallest eigenvalues that are a few times the allowance, N^2 u of the diagonal."""
    matrix = singular_integers(size, size - 1, seed) if size < 217 else 9.0 * np.eye(size)
    assert is_positive_definite(matrix + np.eye(size))
    room = 4.0 * size * (size + 2) * UNIT * float(np.diagonal(matrix).max() + 1.0)
    assert is_positive_definite(matrix + room * np.eye(size))


@given(seed=st.integers(0, 10**6), size=st.integers(1, 8), shift=st.integers(-400, 400), spread=st.integers(0, 12))
@settings(max_examples=150, deadline=None)
def test_what_passes_is_definite(seed: int, size: int, shift: int, spread: int) -> None:
    """Random, rounded, nearly singular and badly scaled matrices: passing implies exact definiteness."""
    generator = np.random.default_rng(seed)
    V = generator.standard_normal((size, size)) * 10.0 ** generator.uniform(-spread, 0, (size, 1))
    V[:, 0] = V[:, -1]  # singular before rounding
    matrix = V @ V.T
    matrix = np.tril(matrix) + np.tril(matrix, -1).T
    matrix += shift * UNIT * np.diag(np.diagonal(matrix))
    if is_positive_definite(matrix):
        assert exact.is_positive_definite(exact.fractions(matrix))


@given(st.lists(st.floats(-1e3, 1e3), min_size=6, max_size=6))
@example([1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
@example([5e-324, 0.0, 5e-324, 0.0, 0.0, 5e-324])
@settings(max_examples=300, deadline=None)
def test_any_three_by_three(entries: list[float]) -> None:
    matrix = np.zeros((3, 3))
    matrix[np.tril_indices(3)] = entries
    matrix += np.tril(matrix, -1).T
    if is_positive_definite(matrix):
        assert exact.is_positive_definite(exact.fractions(matrix))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("at", [(0, 0), (2, 0), (2, 2), (39, 20)])
def test_what_is_not_a_number_is_not_definite(value: float, at: tuple[int, int]) -> None:
    matrix = 4.0 * np.eye(40)
    matrix[at] = matrix[at[::-1]] = value
    with np.errstate(invalid="ignore"):
        assert not is_positive_definite(matrix)


@pytest.mark.parametrize("scale", [1e-300, 1e-200, 1e-100, 1e100, 1e200, 1e280])
def test_extreme_scales_fool_nobody(scale: float) -> None:
    """Powers of ten are not exact, so exactness judges; where numbers underflow, it refuses."""
    for seed in range(10):
        matrix = scale * (large_integers(6, seed) - 4.0 * np.eye(6))
        if is_positive_definite(matrix):
            assert exact.is_positive_definite(exact.fractions(matrix))
    assert is_positive_definite(scale * 4.0 * np.eye(6)) or scale < 1e-280


def dense_arrow(D: Array, C: Array, E: Array) -> Array:
    """Blocks D (L, m, m) that are coupled with a border E (b, b) alone, by C (L, m, b), as one array."""
    L, m = D.shape[:2]
    full = np.zeros((L * m + len(E),) * 2)
    np.einsum("lilj->lij", full[: L * m, : L * m].reshape(L, m, L, m))[...] = D
    full[: L * m, L * m :] = C.reshape(L * m, len(E))
    full[L * m :, : L * m], full[L * m :, L * m :] = full[: L * m, L * m :].T, E
    return full


def arrow_below_zero(leaves: int, m: int, b: int, seed: int, shift: float) -> tuple[Array, Array, Array]:
    """An arrow matrix of integers, singular, minus shift I: V V' where leaves share no column of V but with the border.

    The border's part has one column too few, which leaves a null vector.
    """
    generator = np.random.default_rng(seed)
    of_leaf = generator.integers(-3, 4, (leaves, m, m)).astype(float)
    to_border = generator.integers(-3, 4, (leaves, b, m)).astype(float)
    own = generator.integers(-3, 4, (b, b - 1)).astype(float)
    D = of_leaf @ of_leaf.transpose(0, 2, 1) - shift * np.eye(m)
    C = of_leaf @ to_border.transpose(0, 2, 1)
    E = own @ own.T + (to_border @ to_border.transpose(0, 2, 1)).sum(axis=0) - shift * np.eye(b)
    return D, C, E


@given(seed=st.integers(0, 10**6), relative=st.integers(-60, 60))
@settings(max_examples=100, deadline=None)
def test_margins_are_proven_exactly(seed: int, relative: int) -> None:
    """arrow - diag(margin) for margins of either sign around what makes it singular."""
    generator = np.random.default_rng(seed)
    margins = generator.uniform(0.5, 2.0, (3, 2)), generator.uniform(0.5, 2.0, 3)
    D, C, E = arrow_below_zero(3, 2, 3, seed, 0.0)
    sign = float(generator.choice([-1.0, 1.0]))
    # Singular but for rounding once the margin is taken off; then a few units of rounding on top.
    D = D + sign * np.array([np.diag(row) for row in margins[0]])
    E = E + sign * np.diag(margins[1])
    D *= 1.0 + relative * UNIT
    E *= 1.0 + relative * UNIT
    if arrow_is_positive_definite(D, C, E, sign * margins[0], sign * margins[1]):
        taken = exact.fractions(np.diag(sign * np.r_[margins[0].ravel(), margins[1]]))
        assert exact.is_positive_definite(exact.fractions(dense_arrow(D, C, E)) - taken)


def test_gamma_refuses_what_it_cannot_bound() -> None:
    with pytest.raises(OverflowError, match="too many"):
        gamma(100, unit=0.01)
