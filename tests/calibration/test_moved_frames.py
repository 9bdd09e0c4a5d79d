"""A frame that moved once is named where its step bends the answer; walks, stations and good data are not accused."""

from __future__ import annotations

import numpy as np
import pytest
from board_by_camera import poses, problem_of
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.moved_frames import step_of
from gtsam_rwhec.calibration.trial_fits import Sample
from gtsam_rwhec.fitting.noise_search import CORRELATED, likeness_of_neighbours

COUNT = 120


def stream(step_m: float, seed: int = 0, walk: float = 0.0) -> rw.Problem:
    """A smooth stream in which the board moves by some metres at row 60, or walks all the time."""
    chance = np.random.default_rng(seed)
    X, Y = poses(chance, 2, 1.0, 0.4)
    time = np.linspace(0.0, 12.0, COUNT)[:, None]
    xi = np.sin(time * chance.uniform(0.5, 2.0, 6) + chance.uniform(0.0, 6.0, 6)) * ([0.5] * 3 + [0.25] * 3)
    A = se3.expmap(xi)
    B = np.linalg.inv(Y) @ A @ X
    moved = np.eye(4)
    moved[0, 3] = step_m
    B[60:] = B[60:] @ moved
    B = B @ se3.expmap(walk * np.cumsum(chance.normal(size=(COUNT, 6)), axis=0)) @ poses(chance, COUNT, 3e-3, 3e-3)
    return problem_of(A, B, stamps_ns=np.arange(COUNT) * 10**8)


def sample_of(problem: rw.Problem) -> Sample:
    return {pair: (problem.measurements(*pair).A, problem.measurements(*pair).B) for pair in problem.pairs}


def test_a_step_in_a_stream_is_no_drift() -> None:
    """It was taken for correlated errors: USE, with the camera 0.2 m off."""
    calibration = rw.calibrate(stream(0.3))
    assert calibration.verdict is rw.Verdict.DO_NOT_USE
    assert calibration.judgement.grounds[0] is rw.Ground.MOVED
    assert "board was at two poses from measurement" in calibration.verdict_reason


@pytest.mark.parametrize("step_m", [0.1, 1.0])
def test_the_row_and_the_distance_are_found(step_m: float) -> None:
    problem = stream(step_m)
    found, _ = step_of(problem, sample_of(problem)) or pytest.fail("no step")
    assert found.frame == "board"
    assert found.distance_m == pytest.approx(step_m, rel=0.1)
    assert found.from_row == pytest.approx(61, abs=2)
    assert found.first + found.second == COUNT


@pytest.mark.parametrize("seed", range(3))
def test_a_walk_and_good_data_have_not_moved(seed: int) -> None:
    for problem in (stream(0.0, seed, walk=1e-3), stream(0.0, seed)):
        assert step_of(problem, sample_of(problem)) is None


def test_few_poses_hold_no_step() -> None:
    chance = np.random.default_rng(3)
    A = np.repeat(poses(chance, 5, 0.6, 0.3), 10, axis=0)
    X, Y = poses(chance, 2, 1.0, 0.4)
    B = np.linalg.inv(Y) @ A @ np.repeat(poses(chance, 5, 4e-3, 4e-3), 10, axis=0) @ X @ poses(chance, 50, 1e-4, 1e-4)
    problem = problem_of(A, B)
    assert step_of(problem, sample_of(problem)) is None
    calibration = rw.calibrate(problem)
    assert calibration.verdict is rw.Verdict.CARE
    assert "poses of the carriers, and each pose has one error" in calibration.verdict_reason


def test_neighbours_of_a_walk_are_alike_and_those_of_noise_are_not() -> None:
    noise = np.random.default_rng(4).normal(size=(60, 6))
    assert likeness_of_neighbours([np.cumsum(noise, axis=0)]) > CORRELATED
    assert likeness_of_neighbours([noise, noise[:1], noise[:0]]) < CORRELATED
