"""Lower bounds: whatever the multipliers and the point, no answer costs less; and optimal ones lose nothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_problems import GROSS_NOISE, SMALL_NOISE, bound_at, kkt_of, optimum, simulated, whole

import gtsam_rwhec as rw
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver.answers import Point, answer_at
from gtsam_rwhec.solver.bound import Bound, lower_bound
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.region import extent_of, half_widths
from gtsam_rwhec.solver.relaxation import solve_relaxation
from gtsam_rwhec.solver.rotations import random_rotations, vec
from gtsam_rwhec.solver.small_dual import improve


def badly_scaled(seed: int, scale: str) -> rw.Problem:
    """Two targets, two sensors, sigma from 0.1 mm to 10 m and kappa from 1 to 1e6, pair by pair."""
    generator = np.random.default_rng(seed)
    noise = {
        (f"target{j}", f"sensor{k}"): Noise(10.0 ** generator.uniform(-4, 1), 10.0 ** generator.uniform(0, 6))
        for j in range(2)
        for k in range(2)
    }
    return general(2, 2, seed=seed, noise=noise, number_of_measurements=8, scale=scale).problem


def with_motion_and_priors(seed: int, scale: str) -> rw.Problem:
    simulation = simulated(2, 1, seed, odometry=5, odometry_noise=SMALL_NOISE, scale=scale)
    for name, T in simulation.X.items():
        simulation.problem.add_prior(name, T, sigma=0.02, kappa=300.0)
    return simulation.problem


def without_raw_measurements(problem: rw.Problem) -> rw.Problem:
    """The same problem from its moments."""
    lean = rw.Problem(problem.scale, keep_measurements=False)
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        lean.add(*pair, raw.A, raw.B, raw.sigma, raw.kappa)
    return lean


PROBLEMS = {
    "known": lambda seed: simulated(2, 1, seed).problem,
    "shared": lambda seed: simulated(1, 2, seed, scale="shared").problem,
    "per target": lambda seed: simulated(2, 1, seed, scale="per_target").problem,
    "badly scaled, known": lambda seed: badly_scaled(seed, "known"),
    "badly scaled, shared": lambda seed: badly_scaled(seed, "shared"),
    "joined by scale": lambda seed: simulated(2, 2, seed, graph=[(0, 0), (1, 1)], scale="shared").problem,
    "planar, known": lambda seed: simulated(2, 1, seed, motion="planar").problem,
    "planar, shared": lambda seed: simulated(2, 1, seed, motion="planar", scale="shared").problem,
    "one axis, per target": lambda seed: simulated(2, 1, seed, motion="single_axis", scale="per_target").problem,
    "no noise": lambda seed: simulated(2, 1, seed, noise=None).problem,
    "gross noise": lambda seed: simulated(1, 1, seed, noise=GROSS_NOISE, number_of_measurements=4).problem,
    "motion and priors": lambda seed: with_motion_and_priors(seed, "known"),
    "motion and priors, turned round": lambda seed: with_motion_and_priors(seed, "shared"),
    "of moments": lambda seed: without_raw_measurements(simulated(2, 1, seed).problem),
    "of moments, planar": lambda seed: without_raw_measurements(simulated(2, 1, seed, motion="planar").problem),
}
SEEDS = range(2)


def other_points(form: PartForm, bound: Bound, point: Point, generator: np.random.Generator, count: int) -> list[Point]:
    """Answers of the region: random ones, with the best translations and without, and ones near the point."""
    points = []
    n = len(point.numbers)
    width = np.full(13 * n + 1, 3.0) if bound.region is None else half_widths(form.part, point, bound.region)
    for k in range(count):
        R = random_rotations(n, generator)
        if k % 3 == 0:
            points.append(form.answer_near(R)[1].point)
            continue
        moved = np.append(point.numbers.ravel(), point.alpha)
        moved += width * generator.uniform(-1, 1, len(width)) * (1e-6 if k % 3 == 1 else 1.0) * (moved != 0.0)
        numbers = moved[:-1].reshape(n, 13)
        numbers[:, 4:] = point.numbers[:, 4:] if k % 2 else vec(R)
        points.append(Point(numbers, float(moved[-1])))
    return points


def assert_never_beaten(form: PartForm, bound: Bound, point: Point, seed: int, count: int = 12) -> None:
    for other in other_points(form, bound, point, np.random.default_rng(seed), count):
        assert bound.lower_bound <= form.cost.at(other).upper


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", PROBLEMS)
def test_the_bound_is_below_the_optimum_and_close(name: str, seed: int) -> None:
    problem = PROBLEMS[name](seed)
    form, end = whole(problem), optimum(problem)
    bound, evaluation = bound_at(form, end.R)
    assert bound.lower_bound <= evaluation.upper
    if bound.semidefinite:
        # What the stored moments do far along a free direction is rounding.
        lost = 1e-9 if form.part.given is not None or bound.definite else 1e-4
        assert evaluation.upper - bound.lower_bound <= lost * evaluation.upper + 1e-25 * form.reduced.magnitude
    assert bound.definite == (bound.semidefinite and bound.eigenvalue > 0.0)
    assert_never_beaten(form, bound, evaluation.point, seed)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", PROBLEMS)
def test_any_multipliers_at_any_point_bound_the_optimum(name: str, seed: int) -> None:
    """Of every size; those of h-coupled constraints too; points that are optimal and points that are not."""
    problem = PROBLEMS[name](seed)
    form, end = whole(problem), optimum(problem)
    generator = np.random.default_rng(seed)
    n = len(end.R)
    _, best = form.answer_near(end.R)
    elsewhere = form.cost.at(Point(np.c_[generator.standard_normal((n, 4)), vec(random_rotations(n, generator))], 1.0))
    kkt = kkt_of(best)
    for _ in range(2):
        size = form.reduced.magnitude * 10.0 ** generator.uniform(-16, 0)
        random = size * generator.standard_normal((n, 20))
        orthogonality = np.where(np.arange(20) < 11, random, 0.0)
        shift = size * np.r_[1.0, 1.0, 1.0, np.zeros(17)]
        for multipliers in (random, kkt + random, kkt + orthogonality, kkt + shift, kkt - shift, np.zeros((n, 20))):
            for at in (best, elsewhere):
                bound = lower_bound(form, at, multipliers)
                if bound.region is None:  # else the best answer may lie outside
                    assert bound.lower_bound <= best.upper


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["known", "shared", "gross noise", "joined by scale"])
def test_small_duals_and_relaxations_multipliers_bound_the_optimum(name: str, seed: int) -> None:
    problem = PROBLEMS[name](seed)
    form, end = whole(problem), optimum(problem)
    relaxation = solve_relaxation(form.reduced.Q, 1e-8, 100)
    bound, evaluation = bound_at(form, end.R, relaxation.multipliers)
    assert bound.lower_bound <= evaluation.upper
    improved, _ = improve(form.reduced.Q, evaluation.point.rotations, kkt_of(evaluation))
    assert bound_at(form, end.R, improved)[0].lower_bound <= evaluation.upper


class TestBranches:
    """Every branch is really taken by the problems above."""

    def test_definite(self) -> None:
        problem = PROBLEMS["known"](0)
        bound, _ = bound_at(whole(problem), optimum(problem).R)
        assert bound.definite
        assert bound.semidefinite
        assert bound.region is None
        assert bound.lower_bound < bound.value

    @pytest.mark.parametrize("name", ["shared", "joined by scale", "badly scaled, shared"])
    def test_definite_but_for_the_point(self, name: str) -> None:
        """Nothing couples to h, and Z has the null vector x: the bound holds for all of space."""
        problem = PROBLEMS[name](0)
        form = whole(problem)
        assert not form.curvature.is_coupled_to_h
        bound, _ = bound_at(form, optimum(problem).R)
        assert bound.definite
        assert bound.region is None

    @pytest.mark.parametrize("scale", ["known", "shared"])
    def test_semidefinite(self, scale: str) -> None:
        """On planar motion the height is free: the bound names how far it holds."""
        problem = PROBLEMS[f"planar, {scale}"](0)
        bound, evaluation = bound_at(whole(problem), optimum(problem).R)
        assert not bound.definite
        assert bound.semidefinite
        assert bound.direction is None
        assert bound.region is not None
        assert bound.region.radius_m >= 100.0
        assert evaluation.upper - bound.lower_bound <= 1e-9 * evaluation.upper

    def test_negative(self) -> None:
        """At a point that is no optimum Z has a negative eigenvalue: the bound is far below, and a direction given."""
        problem = PROBLEMS["known"](0)
        form = whole(problem)
        R = random_rotations(3, np.random.default_rng(0))
        at = form.cost.at(Point(np.c_[np.zeros((3, 4)), vec(R)], 1.0))
        bound = lower_bound(form, at, kkt_of(at))
        assert not bound.semidefinite
        assert bound.direction is not None
        assert bound.eigenvalue < 0.0
        assert np.isfinite(bound.lower_bound)
        assert bound.lower_bound < form.answer_near(optimum(problem).R)[1].cost


@pytest.mark.parametrize("scale", ["known", "shared"])
def test_large_problems(scale: str) -> None:
    """Above the size of dense eigenvalues: at the optimum the bound is tight, elsewhere it holds with a direction."""
    problem = simulated(60, 20, 1, graph="random", scale=scale).problem
    form, end = whole(problem), optimum(problem)
    bound, evaluation = bound_at(form, end.R)
    assert bound.definite
    assert evaluation.upper - bound.lower_bound <= 1e-10 * evaluation.upper
    R = random_rotations(len(end.R), np.random.default_rng(0))
    elsewhere, _ = bound_at(form, R)
    assert elsewhere.lower_bound < evaluation.cost
    assert elsewhere.direction is not None


def test_large_problems_with_a_free_direction_have_a_region() -> None:
    problem = simulated(90, 2, 1, motion="planar").problem
    form, end = whole(problem), optimum(problem)
    bound, evaluation = bound_at(form, end.R)
    assert bound.semidefinite
    assert bound.region is not None
    assert evaluation.upper - bound.lower_bound <= 1e-9 * evaluation.upper


@pytest.mark.parametrize("reach_m", [0.1, 100.0])
@pytest.mark.parametrize("kept", [True, False], ids=["measurements", "moments"])
@pytest.mark.parametrize("scale", ["known", "shared", "per_target"])
def test_no_distance_is_larger_than_the_extent(scale: rw.ScaleMode, kept: bool, reach_m: float) -> None:
    """Of A, B, and from sensor to target by any answer; measurements far away weigh next to nothing."""
    random = np.random.default_rng(1)
    problem, R = simulated(1, 1, 1, scale=scale).problem, random_rotations(2, random)
    raw = problem.measurements(*problem.pairs[0])
    A, B, sigma = raw.A.copy(), raw.B.copy(), np.full(len(raw.A), 1e-3)
    A[::9, :3, 3] *= 30.0
    B[::9, :3, 3] *= 30.0
    sigma[::9] = 100.0
    given = rw.Problem(scale, keep_measurements=kept)
    given.add(*problem.pairs[0], A, B, sigma, raw.kappa)
    part = whole(given).part
    point = Point(np.c_[reach_m * random.standard_normal((2, 3)), np.ones(2), vec(R)], 1.0)
    answer = answer_at(part, R, point.numbers[:, :4], 1.0)
    t = dict(zip(part.free, answer.t, strict=True))
    a, c = part.gauge.sensor_carrier, part.gauge.target_carrier
    centred = A[:, :3, 3] + A[:, :3, :3] @ c - a
    seen = centred + A[:, :3, :3] @ t[problem.targets[0]] - t[problem.sensors[0]]
    largest = max(np.linalg.norm(each, axis=1).max() for each in (centred, B[:, :3, 3], seen))
    assert largest <= extent_of(part, point) <= 5.0 * largest


def test_numbers_that_are_none_prove_nothing() -> None:
    problem = PROBLEMS["known"](0)
    form, end = whole(problem), optimum(problem)
    multipliers: Array = np.zeros((len(end.R), 20))
    multipliers[0, 0] = np.nan
    bound, _ = bound_at(form, end.R, multipliers)
    assert bound.lower_bound == -np.inf
    assert not bound.definite
    with np.errstate(all="ignore"):
        infinite = form.cost.at(Point(np.full((len(end.R), 13), np.inf), 1.0))
    assert lower_bound(form, infinite, np.zeros((len(end.R), 20))).lower_bound == -np.inf


@given(
    seed=st.integers(0, 10**6),
    targets=st.integers(1, 2),
    sensors=st.integers(1, 2),
    scale=st.sampled_from(["known", "shared", "per_target"]),
    motion=st.sampled_from(["general", "planar", "single_axis", "none"]),
    sigma=st.floats(-6.0, 1.0),
    kappa=st.floats(-1.0, 12.0),
)
@settings(max_examples=30, deadline=None)
def test_bounds_hold_on_any_small_problem(
    seed: int, targets: int, sensors: int, scale: str, motion: str, sigma: float, kappa: float
) -> None:
    noise = Noise(10.0**sigma, 10.0**kappa)
    problem = general(
        targets, sensors, seed=seed, noise=noise, number_of_measurements=6, scale=scale, motion=motion
    ).problem
    form, end = whole(problem), optimum(problem)
    bound, evaluation = bound_at(form, end.R)
    assert bound.lower_bound <= evaluation.upper
    assert_never_beaten(form, bound, evaluation.point, seed, count=6)
