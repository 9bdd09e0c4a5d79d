"""Blocks of a log scatter as the noise model says where it is right, and more where an error is of no kind it has."""

from __future__ import annotations

import numpy as np
import pytest
from noisy_rows import random_poses, task_of
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.fitting.block_agreement import Scatter, scatter_of_blocks, too_much
from gtsam_rwhec.fitting.noise_rows import ACROSS, BESIDE, Instants, jumps_in
from gtsam_rwhec.geometry.poses import Array

FRAMES = 160


def problem_of(seed: int, *, later: Array | None = None) -> rw.Problem:
    """White noise; ``later``: a twist by which the target is elsewhere in the second half."""
    chance = np.random.default_rng(seed)
    X, Y = random_poses(chance, 2)
    A = random_poses(chance, FRAMES, 0.7, 0.3)
    B = np.linalg.inv(Y) @ A @ X @ se3.expmap(0.002 * chance.normal(size=(FRAMES, 6)))
    if later is not None:
        B[FRAMES // 2 :] = B[FRAMES // 2 :] @ se3.expmap(later[None])
    problem = rw.Problem()
    problem.add("map", "camera", A, B, stamps_ns=np.arange(FRAMES) * 10**8)
    return problem


def scatter(problem: rw.Problem) -> tuple[Scatter, ...]:
    solution = rw.solve(problem)
    task = task_of(problem, solution)
    return scatter_of_blocks(task, task.settle(task.variables.start(solution), "targetcarrier", None, systematic=False))


def test_under_white_noise_blocks_scatter_as_the_model_says() -> None:
    found = [one for seed in range(30) for one in scatter(problem_of(seed))]
    assert {(one.by, one.blocks) for one in found} == {
        ("time", 2), ("time", 4), ("time", 8), ("configuration", 2), ("configuration", 4)
    }  # fmt: skip
    # of both frames the one that is more beyond chance is reported, so the mean is somewhat above 1
    assert 0.9 < np.mean([one.ratio for one in found]) < 1.4
    assert sum(one.is_too_much for one in found) <= 1
    assert np.mean([one.chance < 0.1 for one in found]) < 0.35


def test_a_map_that_is_elsewhere_in_the_second_half_is_found_in_halves() -> None:
    worst = too_much(scatter(problem_of(0, later=np.array([0.0, 0.0, 0.002, 0.002, 0.0, 0.0]))))
    assert worst is not None
    assert worst.by == "time"
    assert worst.ratio > 2.0


def test_the_verdict_says_that_blocks_disagree_and_deviations_are_as_much_larger() -> None:
    options = rw.CalibrateOptions(drift="none", systematic=False, time_offsets=False, robust="none", misreadings=False)
    right = rw.calibrate(problem_of(1), options)
    assert right.verdict is rw.Verdict.USE
    assert [one.chosen for one in right.choices if one.what == "blocks of the log"] == [
        "agree as well as the noise allows"
    ]
    bent = rw.calibrate(problem_of(1, later=np.array([0.0, 0.004, 0.0, 0.0, 0.0, 0.004])), options)
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
