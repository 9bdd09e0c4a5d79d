"""What a solution reports: residuals, order, stages, weights, and in which words."""

from __future__ import annotations

import pickle
import warnings

import gtsam
import numpy as np
import pytest
from solved_problems import MODES, NOISE, matrices, simulated

import gtsam_rwhec as rw
from gtsam_rwhec.errors import RwhecWarning, WeightsWarning
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.simulate.simulated_noise import random_poses


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
    with warnings.catch_warnings():
        warnings.simplefilter("error", WeightsWarning)
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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RwhecWarning)
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
    away = np.eye(4)
    away[:3, 3] = distance_m * np.array([0.6, 0.8, 0.1])
    for pair in near.pairs:
        for batch in near.batches(*pair):
            problem.add(*pair, batch.A @ away, batch.B)
    solution = rw.solve(problem)
    assert solution.certificate.status is rw.Status.CERTIFIED
    # Another answer is refused: 1e-6 m is ten thousand times the rounding.
    moved = {name: pose.retract(np.array([0, 0, 0, 1e-6, 0, 0])) for name, pose in solution.X.items()}
    assert not rw.certify(problem, moved, solution.Y).is_certified
