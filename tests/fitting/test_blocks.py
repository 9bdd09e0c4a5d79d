"""Where no model holds the drift of many tracks, blocks of time widen the covariance, and the verdict is CARE."""

from __future__ import annotations

import numpy as np
import pytest
from noisy_rows import random_poses
from rwhec_factors import se3
from settled_models import task_of

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.block_agreement import FEWEST, scatter_of_blocks, too_much
from gtsam_rwhec.fitting.noise_search import MOST_TRACKS, Settled, Task

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


def test_blocks_of_time_tell_how_large_a_drift_is_that_no_model_holds() -> None:
    white, slow = (scatter_of_blocks(*settled(problem_of(correlation))) for correlation in (0.0, 0.9))
    assert too_much(white) is None
    worst = too_much(slow, is_drift_untried=True)
    assert worst is not None
    assert worst.by == "time"
    assert worst.ratio > 4.0


def test_too_few_instants_for_blocks_tell_nothing() -> None:
    assert scatter_of_blocks(*settled(problem_of(0.9, 2 * FEWEST - 1))) == ()


def test_the_verdict_says_that_no_model_holds_the_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = problem_of(0.95, 60)
    options = rw.CalibrateOptions(systematic=False, time_offsets=False, robust="none", sizes="known")
    calibration = rw.calibrate(problem, options)
    assert calibration.verdict is rw.Verdict.CARE
    assert rw.Ground.CORRELATED in calibration.judgement.grounds
    assert "widened as blocks of time show" in calibration.verdict_reason
    monkeypatch.setattr("gtsam_rwhec.fitting.noise_refinement.too_much", lambda *_, **__: None)
    before = rw.calibrate(problem, options)
    for name in ("camera", "tag_0"):
        assert (np.diagonal(calibration.covariance(name)) >= np.diagonal(before.covariance(name))).all()
    assert calibration.covariance("tag_0").trace() > 2.0 * before.covariance("tag_0").trace()
