"""Outliers that agree with one another name the frame that moved; others, and the frames beside it, are not named."""

from __future__ import annotations

import numpy as np
import pytest
from rwhec_factors.se3 import expmap, inverse

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.moved_frames import Measured, mixed_sensors, moved_with_outliers
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.simulate.simulated_noise import random_poses

#: A step of 3 degrees and 2 cm; noise of 0.02 degrees and 0.2 mm; the measurement before which the frame moves.
STEP = expmap(np.array([[0.03, -0.02, 0.04, 0.012, -0.015, 0.008]]))[0]
NOISE, FIRST, COUNT = np.repeat([3e-4, 2e-4], 3), 18, 28
PAIR = Pair("board", "camera")


def seen(moved: str, seed: int) -> tuple[Refined, dict[Pair, Measured]]:
    """The answer from the measurements before a frame moved, and all of them; "nothing": the others are random."""
    rng = np.random.default_rng(seed)
    X, Y = random_poses(2, 0.5, rng)
    A = random_poses(COUNT, 0.4, rng)
    after = np.arange(COUNT) >= FIRST
    X_then, Y_then = (
        np.where(after[:, None, None] & (moved == name), T @ STEP, T)
        for name, T in zip(PAIR.frames, (X, Y), strict=True)
    )
    B = inverse(Y_then) @ A @ X_then @ expmap(NOISE * rng.standard_normal((COUNT, 6)))
    if moved == "nothing":
        B[after] = random_poses(int(after.sum()), 0.6, rng)
    problem = rw.Problem()
    problem.add(*PAIR, A[~after], B[~after])
    refined = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="estimate"))
    return refined, {PAIR: Measured(A, B, ~after)}


@pytest.mark.parametrize("moved", PAIR.frames)
def test_the_frame_that_moved_is_named_with_the_moment_and_the_step(moved: str) -> None:
    found = moved_with_outliers(*seen(moved, 1))
    assert found is not None
    assert (found.frame, found.from_row, found.first, found.second) == (moved, FIRST + 1, FIRST, COUNT - FIRST)
    assert found.is_sensor is (moved == "camera")
    step: Array = np.array([found.angle_rad, found.distance_m])
    assert step == pytest.approx([np.linalg.norm([0.03, 0.02, 0.04]), np.linalg.norm(STEP[:3, 3])], rel=0.05)
    assert ("mount" in str(found)) is (moved == "camera")


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_outliers_that_agree_in_no_frame_name_none(seed: int) -> None:
    assert moved_with_outliers(*seen("nothing", seed)) is None


def test_few_outliers_name_none() -> None:
    refined, measured = seen("board", 5)
    few = measured[PAIR].kept.copy()
    few[FIRST + 3 :] = True
    assert moved_with_outliers(refined, {PAIR: Measured(measured[PAIR].A, measured[PAIR].B, few)}) is None


def test_outliers_of_one_step_that_come_and_go_are_no_move() -> None:
    """Another board was taken for this one in every fifth image: it was said to have moved "from measurement 2 on"."""
    refined, measured = seen("board", 7)
    assert moved_with_outliers(refined, {PAIR: by_turns(measured)}) is None


def by_turns(measured: dict[Pair, Measured]) -> Measured:
    """The measurements after the move, spread among those before it."""
    order = np.argsort(np.r_[np.linspace(0.0, 1.0, FIRST), np.linspace(0.05, 0.95, COUNT - FIRST)], kind="stable")
    one = measured[PAIR]
    return Measured(one.A[order], one.B[order], one.kept[order])


@pytest.mark.parametrize("seed", range(20, 25))
def test_two_sensors_by_turns_are_named_and_other_outliers_are_not(seed: int) -> None:
    refined, measured = seen("camera", seed)
    mixed = by_turns(measured)
    some = np.flatnonzero(~mixed.kept)[4:]  # of these, boards' turns are wrong: they agree with nobody
    mixed.B[some] = mixed.B[some] @ random_poses(len(some), 0.5, np.random.default_rng(seed))
    found = mixed_sensors(refined, {PAIR: mixed})
    assert found is not None
    assert (found.frame, found.first, found.second, found.from_row) == ("camera", FIRST, 4, None)
    for other in ("board", "nothing"):
        refined, measured = seen(other, seed)
        assert mixed_sensors(refined, {PAIR: by_turns(measured)}) is None


def test_one_wrong_view_that_was_seen_many_times_is_no_second_sensor() -> None:
    refined, measured = seen("nothing", 8)
    one = measured[PAIR]
    A, B = one.A.copy(), one.B.copy()
    A[FIRST:], B[FIRST:] = A[FIRST], B[FIRST]
    assert mixed_sensors(refined, {PAIR: Measured(A, B, one.kept)}) is None


def test_calibrate_says_that_two_sensors_are_mixed() -> None:
    mixed = by_turns(seen("camera", 9)[1])
    problem = rw.Problem()
    problem.add(*PAIR, mixed.A, mixed.B)
    judgement = rw.calibrate(problem).judgement
    assert judgement.grounds == (rw.Ground.MIXED,)
    assert "camera has measurements of two sensors" in judgement.reason


def test_calibrate_says_that_a_board_moved_late_in_place_of_outliers() -> None:
    _, measured = seen("board", 6)
    problem = rw.Problem()
    problem.add(*PAIR, measured[PAIR].A, measured[PAIR].B)
    judgement = rw.calibrate(problem).judgement
    assert judgement.grounds == (rw.Ground.MOVED,)
    assert "board was at two poses from measurement 19 on" in judgement.reason
