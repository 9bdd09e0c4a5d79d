"""The small dual: Z x = 0 is kept, what it says it reached is reached, and it certifies where R'R = I cannot."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.linalg
from small_problems import GROSS_NOISE, bound_at, flat, multipliers_at, optimum, reduced, simulated, whole

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.simulate import Motion
from gtsam_rwhec.solver.descent import homogeneous
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import CONSTRAINTS, random_rotations
from gtsam_rwhec.solver.small_dual import (
    ENOUGH,
    gather,
    gram,
    improve,
    local_indices,
    null_multipliers,
    scatter,
    stationary_multipliers,
    traces,
)


def symmetric(size: int, generator: np.random.Generator) -> Array:
    M = generator.standard_normal((size, size))
    return M + M.T


def random_family(n: int, c: int, generator: np.random.Generator) -> Array:
    M = generator.standard_normal((n, c, 10, 10))
    return M + M.transpose(0, 1, 3, 2)


def whole_matrix(block: Array, i: int, n: int) -> Array:
    """One local matrix (10, 10) in its place."""
    full = np.zeros((9 * n + 1, 9 * n + 1))
    at = np.r_[9 * i : 9 * i + 9, 9 * n]
    full[np.ix_(at, at)] = block
    return full


@pytest.mark.parametrize("n", [1, 2, 5])
def test_scatter_adds_local_matrices_and_gather_takes_them(n: int) -> None:
    generator = np.random.default_rng(n)
    blocks = random_family(n, 1, generator)[:, 0]
    np.testing.assert_allclose(
        scatter(blocks), sum(whole_matrix(block, i, n) for i, block in enumerate(blocks)), atol=1e-15
    )
    W = symmetric(9 * n + 1, generator)
    for i, (block, at) in enumerate(zip(gather(W), local_indices(n), strict=True)):
        np.testing.assert_array_equal(block, W[np.ix_(at, at)])
        assert at[-1] == 9 * n
        assert list(at[:9]) == list(range(9 * i, 9 * i + 9))


@pytest.mark.parametrize("n", [1, 2, 4])
def test_traces_by_plain_loops(n: int) -> None:
    generator = np.random.default_rng(n)
    family, W = random_family(n, 3, generator), symmetric(9 * n + 1, generator)
    expected = [[np.trace(whole_matrix(A, i, n) @ W) for A in family[i]] for i in range(n)]
    np.testing.assert_allclose(traces(family, W), expected, atol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("constraints", [True, False])
def test_gram_by_plain_loops(n: int, constraints: bool) -> None:
    """tr(A_p W A_q V) for two different symmetric matrices, in both orders."""
    generator = np.random.default_rng(n)
    family = np.broadcast_to(CONSTRAINTS, (n, 20, 10, 10)) if constraints else random_family(n, 3, generator)
    W, V = symmetric(9 * n + 1, generator), symmetric(9 * n + 1, generator)
    every = [whole_matrix(A, i, n) for i in range(n) for A in family[i]]
    expected = np.array([[np.trace(A @ W @ B @ V) for B in every] for A in every])
    result = gram(family, W, V)
    np.testing.assert_allclose(result, 0.5 * (expected + expected.T), atol=1e-10)
    np.testing.assert_allclose(result, gram(family, V, W), atol=1e-10)


POORLY_EXCITED = Motion("planar", wobble_rad=0.01)


def certificate_matrix(form: ReducedForm, multipliers: Array, cost: float) -> Array:
    """Z, with the cost taken off h's entry: Z x = 0 at a critical point."""
    Z = form.Q - scatter(np.einsum("nk,kpq->npq", multipliers, CONSTRAINTS))
    Z[-1, -1] -= cost
    return Z


@pytest.mark.parametrize("seed", range(3))
def test_null_multipliers_are_fourteen_a_rotation_and_leave_x_alone(seed: int) -> None:
    R = random_rotations(3, np.random.default_rng(seed))
    null = null_multipliers(R)
    assert null.shape == (3, 14, 20)
    np.testing.assert_allclose(null @ null.transpose(0, 2, 1), np.broadcast_to(np.eye(14), (3, 14, 14)), atol=1e-12)
    local = np.c_[flat(R).reshape(3, 9), np.ones(3)]
    np.testing.assert_allclose(np.einsum("nmk,kpq,nq->nmp", null, CONSTRAINTS, local), 0.0, atol=1e-12)


@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
@pytest.mark.parametrize("seed", range(6))
def test_z_x_stays_zero_and_the_measure_is_reached(seed: int, scale: ScaleMode) -> None:
    problem = simulated(2, 1, seed, motion=POORLY_EXCITED, scale=scale).problem
    form, end = reduced(problem), optimum(problem)
    x = homogeneous(end.R)
    kkt = multipliers_at(form, end.R)
    multipliers, t = improve(form.Q, end.R, kkt)
    before, after = (certificate_matrix(form, m, end.cost) for m in (kkt, multipliers))
    scale_of = float(np.abs(np.diagonal(before)).max())
    np.testing.assert_allclose(after @ x, 0.0, atol=1e-9 * scale_of)
    # t: the smallest generalised eigenvalue against P = Q' (and a little more) across x, in P's own measure.
    P = form.Q
    P[np.diag_indices_from(P)] += 1e-9 * np.abs(np.diagonal(P)) + 1e-12 * scale_of
    across = scipy.linalg.null_space((P @ x)[None])
    reached = scipy.linalg.eigh(across.T @ after @ across, across.T @ P @ across, eigvals_only=True)[0]
    started = scipy.linalg.eigh(across.T @ before @ across, across.T @ P @ across, eigvals_only=True)[0]
    assert reached >= t - 1e-6 * max(1.0, abs(t))
    assert reached >= min(ENOUGH, started - 0.2 * max(abs(started), 1e-3))  # it stops at enough


def test_it_certifies_where_the_multipliers_of_orthogonality_do_not() -> None:
    """Of poorly excited problems nearly all need it (design fact 4a), and it suffices for most."""
    needed = helped = 0
    for seed in range(12):
        problem = simulated(1, 1, seed, motion=POORLY_EXCITED, noise=GROSS_NOISE).problem
        form, end = reduced(problem), optimum(problem)
        tolerance = 1e-6 * max(end.cost, 1.0)
        kkt = multipliers_at(form, end.R)
        if end.cost - bound_at(whole(problem), end.R)[0].lower_bound > tolerance:
            needed += 1
            multipliers, _ = improve(form.Q, end.R, kkt)
            helped += end.cost - bound_at(whole(problem), end.R, multipliers)[0].lower_bound <= tolerance
    assert needed >= 8
    assert helped >= 0.75 * needed


def test_at_a_local_minimum_it_cannot_certify() -> None:
    problem = simulated(1, 1, 2, noise=GROSS_NOISE, number_of_measurements=4).problem
    form, start = reduced(problem), optimum(problem)  # the spectral start leads to a local minimum here
    multipliers, t = improve(form.Q, start.R, multipliers_at(form, start.R))
    assert t < 0.0
    assert bound_at(whole(problem), start.R, multipliers)[0].lower_bound < start.cost - 1e-3


@pytest.mark.parametrize("seed", range(4))
def test_stationary_multipliers_are_the_nearest_with_z_x_zero(seed: int) -> None:
    problem = simulated(2, 1, seed).problem
    form, end = reduced(problem), optimum(problem)
    generator = np.random.default_rng(seed)
    given = multipliers_at(form, end.R) + form.magnitude * generator.standard_normal((3, 20))
    x = homogeneous(end.R)
    gradient = form.apply(x)[:-1].reshape(-1, 9)
    polished = stationary_multipliers(gradient, end.R, given)
    rest = certificate_matrix(form, polished, end.cost) @ x
    np.testing.assert_allclose(rest[:-1], 0.0, atol=1e-9 * form.magnitude)
    # What was added is orthogonal to everything that keeps Z x: no nearer ones exist.
    along = np.einsum("nmk,nk->nm", null_multipliers(end.R), polished - given)
    np.testing.assert_allclose(along, 0.0, atol=1e-9 * form.magnitude)
    np.testing.assert_allclose(stationary_multipliers(gradient, end.R, polished), polished, atol=1e-9 * form.magnitude)


def test_a_form_that_rounding_made_negative_has_no_measure() -> None:
    form = reduced(simulated(2, 1, noise=None).problem)
    below = dataclasses.replace(form, Q=form.Q - 1e-7 * form.magnitude * np.eye(form.size))
    R = optimum(simulated(2, 1, noise=None).problem).R
    given = multipliers_at(below, R)
    multipliers, t = improve(below.Q, R, given)
    assert t == -np.inf
    np.testing.assert_array_equal(multipliers, given)
