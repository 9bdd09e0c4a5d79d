"""Errors that last are told to be of the view where they are, and left to time where they fade in time."""

from __future__ import annotations

import numpy as np
import pytest
from noisy_rows import random_poses, task_of
from rwhec_factors import se3
from scipy.signal import lfilter

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.fit_options import Walk
from gtsam_rwhec.fitting.lasting_errors import LastingErrors, lasting_errors
from gtsam_rwhec.geometry.poses import Array

FRAMES, KEPT = 300, 0.96
SIZE = np.repeat([0.003, 0.002], 3)
#: Of a detector whose errors fade, as the model found it before.
FADING = Walk(KEPT, "detection")


def path(chance: np.random.Generator) -> Array:
    """A hand (FRAMES, 4, 4) that turns and moves slowly, and never comes back to the same pose."""
    times = np.linspace(0.0, 40.0, FRAMES)[:, None, None]
    waves = np.sin(chance.uniform(0.15, 1.2, (2, 6)) * times + chance.uniform(0.0, 6.3, (2, 6))).sum(axis=1)
    return se3.expmap(waves * np.repeat([0.3, 0.15], 3))


def problem_of(seed: int, *, by_view: bool) -> rw.Problem:
    """A board 0.8 m before a camera on a hand, whose errors are of where it is seen, or fade in time."""
    chance = np.random.default_rng(seed)
    A = path(chance)
    Y = random_poses(chance, 1, 0.2, 0.05)[0]
    X = Y @ se3.expmap(np.array([[2.8, 0.3, 0.2, 0.0, 0.0, 0.0]]))[0]
    X[:3, 3] = (Y @ [0.05, -0.05, 0.8, 1.0])[:3]
    B = np.linalg.inv(Y) @ A @ X
    if by_view:
        t = B[:, :3, 3]
        view = np.column_stack([t[:, :2] / t[:, 2:], np.log(t[:, 2]), B[:, :2, 2]])
        waves = np.cos(view @ chance.normal(0.0, 4.0, (5, 12)) + chance.uniform(0.0, 6.3, 12))
        errors = waves @ chance.normal(0.0, np.sqrt(1.0 / 6.0), (12, 6))
    else:
        steps = chance.normal(0.0, np.sqrt(1.0 - KEPT**2), (FRAMES, 6))
        steps[0] /= np.sqrt(1.0 - KEPT**2)
        errors = lfilter([1.0], [1.0, -KEPT], steps, axis=0)
    B = B @ se3.expmap((errors + 0.3 * chance.normal(size=(FRAMES, 6))) * SIZE)
    problem = rw.Problem()
    problem.add("board", "camera", A, B, stamps_ns=np.arange(FRAMES) * 10**8)
    return problem


def found_in(problem: rw.Problem, walk: Walk | None) -> LastingErrors | None:
    solution = rw.solve(problem)
    task = task_of(problem, solution)
    start = task.variables.start(solution)
    return lasting_errors(task, task.settle(start, "sensorcarrier", walk, systematic=False))


def test_errors_of_the_view_are_told_and_widen_the_covariance() -> None:
    found = [found_in(problem_of(seed, by_view=True), FADING) for seed in (1, 2)]
    assert all(one is not None and one.probability > 0.99 and one.ratio > 1.3 for one in found)


def test_errors_that_fade_in_time_are_not_of_the_view() -> None:
    found = [found_in(problem_of(seed, by_view=False), FADING) for seed in (1, 2)]
    assert all(one is not None and one.probability < 0.01 and one.ratio < 1.1 for one in found)


@pytest.mark.parametrize("by_view", [True, False])
def test_errors_that_last_are_told_where_no_drift_was_found(by_view: bool) -> None:
    found = found_in(problem_of(1, by_view=by_view), None)
    assert found is not None
    assert found.probability > 0.99
    assert found.is_by_far


def test_white_errors_do_not_widen() -> None:
    ratios = []
    for seed in range(8):
        chance = np.random.default_rng(seed)
        A, X, Y = random_poses(chance, 40, 0.7, 0.4), *random_poses(chance, 2, 0.5, 0.3)
        B = np.linalg.inv(Y) @ A @ X @ se3.expmap(chance.normal(size=(40, 6)) * SIZE)
        problem = rw.Problem()
        problem.add("board", "camera", A, B)
        found = found_in(problem, None)
        assert found is not None
        ratios.append(found.ratio)
    assert np.median(ratios) < 1.05
    assert max(ratios) < 1.5


def test_few_measurements_and_random_walks_are_not_asked() -> None:
    problem = problem_of(0, by_view=False)
    assert found_in(problem, Walk(1.0, "sensor")) is None
    few = rw.Problem()
    raw = problem.measurements("board", "camera")
    few.add("board", "camera", raw.A[::20], raw.B[::20])
    assert found_in(few, None) is None
    points = rw.Problem()
    points.add_points("board", "camera", raw.A, raw.B[:, :3, 3], sigma=0.005)
    assert found_in(points, None) is None


def test_poses_far_apart_in_a_slow_log_are_worth_less() -> None:
    """Thinned to 25 frames no drift is seen, and the standard deviations were up to twice too small."""
    chance = np.random.default_rng(5)
    A = path(chance)[::12]
    X, Y = random_poses(chance, 2, 0.5, 0.3)
    walk = np.cumsum(chance.normal(size=(len(A), 6)), axis=0) * 0.6
    B = np.linalg.inv(Y) @ A @ X @ se3.expmap((walk + chance.normal(size=walk.shape)) * SIZE)
    problem = rw.Problem()
    problem.add("board", "camera", A, B)
    found = found_in(problem, None)
    assert found is not None
    assert found.ratio > 1.5


def test_the_words_say_that_deviations_are_larger() -> None:
    options = rw.CalibrateOptions(robust="none", misreadings=False, time_offsets=False)
    calibration = rw.calibrate(problem_of(1, by_view=True), options)
    model = calibration.noise.model
    assert model is not None
    assert model.lasting is not None
    assert "Errors that last, of the view or in time, are 100 % probable" in str(model)
    assert any(choice.what == "errors that last" for choice in calibration.choices)
