"""Where no model holds the drift of many tracks, blocks of time widen the covariance, and the verdict is CARE."""

from __future__ import annotations

import numpy as np
import pytest
from noisy_rows import random_poses, task_of
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.block_agreement import FEWEST, scatter_of_blocks, too_much
from gtsam_rwhec.fitting.fit_options import RefineOptions
from gtsam_rwhec.fitting.noise_rows import Instants
from gtsam_rwhec.fitting.noise_search import MOST_TRACKS, Settled, Task
from gtsam_rwhec.fitting.pair_data import PairData

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


def seen_from_a_path_that_walks(seed: int, frames: int = 60) -> tuple[rw.Problem, np.ndarray]:
    """Many tags from a body whose path walks in its own frame, as an inertial one does; and T_body_camera."""
    chance = np.random.default_rng(seed)
    X, Y = random_poses(chance, 2 * TAGS), random_poses(chance, 1)[0]
    T_world_body = random_poses(chance, frames, 0.7, 0.3)
    steps = chance.normal(size=(frames, 6)) * np.repeat([2e-4, 5e-4], 3)
    error = np.eye(4)
    A = np.empty_like(T_world_body)
    for k, T in enumerate(T_world_body):
        motion = np.eye(4) if k == 0 else np.linalg.inv(T_world_body[k - 1]) @ T
        error = np.linalg.inv(motion) @ error @ motion @ se3.expmap(steps[k : k + 1])[0]
        A[k] = np.linalg.inv(T @ error)
    problem = rw.Problem()
    for i, at in enumerate(X):
        noise = chance.normal(size=(frames, 6)) * np.repeat([0.008, 0.002], 3)
        B = np.linalg.inv(Y) @ np.linalg.inv(T_world_body) @ at @ se3.expmap(noise)
        problem.add(f"tag_{i}", "camera", A, B, stamps_ns=np.arange(frames) * 10**9)
    return problem, Y


def test_a_path_that_walks_is_in_the_covariance_of_many_tags() -> None:
    """Each tag's noise hides the walk, and all of an instant show it."""
    squares = []
    for seed in range(2):
        problem, Y = seen_from_a_path_that_walks(seed)
        found = rw.calibrate(problem)
        assert found.noise.model is not None
        assert found.noise.model.frame in ("targetcarrier", "sensorcarrier")
        error = se3.logmap((np.linalg.inv(found.Y["camera"].matrix()) @ Y)[None])[0]
        squares.append(float(error @ np.linalg.solve(found.covariance("camera"), error)))
    assert max(squares) < 22.5  # 99.9 %
    assert "which all tracks share" in str(found.noise)


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


def test_bodies_are_told_by_the_instants_that_tracks_share() -> None:
    """Two bodies with two tracks each: those of one have instants in common."""
    chance = np.random.default_rng(3)
    problem = rw.Problem()
    for body in range(2):
        A = random_poses(chance, 8)
        for i in range(2):
            stamps = np.arange(8) * 10**8 + body * 10**7
            problem.add(f"tag_{i}_{body}", f"camera_{body}", A, random_poses(chance, 8), stamps_ns=stamps)
    instants = Instants.of([PairData.of(problem, pair, RefineOptions(), None) for pair in problem.pairs])
    assert instants.chains == 4
    body = dict(zip(problem.pairs, instants.bodies.tolist(), strict=True))
    of = [{body[pair] for pair in problem.pairs if pair.sensor == name} for name in ("camera_0", "camera_1")]
    assert len(of[0]) == len(of[1]) == 1
    assert of[0] != of[1]
