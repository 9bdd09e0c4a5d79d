"""A target or a sensor that moved half way is named, with how far; data without such a move are not accused."""

from __future__ import annotations

import numpy as np
import pytest
from board_by_camera import poses, problem_of
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.moved_frames import TwoPoses, measured_of, residuals_at_stations, two_poses
from gtsam_rwhec.problem.measurements import Pair

COUNT = 60
MOVED = se3.expmap(np.array([[0.03, 0.0, 0.04, 0.03, 0.0, 0.02]]))[0]


def moving(seed: int, is_moved: np.ndarray, frame: str = "board", noise: float = 1e-3) -> rw.Problem:
    chance = np.random.default_rng(seed)
    X, Y = poses(chance, 2, 1.0, 0.5)
    A = poses(chance, COUNT, 0.5, 0.3)
    B = np.linalg.inv(Y) @ A @ X
    B[is_moved] = B[is_moved] @ MOVED if frame == "board" else MOVED @ B[is_moved]
    return problem_of(A, B @ poses(chance, COUNT, noise, noise))


def found_in(
    problem: rw.Problem, refined: rw.Refined, inliers: dict[Pair, np.ndarray] | None = None
) -> TwoPoses | None:
    return two_poses(residuals_at_stations(refined, measured_of(problem, inliers or {})))


@pytest.mark.parametrize("frame", ["board", "camera"])
def test_a_frame_that_moved_half_way_is_named(frame: str) -> None:
    """Least squares and outlier rejection alike put the answer between the two poses, and said USE."""
    calibration = rw.calibrate(moving(1, np.arange(COUNT) >= COUNT // 2, frame))
    assert calibration.verdict is rw.Verdict.DO_NOT_USE
    assert calibration.judgement.grounds[0] is rw.Ground.MOVED


def test_the_sentence_says_how_far_and_from_when() -> None:
    problem = moving(2, np.arange(COUNT) >= 31)
    refined = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="estimate"))
    found = found_in(problem, refined)
    assert found is not None
    assert (found.frame, found.first, found.second, found.from_row) == ("board", 31, 29, 32)
    assert found.angle_rad == pytest.approx(0.05, rel=0.05)
    assert found.distance_m == pytest.approx(float(np.hypot(0.03, 0.02)), rel=0.1)
    assert "board was at two poses from measurement 32 on" in str(found)
    assert "groups of 31 and 29, 2.8 degrees and 34.7 mm apart" in str(found)


def test_two_poses_that_alternate_have_no_first_row() -> None:
    problem = moving(3, np.arange(COUNT) % 2 == 1)
    refined = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="estimate"))
    found = found_in(problem, refined)
    assert found is not None
    assert found.from_row is None
    assert "board was at two poses: its" in str(found)


@pytest.mark.parametrize("seed", range(5))
def test_one_pose_is_not_accused(seed: int) -> None:
    problem = moving(seed, np.zeros(COUNT, dtype=bool), noise=3e-3)
    refined = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="estimate"))
    assert found_in(problem, refined) is None
    few = {pair: np.arange(COUNT) < 12 for pair in problem.pairs}
    assert found_in(problem, refined, few) is None


def test_the_row_is_that_of_all_measurements_with_those_that_were_left_out() -> None:
    problem = moving(2, np.arange(COUNT) >= 31)
    refined = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="estimate"))
    kept = np.arange(COUNT) % 10 != 3
    found = found_in(problem, refined, {pair: kept for pair in problem.pairs})
    assert found is not None
    assert found.from_row == 32
    assert found.first + found.second == kept.sum()
