"""Blocks of a log scatter as the noise model says; where no model holds, they widen the covariance: CARE."""

from __future__ import annotations

import numpy as np
import pytest
from noisy_rows import random_poses, task_of
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.block_agreement import FEWEST, Scatter, scatter_of_blocks, too_much
from gtsam_rwhec.fitting.fit_options import RefineOptions
from gtsam_rwhec.fitting.noise_rows import ACROSS, BESIDE, Instants, jumps_in
from gtsam_rwhec.fitting.noise_search import MOST_TRACKS, Settled, Task
from gtsam_rwhec.fitting.pair_data import PairData
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
    problem, Y = seen_from_a_path_that_walks(1)
    found = rw.calibrate(problem)
    assert found.noise.model is not None
    assert found.noise.model.frame in ("targetcarrier", "sensorcarrier")
    error = se3.logmap((np.linalg.inv(found.Y["camera"].matrix()) @ Y)[None])[0]
    assert error @ np.linalg.solve(found.covariance("camera"), error) < 22.5  # 99.9 %
    assert "which all tracks share" in str(found.noise)


def settled(problem: rw.Problem) -> tuple[Task, Settled]:
    solution = rw.solve(problem)
    task = task_of(problem, solution)
    return task, task.settle(task.variables.start(solution), "targetcarrier", None, systematic=False)


def test_blocks_of_time_tell_how_large_a_drift_is_that_no_model_holds() -> None:
    white, slow = (scatter_of_blocks(*settled(problem_of(correlation))) for correlation in (0.0, 0.9))
    assert too_much(white) is None
    worst = too_much(slow, is_drift_doubted=True)
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
    assert "blocks of time widened the standard deviations" in calibration.verdict_reason
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


FRAMES_OF_BLOCKS = 160


def problem_with(seed: int, *, later: Array | None = None) -> rw.Problem:
    """White noise; ``later``: a twist by which the target is elsewhere in the second half."""
    chance = np.random.default_rng(seed)
    X, Y = random_poses(chance, 2)
    A = random_poses(chance, FRAMES_OF_BLOCKS, 0.7, 0.3)
    B = np.linalg.inv(Y) @ A @ X @ se3.expmap(0.002 * chance.normal(size=(FRAMES_OF_BLOCKS, 6)))
    if later is not None:
        B[FRAMES_OF_BLOCKS // 2 :] = B[FRAMES_OF_BLOCKS // 2 :] @ se3.expmap(later[None])
    problem = rw.Problem()
    problem.add("map", "camera", A, B, stamps_ns=np.arange(FRAMES_OF_BLOCKS) * 10**8)
    return problem


def scatter(problem: rw.Problem) -> tuple[Scatter, ...]:
    solution = rw.solve(problem)
    task = task_of(problem, solution)
    return scatter_of_blocks(task, task.settle(task.variables.start(solution), "targetcarrier", None, systematic=False))


def test_under_white_noise_blocks_scatter_as_the_model_says() -> None:
    found = [one for seed in range(30) for one in scatter(problem_with(seed))]
    assert {(one.by, one.blocks) for one in found} == {
        ("time", 2), ("time", 4), ("time", 8), ("configuration", 2), ("configuration", 4)
    }  # fmt: skip
    # of both frames the one that is more beyond chance is reported, so the mean is somewhat above 1
    assert 0.9 < np.mean([one.ratio for one in found]) < 1.4
    assert sum(one.is_too_much for one in found) <= 1
    assert np.mean([one.chance < 0.1 for one in found]) < 0.35


def test_a_map_that_is_elsewhere_in_the_second_half_is_found_in_halves() -> None:
    worst = too_much(scatter(problem_with(0, later=np.array([0.0, 0.0, 0.002, 0.002, 0.0, 0.0]))))
    assert worst is not None
    assert worst.by == "time"
    assert worst.ratio > 2.0


def test_the_verdict_says_that_blocks_disagree_and_deviations_are_as_much_larger() -> None:
    options = rw.CalibrateOptions(drift="none", systematic=False, time_offsets=False, robust="none", misreadings=False)
    right = rw.calibrate(problem_with(1), options)
    assert right.verdict is rw.Verdict.USE
    assert [one.chosen for one in right.choices if one.what == "blocks of the log"] == [
        "agree as well as the noise allows"
    ]
    bent = rw.calibrate(problem_with(1, later=np.array([0.0, 0.004, 0.0, 0.0, 0.0, 0.004])), options)
    assert bent.noise.model is not None
    worst = too_much(bent.noise.model.scatter)
    assert worst is not None
    assert worst.is_by_far
    assert rw.Ground.CORRELATED in bent.judgement.grounds
    assert "times what the noise model expects" in bent.verdict_reason
    assert bent.refined is not None
    assert bent.refined.degrees_of_freedom <= worst.freedom


@pytest.mark.parametrize("walk", [0.0, 0.05])
def test_a_loop_that_closes_is_a_jump_and_a_walk_is_none(walk: float) -> None:
    chance = np.random.default_rng(4)
    residual = chance.normal(size=(300, 6)) + np.cumsum(walk * chance.normal(size=(300, 6)), axis=0)
    step = np.where(np.arange(300) == 0, 0.0, 1.0)
    each = np.arange(300)
    instants = Instants(each, each, each, np.zeros(300, dtype=np.int64), 1, step, None)
    assert len(jumps_in(residual, instants)) == 0
    residual[120:, 3] += 8.0
    (at,) = jumps_in(residual, instants)
    assert abs(at - 120) <= BESIDE // 2
    cut = instants.cut(np.array([at]))
    assert cut.step[at] == ACROSS
    assert instants.step[at] == 1.0
