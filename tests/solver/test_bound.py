"""Lower bounds against exact arithmetic: whatever the multipliers and the point, no feasible point costs less."""

from __future__ import annotations

from fractions import Fraction
from functools import cache

import exact_arithmetic as exact
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_problems import GROSS_NOISE, SMALL_NOISE, flat, multipliers_at, optimum, reduced, simulated

import gtsam_rwhec as rw
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver import small_dual
from gtsam_rwhec.solver.bound import Bound, exact_value, lower_bound
from gtsam_rwhec.solver.descent import Descent, homogeneous
from gtsam_rwhec.solver.local_blocks import scatter
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.relaxation import solve_relaxation
from gtsam_rwhec.solver.rotations import CONSTRAINTS, random_rotations


def assert_below(bound: Bound, cost: Fraction) -> None:
    assert bound.lower_bound == -np.inf or Fraction(bound.lower_bound) <= cost


def badly_scaled(seed: int, scale: str) -> rw.Problem:
    """Two targets, two sensors, sigma from 0.1 mm to 10 m and kappa from 1 to 1e6, pair by pair."""
    generator = np.random.default_rng(seed)
    noise = {
        (f"target{j}", f"sensor{k}"): Noise(10.0 ** generator.uniform(-4, 1), 10.0 ** generator.uniform(0, 6))
        for j in range(2)
        for k in range(2)
    }
    return general(2, 2, seed=seed, noise=noise, number_of_measurements=8, scale=scale).problem


def joined_by_scale(seed: int) -> rw.Problem:
    """Two pairs that share nothing but their scale."""
    return simulated(2, 2, seed, graph=[(0, 0), (1, 1)], scale="shared").problem


def planar(seed: int, scale: str) -> rw.Problem:
    return simulated(2, 1, seed, motion="planar", scale=scale).problem


def with_motion_and_priors(seed: int, scale: str) -> rw.Problem:
    simulation = simulated(2, 1, seed, odometry=5, odometry_noise=SMALL_NOISE, scale=scale)
    for name, T in simulation.X.items():
        simulation.problem.add_prior(name, T, sigma=0.02, kappa=300.0)
    return simulation.problem


PROBLEMS = {
    "known": lambda seed: simulated(2, 1, seed).problem,
    "shared": lambda seed: simulated(1, 2, seed, scale="shared").problem,
    "per target": lambda seed: simulated(2, 1, seed, scale="per_target").problem,
    "badly scaled, known": lambda seed: badly_scaled(seed, "known"),
    "badly scaled, shared": lambda seed: badly_scaled(seed, "shared"),
    "joined by scale": joined_by_scale,
    "planar, known": lambda seed: planar(seed, "known"),
    "planar, shared": lambda seed: planar(seed, "shared"),
    "no noise": lambda seed: simulated(2, 1, seed, noise=None).problem,
    "gross noise": lambda seed: simulated(1, 1, seed, noise=GROSS_NOISE, number_of_measurements=4).problem,
    "motion and priors": lambda seed: with_motion_and_priors(seed, "known"),
    "motion and priors, turned round": lambda seed: with_motion_and_priors(seed, "shared"),
}
SEEDS = range(2)


@cache
def solved(name: str, seed: int) -> tuple[ReducedForm, Descent, Fraction]:
    """The form, the end of the descent, and the optimum: exactly but for some 40 digits, and never below it."""
    problem = PROBLEMS[name](seed)
    form, end = reduced(problem), optimum(problem)
    return form, end, exact.lowest_cost(form, end.R)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", PROBLEMS)
def test_kkt_bound_is_below_the_polished_optimum_and_close(name: str, seed: int) -> None:
    form, end, cost = solved(name, seed)
    bound = lower_bound(form, multipliers_at(form, end.R), flat(end.R))
    assert_below(bound, cost)
    if bound.definite:
        assert float(cost - Fraction(bound.lower_bound)) <= 1e-14 * form.magnitude
        assert bound.eigenvalue > 0.0
        assert bound.direction is None
    if bound.semidefinite:
        assert float(cost - Fraction(bound.lower_bound)) <= 1e-10 * form.magnitude


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", PROBLEMS)
def test_any_multipliers_at_any_point_bound_the_optimum(name: str, seed: int) -> None:
    """Of every size; those of h-coupled constraints too; points that are rotations and points that are none."""
    form, end, cost = solved(name, seed)
    generator = np.random.default_rng(seed)
    n = form.rotations
    kkt = multipliers_at(form, end.R)
    for _ in range(4):
        size = form.magnitude * 10.0 ** generator.uniform(-16, 0)
        random = size * generator.standard_normal((n, 20))
        orthogonality = np.where(np.arange(20) < 11, random, 0.0)
        shift = size * np.r_[1.0, 1.0, 1.0, np.zeros(17)]
        points = (
            flat(end.R),
            flat(random_rotations(n, generator)),
            generator.standard_normal(9 * n) * 10.0 ** generator.uniform(-3, 3),
            np.zeros(9 * n),
        )
        for multipliers in (random, kkt + random, kkt + orthogonality, kkt + shift, kkt - shift, np.zeros((n, 20))):
            for point in points:
                assert_below(lower_bound(form, multipliers, point), cost)


@pytest.mark.parametrize("name", PROBLEMS)
def test_no_feasible_point_costs_less(name: str) -> None:
    """At exact rotations all over SO(3)^n, in exact arithmetic."""
    form, end, _ = solved(name, 0)
    bound = lower_bound(form, multipliers_at(form, end.R), flat(end.R))
    Q = exact.stored_matrix(form)
    generator = np.random.default_rng(0)
    for _ in range(20):
        assert_below(bound, exact.cost(Q, exact.random_quaternions(form.rotations, generator)))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["known", "shared", "gross noise", "joined by scale"])
def test_small_duals_and_relaxations_multipliers_bound_the_optimum(name: str, seed: int) -> None:
    form, end, cost = solved(name, seed)
    relaxation = solve_relaxation(form.dense(), 1e-8, 100)
    improved, _ = small_dual.improve(form, end.R, multipliers_at(form, end.R))
    assert_below(lower_bound(form, improved, flat(end.R)), cost)
    assert_below(lower_bound(form, relaxation.multipliers, relaxation.X[:-1, -1]), cost)
    assert_below(lower_bound(form, relaxation.multipliers, flat(end.R)), cost)


@pytest.mark.parametrize("factor", [1.0, 3.0, 100.0])
@pytest.mark.parametrize("name", ["planar, known", "gross noise"])
def test_points_outside_the_unit_balls_do_not_break_the_slack_branch(name: str, factor: float) -> None:
    """z = y - r is as long as r is; a bound that took |z| <= 2 sqrt(3) for granted would claim too much."""
    form, end, cost = solved(name, 1)
    shift = 1e-6 * form.magnitude * np.r_[1.0, 1.0, 1.0, np.zeros(17)]
    bound = lower_bound(form, multipliers_at(form, end.R) + shift, factor * flat(end.R))
    assert not bound.definite
    assert_below(bound, cost)


class TestBranches:
    """Every branch is really taken by the problems above."""

    def test_definite(self) -> None:
        form, end, _ = solved("known", 0)
        bound = lower_bound(form, multipliers_at(form, end.R), flat(end.R))
        assert bound.definite
        assert bound.semidefinite
        assert bound.lower_bound < bound.value

    @pytest.mark.parametrize("name", ["shared", "joined by scale", "badly scaled, shared"])
    def test_pinned(self, name: str) -> None:
        """Nothing couples to h, and Z has the null vector r: one entry short of definite."""
        form, end, _ = solved(name, 0)
        dense = form.dense()
        assert not dense[-1].any()
        kkt = multipliers_at(form, end.R)
        bound = lower_bound(form, kkt, flat(end.R))
        assert bound.definite
        # Multipliers that couple r to h close that branch.
        kkt[0, 12] = 1e-300
        assert not lower_bound(form, kkt, flat(end.R)).definite

    @pytest.mark.parametrize("scale", ["known", "shared"])
    def test_slack(self, scale: str) -> None:
        """On planar motion Z is semidefinite and no more, without a direction to go down."""
        form, end, _ = solved(f"planar, {scale}", 0)
        bound = lower_bound(form, multipliers_at(form, end.R), flat(end.R))
        assert not bound.definite
        assert bound.semidefinite
        assert bound.direction is None
        assert bound.eigenvalue < 0.0

    def test_negative(self) -> None:
        """At a point that is no optimum Z has a negative eigenvalue: it is found, bounded, and its vector given."""
        form, _, _ = solved("known", 0)
        R = random_rotations(form.rotations, np.random.default_rng(0))
        kkt = multipliers_at(form, R)
        bound = lower_bound(form, kkt, flat(R))
        assert not bound.semidefinite
        assert bound.direction is not None
        Z = dense_curvature(form, kkt)
        smallest = np.linalg.eigvalsh(Z)[0]
        assert bound.eigenvalue <= smallest < 0.0
        assert bound.eigenvalue >= 1.1 * smallest
        assert bound.direction @ Z @ bound.direction == pytest.approx(smallest)


def dense_curvature(form: ReducedForm, multipliers: Array) -> Array:
    """Z_rr in floating point."""
    Z: Array = form.dense() - scatter(np.einsum("nk,kpq->npq", multipliers, CONSTRAINTS))
    return Z[:-1, :-1]


@pytest.mark.parametrize("scale", ["known", "shared"])
def test_large_problems_find_their_negative_eigenvalue_by_lanczos(scale: str) -> None:
    """Above the size of dense eigenvalues (700): the bound still holds and the direction still goes down."""
    simulation = simulated(60, 20, 1, graph="random", scale=scale)
    form = reduced(simulation.problem)
    assert form.size > 701
    R = random_rotations(form.rotations, np.random.default_rng(0))
    kkt = multipliers_at(form, R)
    bound = lower_bound(form, kkt, flat(R))
    Z = dense_curvature(form, kkt)
    assert np.isfinite(bound.lower_bound)
    assert bound.lower_bound < optimum(simulation.problem).cost
    assert bound.direction is not None
    assert bound.direction @ Z @ bound.direction == pytest.approx(np.linalg.eigvalsh(Z)[0], rel=1e-3)


def test_numbers_that_are_none_prove_nothing() -> None:
    form, end, _ = solved("known", 0)
    multipliers = multipliers_at(form, end.R)
    multipliers[0, 0] = np.nan
    for bound in (
        lower_bound(form, multipliers, flat(end.R)),
        lower_bound(form, multipliers_at(form, end.R), np.full(9 * form.rotations, np.inf)),
    ):
        assert bound.lower_bound == -np.inf
        assert not bound.definite


@pytest.mark.parametrize("name", PROBLEMS)
def test_cost_in_extended_precision_is_within_its_stated_error(name: str) -> None:
    form, end, _ = solved(name, 0)
    x = homogeneous(end.R)
    value, error = exact_value(form, x)
    true = exact.fractions(x) @ (exact.stored_matrix(form) @ exact.fractions(x))
    assert abs(Fraction(value) - true) <= Fraction(error)
    assert error <= 1e-14 * form.magnitude


@given(
    seed=st.integers(0, 10**6),
    targets=st.integers(1, 2),
    sensors=st.integers(1, 2),
    scale=st.sampled_from(["known", "shared", "per_target"]),
    motion=st.sampled_from(["general", "planar", "single_axis", "none"]),
    sigma=st.floats(-4.0, 1.0),
    kappa=st.floats(-1.0, 6.0),
    log_size=st.floats(-18.0, 0.0),
)
@settings(max_examples=40, deadline=None)
def test_bounds_hold_on_any_small_problem(
    seed: int, targets: int, sensors: int, scale: str, motion: str, sigma: float, kappa: float, log_size: float
) -> None:
    noise = Noise(10.0**sigma, 10.0**kappa)
    problem = simulated(
        targets, sensors, seed, scale=scale, motion=motion, noise=noise, number_of_measurements=5
    ).problem
    form, end = reduced(problem), optimum(problem)
    cost = exact.lowest_cost(form, end.R)
    multipliers = multipliers_at(form, end.R)
    assert_below(lower_bound(form, multipliers, flat(end.R)), cost)
    generator = np.random.default_rng(seed)
    multipliers += 10.0**log_size * form.magnitude * generator.standard_normal(multipliers.shape)
    assert_below(lower_bound(form, multipliers, flat(end.R)), cost)
    assert_below(lower_bound(form, multipliers, flat(random_rotations(form.rotations, generator))), cost)
