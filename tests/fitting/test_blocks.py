"""Where no model holds the drift of many tracks, blocks of time widen the covariance, and the verdict is CARE."""

from __future__ import annotations

import numpy as np
import pytest
from noisy_rows import random_poses
from rwhec_factors import se3
from settled_models import task_of

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.noise_in_data import BLOCKS, widening
from gtsam_rwhec.fitting.noise_search import MOST_TRACKS, Settled, Task
from gtsam_rwhec.geometry.poses import Array

TAGS, FRAMES = MOST_TRACKS + 1, 100


def problem_of(correlation: float, frames: int = FRAMES) -> rw.Problem:
    """One camera and more tags than a drift's model holds; each track's errors fade with this correlation."""
    chance = np.random.default_rng(1)
    X, Y = random_poses(chance, TAGS), random_poses(chance, 1)[0]
    A = random_poses(chance, frames, 0.7, 0.3)
    problem = rw.Problem()
    for i in range(TAGS):
        xi = 0.004 * chance.normal(size=(frames, 6))
        for k in range(1, frames):
            xi[k] = correlation * xi[k - 1] + np.sqrt(1.0 - correlation**2) * xi[k]
        B = np.linalg.inv(Y) @ A @ X[i] @ se3.expmap(xi)
        problem.add(f"tag_{i}", "camera", A, B, stamps_ns=np.arange(frames) * 10**8)
    return problem


def settled(problem: rw.Problem) -> tuple[Task, Settled]:
    solution = rw.solve(problem)
    task = task_of(problem, solution)
    return task, task.settle(task.variables.start(solution), "targetcarrier", None, systematic=False)


def claimed_of(found: Settled) -> Array:
    """The covariance of all unknowns where no noise is uncertain."""
    covariance = found.model.evaluate(found.fit.sizes.values(found.fit.logs)).covariance
    return np.asarray(found.model.basis @ covariance @ found.model.basis.T)


def widened(task: Task, found: Settled, times: float = 1.0) -> Array:
    return widening(task, found, times * claimed_of(found))


def test_blocks_of_time_widen_what_is_correlated_and_nothing_else() -> None:
    white, slow = (widened(*settled(problem_of(correlation))) for correlation in (0.0, 0.9))
    assert (white >= 1.0).all()
    assert np.median(white) < 1.3
    assert np.median(slow) > 2.0


def test_the_widening_is_the_root_of_the_ratio_of_variances() -> None:
    """With errors twice as large as the model has them, in blocks that are independent, it is two."""
    task, found = settled(problem_of(0.0))
    once = widened(task, found)
    found.model.rows.residual[:] *= 2.0
    twice = widened(task, found)
    inside = once > 1.0
    np.testing.assert_allclose(twice[inside], 2.0 * once[inside], rtol=1e-9)


def test_what_a_covariance_holds_already_is_not_widened_again() -> None:
    """Errors of the configuration made deviations of 20 mm, and blocks of time then made 7 m of them."""
    task, found = settled(problem_of(0.9))
    narrow, wide = (widened(task, found, times) for times in (1.0, 9.0))
    told = narrow > 3.0
    assert told.any()
    np.testing.assert_allclose(wide[told], narrow[told] / 3.0, rtol=1e-9)
    np.testing.assert_array_equal(widened(task, found, 1e6), 1.0)


def test_too_few_instants_for_blocks_widen_nothing() -> None:
    np.testing.assert_array_equal(widened(*settled(problem_of(0.9, 2 * BLOCKS - 1))), 1.0)


def test_the_verdict_says_that_no_model_holds_the_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = problem_of(0.95, 60)
    options = rw.CalibrateOptions(systematic=False, time_offsets=False, robust="none", sizes="known")
    calibration = rw.calibrate(problem, options)
    assert calibration.verdict is rw.Verdict.CARE
    assert rw.Ground.CORRELATED in calibration.judgement.grounds
    assert "widened as blocks of time show" in calibration.verdict_reason
    # Whichever of the two judges sees the blocks first, the other finds them in the covariance.
    monkeypatch.setattr("gtsam_rwhec.fitting.noise_in_data.widening", lambda task, *_: np.ones(len(task.layout.unit)))
    monkeypatch.setattr("gtsam_rwhec.fitting.noise_in_data.too_much", lambda scatter: None)
    before = rw.calibrate(problem, options)
    for name in ("camera", "tag_0"):
        assert (np.diagonal(calibration.covariance(name)) >= np.diagonal(before.covariance(name))).all()
    assert calibration.covariance("tag_0").trace() > 2.0 * before.covariance("tag_0").trace()
