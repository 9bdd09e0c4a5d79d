"""What a solution reports: residuals, order, stages, weights, and in which words."""

from __future__ import annotations

import pickle
import warnings
from typing import Any

import gtsam
import numpy as np
import pytest
from naive_cost import naive_cost
from rwhec_factors import se3
from rwhec_factors.se3 import pose
from solved_problems import MODES, NOISE, matrices, simulated

import gtsam_rwhec as rw
from gtsam_rwhec.errors import NotCertifiedWarning, RwhecWarning, ScaleError, WeightsWarning
from gtsam_rwhec.simulate import Motion, Noise, general
from gtsam_rwhec.simulate.simulated_noise import random_poses
from gtsam_rwhec.solver import Cause, Start
from gtsam_rwhec.solver import search as attempt
from gtsam_rwhec.solver.bound import Bound
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solver.solution import contradicted_by


@pytest.mark.parametrize("mode", MODES)
def test_residuals_are_those_of_the_measurements(mode: str) -> None:
    """Root mean squares in true metres and in radians, pair by pair."""
    simulation = simulated(mode, odometry=6, odometry_noise=NOISE)
    problem = simulation.problem
    solution = rw.solve(problem)
    poses = matrices({**solution.X, **solution.Y})
    for target, sensor in problem.pairs:
        data = problem.measurements(target, sensor)
        alpha = solution.scale[target] if isinstance(solution.scale, dict) else solution.scale
        translations, angles = [], []
        for A, B in zip(data.A, data.B, strict=True):
            left, right = A @ poses[target], poses[sensor] @ B
            t_right = poses[sensor][:3, 3] + poses[sensor][:3, :3] @ B[:3, 3] / alpha
            translations.append(np.linalg.norm(left[:3, 3] - t_right))
            angles.append(gtsam.Rot3(left[:3, :3]).between(gtsam.Rot3(right[:3, :3])).axisAngle()[1])
        residual = solution.residuals[target, sensor]
        assert residual.number_of_measurements == len(data.A)
        assert residual.translation_rms_m == pytest.approx(np.sqrt(np.mean(np.square(translations))), rel=1e-9)
        # The chord's root mean square, turned to an angle: the angles' own to second order.
        assert residual.rotation_rms_rad == pytest.approx(np.sqrt(np.mean(np.square(angles))), rel=1e-3)


def test_solution_has_every_frame_in_order() -> None:
    problem = rw.Problem("per_target")
    A = random_poses(8, 1.0, np.random.default_rng(0))
    for target, sensor in (("b", "y"), ("a", "y"), ("a", "x")):
        problem.add(target, sensor, A, A, 0.1, 10.0)
    problem.add_motion("x", A, A, 0.1, 10.0)
    solution = rw.solve(problem)
    assert list(solution.X) == ["b", "a"]
    assert list(solution.Y) == ["y", "x"]
    assert isinstance(solution.scale, dict)
    assert list(solution.scale) == ["b", "a", "x"]
    assert solution.scale_mode == "per_target"
    assert list(solution.residuals) == list(problem.pairs) == list(solution.identifiability.pairs)


def test_stages_are_told_and_timed() -> None:
    stages: list[str] = []
    solution = rw.solve(simulated("known").problem, progress=stages.append)
    assert stages[0] == "quadratic form"
    assert stages[-1] == "identifiability"
    assert set(solution.certificate.seconds) == set(stages)
    assert all(seconds >= 0.0 for seconds in solution.certificate.seconds.values())
    stages.clear()
    rw.certify(simulated("known").problem, solution.X, solution.Y, progress=stages.append)
    assert "descent" in stages


@pytest.mark.parametrize(
    ("mode", "said"), [("known", "A X = Y B"), ("shared", "A X = Y B"), ("per_target", "B X^-1 = Y^-1 A")]
)
def test_the_certificate_says_which_cost_it_is_about(mode: str, said: str) -> None:
    certificate = rw.solve(simulated(mode).problem).certificate
    assert said in str(certificate.objective)
    assert f"{certificate.cost:.8g}" in str(certificate)


def test_solving_does_not_change_the_problem() -> None:
    problem = simulated("shared").problem
    before = pickle.dumps(problem)
    solution = rw.solve(problem)
    rw.certify(problem, solution.X, solution.Y, solution.scale)
    assert pickle.dumps(problem) == before
    assert rw.solve(problem).cost == solution.cost


@pytest.mark.parametrize("mode", MODES)
def test_true_weights_raise_no_alarm(mode: str) -> None:
    with warnings.catch_warnings(action="error", category=WeightsWarning):
        for seed in range(10):
            rw.solve(simulated(mode, seed=seed).problem)


@pytest.mark.parametrize("mode", [mode for mode in MODES if mode != "per_target"])  # its cost is no chi-square
def test_weights_far_from_the_residuals_do(mode: str) -> None:
    data, problem = simulated(mode).problem, rw.Problem(MODES[mode]["scale"])
    for pair in data.pairs:
        raw = data.measurements(*pair)
        problem.add(*pair, raw.A, raw.B, 0.1 * raw.sigma, 100.0 * raw.kappa)
    with pytest.warns(WeightsWarning, match=r"1?[0-9]{2}(\.[0-9])? times what sigma and kappa predict"):
        rw.solve(problem)


@pytest.mark.parametrize("weight", [1e-6, 1e6])
def test_units_of_the_weights_do_not_matter(weight: float) -> None:
    """Relative weights: the same answer, the cost times the weight."""
    simulation = simulated("known")
    heavy = rw.Problem()
    for pair in simulation.problem.pairs:
        data = simulation.problem.measurements(*pair)
        heavy.add(*pair, data.A, data.B, data.sigma / np.sqrt(weight), data.kappa * weight)
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):
        first, second = rw.solve(simulation.problem), rw.solve(heavy)
    assert second.certificate.is_certified
    assert second.cost == pytest.approx(weight * first.cost, rel=1e-9)
    for name, T in {**first.X, **first.Y}.items():
        np.testing.assert_allclose({**second.X, **second.Y}[name].matrix(), T.matrix(), atol=1e-8)


def test_a_known_size_carries_over_to_targets_of_unknown_size() -> None:
    simulation = general(
        3, 1, seed=3, noise=Noise(0.001, 1e5), scale="per_target", known_sizes=("target2",), number_of_measurements=40
    )
    solution = rw.solve(simulation.problem)
    assert isinstance(solution.scale, dict)
    assert solution.scale["target2"] == 1.0
    errors = simulation.errors(solution)
    assert isinstance(errors.relative_scale, dict)
    assert max(errors.relative_scale.values()) < 0.005


def test_a_solution_prints_as_a_few_lines() -> None:
    solution = rw.solve(simulated("known").problem)
    status, counts, scale = str(solution).splitlines()
    assert status == str(solution.certificate)
    assert counts.startswith(f"{len(solution.X)} targets, {len(solution.Y)} sensors, ")
    assert scale == "scale (known): 1"
    *_, scale = str(rw.solve(simulated("per_target").problem)).splitlines()
    assert all(name in scale for name in solution.X)


@pytest.mark.parametrize("distance_m", [0.0, 1e3, 1e6])
def test_exact_data_are_certified_wherever_the_origin_of_the_world_is(distance_m: float) -> None:
    """What is left of the cost is the rounding of the poses, which is 1e-10 m where the origin is 1,000 km away."""
    near = general(2, 2, seed=1).problem
    problem = rw.Problem()
    away = se3.pose(np.eye(3), distance_m * np.array([0.6, 0.8, 0.1]))
    for pair in near.pairs:
        for batch in near.batches(*pair):
            problem.add(*pair, batch.A @ away, batch.B)
    solution = rw.solve(problem)
    assert solution.certificate.status is rw.Status.CERTIFIED
    # Another answer is refused: 1e-6 m is ten thousand times the rounding.
    moved = {name: pose.retract(np.array([0, 0, 0, 1e-6, 0, 0])) for name, pose in solution.X.items()}
    assert not rw.certify(problem, moved, solution.Y).is_certified


@pytest.mark.parametrize(
    ("cost", "degrees_of_freedom", "ratio"),
    [
        (100.0, 200, None),  # what true weights predict
        (190.0, 200, None),  # less than twice that
        (210.0, 200, 2.1),
        (3.0, 2, None),  # three times, but chance makes that once in twenty
        (10.0, 2, 10.0),
        (10.0, 0, None),  # nothing tells
    ],
)
def test_twice_what_is_predicted_and_beyond_chance(cost: float, degrees_of_freedom: int, ratio: float | None) -> None:
    assert contradicted_by(cost, degrees_of_freedom) == (None if ratio is None else pytest.approx(ratio))


def test_true_weights_are_contradicted_less_than_once_in_a_thousand() -> None:
    generator = np.random.default_rng(0)
    for degrees_of_freedom in (1, 3, 10, 100):
        costs = 0.5 * generator.chisquare(degrees_of_freedom, 20_000)
        told = sum(contradicted_by(float(cost), degrees_of_freedom) is not None for cost in costs)
        assert told <= 40


def cost_of(problem: rw.Problem, X: Any, Y: Any, scale: Any) -> float:
    """By plain loops over the measurements."""
    part = parts_of(problem)[0]
    return naive_cost(problem, matrices(X), matrices(Y), scale, part.kind, part.gauge)


def perturbed(poses: Any, size: float, seed: int) -> dict[str, gtsam.Pose3]:
    generator = np.random.default_rng(seed)
    return {name: T.retract(size * generator.standard_normal(6)) for name, T in poses.items()}


def scaled(scale: Any, factor: float, known: tuple[str, ...] = ()) -> Any:
    """Every unknown scale times a factor."""
    if isinstance(scale, dict):
        return {name: value if name in known else value * factor for name, value in scale.items()}
    return scale * factor


# -- solve ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["auto", "sdp", "local"])
@pytest.mark.parametrize("knowledge", ["none", "fixed", "priors", "motions"])
@pytest.mark.parametrize("mode", MODES)
def test_no_small_step_from_the_answer_costs_less(mode: str, knowledge: str, method: Any) -> None:
    """The gradient of the measurements' own cost is zero at the answer, along every pose and every unknown scale."""
    simulation = simulated(mode, **(dict(odometry=8, odometry_noise=NOISE) if knowledge == "motions" else {}))
    problem = simulation.problem
    if knowledge == "fixed":
        problem.fix("sensor0", simulation.Y["sensor0"])
        problem.fix("target1", simulation.X["target1"])
    if knowledge == "priors":
        problem.add_prior("sensor1", simulation.Y["sensor1"] @ pose(np.eye(3), [0.05, 0.0, 0.1]), sigma=0.02, kappa=1e3)
        problem.add_prior("target0", simulation.X["target0"], kappa=30.0)
    initial = (simulation.X, simulation.Y, simulation.scale) if method == "local" else None
    solution = rw.solve(problem, method, initial=initial)
    assert solution.certificate.is_certified
    assert solution.cost == pytest.approx(cost_of(problem, solution.X, solution.Y, solution.scale), rel=1e-9)
    assert solution.certificate.lower_bound <= solution.cost

    step = 1e-5
    for name, T in {**solution.X, **solution.Y}.items():
        if name in problem.fixed:
            np.testing.assert_allclose(T.matrix(), problem.fixed[name], atol=1e-15)
            continue
        for axis in np.eye(6):
            ends = []
            for sign in (1.0, -1.0):
                moved = {**solution.X, **solution.Y, name: T.retract(sign * step * axis)}
                X, Y = ({key: moved[key] for key in side} for side in (solution.X, solution.Y))
                ends.append(cost_of(problem, X, Y, solution.scale))
            curvature = (ends[0] + ends[1] - 2.0 * solution.cost) / step**2
            assert curvature > 0.0
            # The minimum is within a tenth of a micrometre or microradian.
            assert abs(ends[0] - ends[1]) / (2.0 * step) < 1e-7 * curvature
    if mode != "known":
        names = problem.targets if mode == "per_target" else ("all",)
        for name in names:
            if name in problem.fixed_scales:
                continue
            ends = []
            for sign in (1.0, -1.0):
                scale = solution.scale
                if isinstance(scale, dict):
                    scale = {**scale, name: scale[name] * (1.0 + sign * step)}
                    ends.append(cost_of(problem, solution.X, solution.Y, scale))
                else:
                    ends.append(cost_of(problem, solution.X, solution.Y, scale * (1.0 + sign * step)))
            curvature = (ends[0] + ends[1] - 2.0 * solution.cost) / step**2
            assert abs(ends[0] - ends[1]) / (2.0 * step) < 1e-7 * curvature


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("size", [1e-3, 0.2])
def test_local_descends_from_the_users_start(mode: str, size: float) -> None:
    problem = simulated(mode).problem
    best = rw.solve(problem)
    known = tuple(problem.fixed_scales)
    start = (
        perturbed(best.X, size, 1),
        perturbed(best.Y, size, 2),
        scaled(best.scale, 1.2, known) if mode != "known" else 1.0,
    )
    local = rw.solve(problem, method="local", initial=start)
    assert local.certificate.path.start is Start.GIVEN
    assert local.certificate.is_certified
    assert local.cost == pytest.approx(best.cost, rel=1e-9)
    for name, T in {**best.X, **best.Y}.items():
        np.testing.assert_allclose({**local.X, **local.Y}[name].matrix(), T.matrix(), atol=1e-7)


def with_local_minimum() -> tuple[rw.Problem, rw.Solution, rw.Solution]:
    """Five noisy measurements, the best answer, and where descent from a bad start ends."""
    problem = general(
        1, 1, seed=0, noise=Noise(0.05, 20.0), number_of_measurements=5, motion=Motion(max_angle_rad=1.0)
    ).problem
    best = rw.solve(problem)
    generator = np.random.default_rng(0)
    for _ in range(20):
        X, Y = random_poses(2, 1.0, generator)
        with warnings.catch_warnings(action="ignore", category=RwhecWarning):
            local = rw.solve(problem, method="local", initial=({"target0": X}, {"sensor0": Y}, 1.0))
        if local.cost > 2.0 * best.cost:
            return problem, best, local
    raise AssertionError("no start led to a local minimum")


def test_a_local_minimum_is_not_certified() -> None:
    problem, best, local = with_local_minimum()
    assert best.certificate.is_optimal  # five measurements with noise of 9 degrees leave directions free
    assert local.certificate.status == "gap"
    assert not local.certificate.is_certified
    assert local.certificate.lower_bound <= best.cost < local.cost
    assert local.certificate.cause is Cause.LOCAL_MINIMUM_POSSIBLE
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):
        warnings.simplefilter("error", NotCertifiedWarning)
        with pytest.raises(NotCertifiedWarning, match="not proven optimal"):
            rw.solve(problem, method="local", initial=(local.X, local.Y, 1.0))


def test_a_local_minimum_given_to_certify_is_beaten() -> None:
    problem, best, local = with_local_minimum()
    certificate = rw.certify(problem, X=local.X, Y=local.Y)
    assert certificate.status == "gap"
    assert certificate.cost == pytest.approx(local.cost, rel=1e-9)
    assert certificate.lower_bound == pytest.approx(best.cost, rel=1e-6)
    assert certificate.cause is Cause.BETTER_ANSWER
    assert certificate.reason == f"a better answer exists: {best.cost:.8g} against {local.cost:.8g}"


# -- certify ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", MODES)
def test_the_optimum_is_certified_as_given(mode: str) -> None:
    problem = simulated(mode).problem
    solution = rw.solve(problem)
    for X, Y in ((solution.X, solution.Y), (matrices(solution.X), matrices(solution.Y))):
        certificate = rw.certify(problem, X=X, Y=Y, scale=solution.scale)
        assert certificate.status == "certified"
        assert certificate.cause.status is rw.Status.CERTIFIED
        assert certificate.cost == pytest.approx(solution.cost, rel=1e-9)
        assert certificate.lower_bound <= certificate.cost
        assert certificate.relative_gap < 1e-6


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("size", [1e-3, 0.1])
def test_an_answer_beside_the_optimum_is_not(mode: str, size: float) -> None:
    problem = simulated(mode).problem
    best = rw.solve(problem)
    X, Y = perturbed(best.X, size, 3), perturbed(best.Y, size, 4)
    certificate = rw.certify(problem, X=X, Y=Y, scale=best.scale)
    assert certificate.status == "gap"
    assert certificate.cost == pytest.approx(cost_of(problem, X, Y, best.scale), rel=1e-9)
    assert certificate.cost > best.cost
    assert certificate.lower_bound == pytest.approx(best.cost, rel=1e-6)
    assert certificate.cause is Cause.BETTER_ANSWER
    assert certificate.gap == pytest.approx(certificate.cost - certificate.lower_bound)
    assert certificate.relative_gap == pytest.approx(certificate.gap / certificate.cost)


def test_without_a_bound_a_worse_answer_is_not_called_a_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    """A gap needs a bound. No measurements are known that have none, so the search is given the record of none."""
    problem = simulated("known").problem
    best = rw.solve(problem)
    monkeypatch.setattr(attempt, "lower_bound", lambda *_, **__: Bound())
    for size in (0.0, 0.1):
        certificate = rw.certify(problem, X=perturbed(best.X, size, 3), Y=best.Y)
        assert (certificate.status, certificate.cause) == (rw.Status.FAILED, Cause.NO_BOUND)
        assert certificate.lower_bound == -np.inf


@pytest.mark.parametrize("mode", ["shared", "per_target"])
def test_the_optimum_with_another_scale_is_not(mode: str) -> None:
    problem = simulated(mode).problem
    best = rw.solve(problem)
    wrong = scaled(best.scale, 1.05, tuple(problem.fixed_scales))
    certificate = rw.certify(problem, X=best.X, Y=best.Y, scale=wrong)
    assert certificate.status == "gap"
    assert certificate.cost == pytest.approx(cost_of(problem, best.X, best.Y, wrong), rel=1e-9)
    assert certificate.cause is Cause.BETTER_ANSWER


def test_one_number_stands_for_all_unknown_scales() -> None:
    simulation = general(2, 1, seed=1, noise=NOISE, scale="per_target", true_scale={"target0": 0.8, "target1": 0.8})
    problem = simulation.problem
    each = rw.certify(problem, X=simulation.X, Y=simulation.Y, scale={"target0": 0.8, "target1": 0.8})
    assert rw.certify(problem, X=simulation.X, Y=simulation.Y, scale=0.8).cost == each.cost


def test_the_truth_is_near_the_optimum_but_not_it() -> None:
    """Noise takes the optimum away from the truth: its cost is above by about half the number of unknowns."""
    simulation = simulated("known", number_of_measurements=50)
    best = rw.solve(simulation.problem)
    certificate = rw.certify(simulation.problem, X=simulation.X, Y=simulation.Y)
    assert certificate.status == "gap"
    assert 2.0 < certificate.cost - best.cost < 40.0  # half a chi-square of 24 degrees of freedom: 12 on average


def test_parts_are_certified_together() -> None:
    simulation = general(2, 2, seed=2, graph=[(0, 0), (1, 1)], noise=NOISE)
    problem = simulation.problem
    best = rw.solve(problem)
    assert best.certificate.is_certified
    assert len(best.parts) == 2
    certificate = rw.certify(problem, X=best.X, Y=best.Y)
    assert certificate.is_certified
    assert certificate.cost == pytest.approx(sum(part.certificate.cost for part in best.parts), rel=1e-9)
    worse = rw.certify(problem, X={**best.X, **perturbed({"target1": best.X["target1"]}, 0.01, 1)}, Y=best.Y)
    assert worse.status == "gap"
    assert worse.cost > certificate.cost
    assert worse.lower_bound == pytest.approx(certificate.lower_bound, rel=1e-9)


def test_a_known_sensor_may_tell_the_scale_of_another_one() -> None:
    """Of the second sensor every frame is known: only the scale joins it to the first, and no rotation is sought."""
    poses = random_poses(14, 1.0, np.random.default_rng(5))
    T_carrier_sensor, scale = {"cam": poses[0], "known": poses[1]}, 0.7
    problem = rw.Problem("shared")
    for (name, Y), A in zip(T_carrier_sensor.items(), (poses[2:8], poses[8:]), strict=True):
        B = np.linalg.inv(Y) @ A @ Y
        B[:, :3, 3] *= scale
        problem.add_motion(name, A, B, 0.01, 5e3)
    problem.fix("known", T_carrier_sensor["known"])
    solution = rw.solve(problem)
    assert solution.certificate.is_certified
    assert solution.scale == pytest.approx(scale, rel=1e-9)
    np.testing.assert_allclose(solution.Y["cam"].matrix(), T_carrier_sensor["cam"], atol=1e-8)


def test_a_scale_below_zero_between_known_frames_is_refused_in_words() -> None:
    X, Y, *A = random_poses(7, 1.0, np.random.default_rng(5))
    B = np.linalg.inv(Y) @ A @ X
    B[:, :3, 3] *= -1.0
    problem = rw.Problem("shared")
    problem.add("tag", "cam", np.array(A), B)
    problem.fix("tag", X)
    problem.fix("cam", Y)
    with pytest.raises(ScaleError, match="the scale is -1 at the optimum"):
        rw.solve(problem)


@pytest.mark.parametrize("seed", range(8))
def test_what_is_rounded_in_moments_holds_no_translation(seed: int) -> None:
    """Motions that turn by 2e-9 rad: 100 km away an answer costs less, and a bound was given without a region."""
    random = np.random.default_rng(seed)
    A, B = (se3.expmap(random.normal(size=(5, 6)) * np.repeat(of, 3)) for of in ([1e-9, 2e-8], [5e-2, 2e-4]))
    problem = rw.Problem(keep_measurements=False)
    problem.add_motion("cam", A, B, 3e-4, 226.0)
    assert rw.solve(problem).certificate.region is not None


def test_of_a_sensor_whose_frame_is_known_moments_alone_tell_the_cost() -> None:
    poses = random_poses(9, 1.0, np.random.default_rng(2))
    problem = rw.Problem(keep_measurements=False)
    problem.add_motion("cam", poses[1:], np.linalg.inv(poses[0]) @ poses[1:] @ poses[0], 0.01, 5e3)
    problem.fix("cam", poses[0])
    certificate = rw.solve(problem).certificate
    assert certificate.is_certified
    assert 0.0 <= certificate.cost < 1e-6
