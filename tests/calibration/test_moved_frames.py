"""Frames that moved are named, by steps, by outliers that agree, by two poses; good data and walks are not accused."""

from __future__ import annotations

import numpy as np
import pytest
from board_by_camera import poses, problem_of
from rwhec_factors import se3
from rwhec_factors.se3 import expmap, inverse

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.moved_frames import (
    Measured,
    TwoPoses,
    measured_of,
    mixed_sensors,
    moved_at_the_end,
    moved_with_outliers,
    residuals_at_stations,
    step_of,
    two_poses,
)
from gtsam_rwhec.calibration.trial_fits import Sample
from gtsam_rwhec.fitting.noise_search import CORRELATED, likeness_of_neighbours
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.simulate.simulated_noise import random_poses

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


#: A step of 3 degrees and 2 cm; noise of 0.02 degrees and 0.2 mm; the measurement before which the frame moves.
STEP = expmap(np.array([[0.03, -0.02, 0.04, 0.012, -0.015, 0.008]]))[0]
NOISE, FIRST, OUTLIERS_OF = np.repeat([3e-4, 2e-4], 3), 18, 28
PAIR = Pair("board", "camera")


def seen(moved: str, seed: int) -> tuple[Refined, dict[Pair, Measured]]:
    """The answer from the measurements before a frame moved, and all of them; "nothing": the others are random."""
    rng = np.random.default_rng(seed)
    X, Y = random_poses(2, 0.5, rng)
    A = random_poses(OUTLIERS_OF, 0.4, rng)
    after = np.arange(OUTLIERS_OF) >= FIRST
    X_then, Y_then = (
        np.where(after[:, None, None] & (moved == name), T @ STEP, T)
        for name, T in zip(PAIR.frames, (X, Y), strict=True)
    )
    B = inverse(Y_then) @ A @ X_then @ expmap(NOISE * rng.standard_normal((OUTLIERS_OF, 6)))
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
    assert (found.frame, found.from_row, found.first, found.second) == (moved, FIRST + 1, FIRST, OUTLIERS_OF - FIRST)
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
    order = np.argsort(np.r_[np.linspace(0.0, 1.0, FIRST), np.linspace(0.05, 0.95, OUTLIERS_OF - FIRST)], kind="stable")
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


SLIPS = 20


def slipped(at: int, seed: int, count: int = SLIPS) -> rw.Problem:
    """The mount of a camera slips by 0.46 degrees and 4 mm; noise of 0.07 degrees and 0.4 mm."""
    chance = np.random.default_rng(seed)
    X, Y = poses(chance, 2, 1.0, 0.4)
    A = poses(chance, count, 1.5, 0.3)
    then = Y @ expmap(np.array([[8e-3, 0.0, 0.0, 0.0, 4e-3, 0.0]]))[0]
    Y = np.where((np.arange(count) >= at)[:, None, None], then, Y)
    return problem_of(A, inverse(Y) @ A @ X @ poses(chance, count, 1.2e-3, 4e-4))


@pytest.mark.parametrize(
    ("seed", "ground", "words"),
    [
        (1, rw.Ground.MOVED, "camera was at two poses from measurement 9 on"),
        (2, rw.Ground.CORRELATED, "a mount or a target that gave way does this"),
        (3, rw.Ground.CORRELATED, "a mount or a target that gave way does this"),
    ],
)
def test_halves_of_few_measurements_disagree_too(seed: int, ground: rw.Ground, words: str) -> None:
    """The step was taken for noise: USE, as from 20 measurements on alone halves of them were compared."""
    judgement = rw.calibrate(slipped(8, seed, 16)).judgement
    assert judgement.grounds == (ground,)
    assert words in judgement.reason


def test_a_mount_that_slipped_is_alike_in_its_own_axes_and_not_in_those_of_the_target() -> None:
    judgement = rw.calibrate(slipped(SLIPS // 2, 6)).judgement
    assert judgement.grounds[0] is rw.Ground.MOVED
    assert "camera was at two poses" in judgement.reason


@pytest.mark.parametrize("seed", range(4))
def test_the_last_measurements_that_agree_on_another_pose_have_moved(seed: int) -> None:
    """They were four outliers of twenty: USE, with the camera where it no longer was (4 mm, chi2 of 200 and more)."""
    calibration = rw.calibrate(slipped(SLIPS - 4, seed))
    assert calibration.judgement.grounds[0] is rw.Ground.MOVED
    assert f"from measurement {SLIPS - 3} on" in calibration.verdict_reason
    assert calibration.refined is not None
    (one,) = measured_of(calibration.problem, calibration.outliers.inliers).values()
    earlier = Measured(*(np.roll(of, 8, axis=0) for of in (one.A, one.B, one.kept)))  # it was put back
    assert moved_at_the_end(calibration.refined, {PAIR: earlier}) is None
    A, last = one.A.copy(), np.arange(SLIPS) >= SLIPS - 4  # neighbours in a stream are one view, which may be misread
    A[last] = A[-1] @ poses(np.random.default_rng(seed), 4, 1e-3, 1e-3)
    X, Y = calibration.X["board"].matrix(), calibration.Y["camera"].matrix()
    B = np.where(last[:, None, None], inverse(Y @ STEP) @ A @ X, one.B)
    assert moved_at_the_end(calibration.refined, {PAIR: Measured(A, B, ~last)}) is None
    B = one.B.copy()
    B[~one.kept] = B[~one.kept] @ poses(np.random.default_rng(seed), int((~one.kept).sum()), 0.2, 0.1)
    assert moved_at_the_end(calibration.refined, {PAIR: Measured(one.A, B, one.kept)}) is None


HALVED = 60
MOVED = se3.expmap(np.array([[0.03, 0.0, 0.04, 0.03, 0.0, 0.02]]))[0]


def moving(seed: int, is_moved: np.ndarray, frame: str = "board", noise: float = 1e-3) -> rw.Problem:
    chance = np.random.default_rng(seed)
    X, Y = poses(chance, 2, 1.0, 0.5)
    A = poses(chance, HALVED, 0.5, 0.3)
    B = np.linalg.inv(Y) @ A @ X
    B[is_moved] = B[is_moved] @ MOVED if frame == "board" else MOVED @ B[is_moved]
    return problem_of(A, B @ poses(chance, HALVED, noise, noise))


def found_in(
    problem: rw.Problem, refined: rw.Refined, inliers: dict[Pair, np.ndarray] | None = None
) -> TwoPoses | None:
    return two_poses(residuals_at_stations(refined, measured_of(problem, inliers or {})))


@pytest.mark.parametrize("frame", ["board", "camera"])
def test_a_frame_that_moved_half_way_is_named(frame: str) -> None:
    """Least squares and outlier rejection alike put the answer between the two poses, and said USE."""
    calibration = rw.calibrate(moving(1, np.arange(HALVED) >= HALVED // 2, frame))
    assert calibration.verdict is rw.Verdict.DO_NOT_USE
    assert calibration.judgement.grounds[0] is rw.Ground.MOVED


def test_the_sentence_says_how_far_and_from_when() -> None:
    problem = moving(2, np.arange(HALVED) >= 31)
    refined = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="estimate"))
    found = found_in(problem, refined)
    assert found is not None
    assert (found.frame, found.first, found.second, found.from_row) == ("board", 31, 29, 32)
    assert found.angle_rad == pytest.approx(0.05, rel=0.05)
    assert found.distance_m == pytest.approx(float(np.hypot(0.03, 0.02)), rel=0.1)
    assert "board was at two poses from measurement 32 on" in str(found)
    assert "groups of 31 and 29, 2.8 degrees and 34.7 mm apart" in str(found)


def test_two_poses_that_alternate_have_no_first_row() -> None:
    problem = moving(3, np.arange(HALVED) % 2 == 1)
    refined = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="estimate"))
    found = found_in(problem, refined)
    assert found is not None
    assert found.from_row is None
    assert "board was at two poses: its" in str(found)


@pytest.mark.parametrize("seed", range(5))
def test_one_pose_is_not_accused(seed: int) -> None:
    problem = moving(seed, np.zeros(HALVED, dtype=bool), noise=3e-3)
    refined = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="estimate"))
    assert found_in(problem, refined) is None
    few = {pair: np.arange(HALVED) < 12 for pair in problem.pairs}
    assert found_in(problem, refined, few) is None


def test_the_row_is_that_of_all_measurements_with_those_that_were_left_out() -> None:
    problem = moving(2, np.arange(HALVED) >= 31)
    refined = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="estimate"))
    kept = np.arange(HALVED) % 10 != 3
    found = found_in(problem, refined, {pair: kept for pair in problem.pairs})
    assert found is not None
    assert found.from_row == 32
    assert found.first + found.second == kept.sum()


def drifting(seed: int, *, is_drift: bool) -> rw.Problem:
    """Ten to eighteen measurements: the first quarter drifts, or a quarter at random places is wrong."""
    chance = np.random.default_rng(seed)
    count = int(chance.integers(10, 19))
    X, Y = poses(chance, 2, 1.0, 0.4)
    A = poses(chance, count, 1.0, 0.4)
    B = inverse(Y) @ A @ X @ poses(chance, count, 2e-4, 1e-4)
    if is_drift:
        steps = np.where(np.arange(count)[:, None] < count // 4, 8e-4 * chance.normal(size=(count, 6)), 0.0)
        B = B @ se3.expmap(np.cumsum(steps[::-1], axis=0)[::-1])
    else:
        wrong = chance.choice(count, count // 4, replace=False)
        B[wrong] = B[wrong] @ poses(chance, len(wrong), 0.02, 0.01)
    return problem_of(A, B)


@pytest.mark.parametrize("seed", range(4))
def test_outliers_that_are_off_as_their_neighbours_are_drift(seed: int) -> None:
    """The drifting end of a track was three to four outliers: USE, and ellipsoids of what stood still later."""
    judgement = rw.calibrate(drifting(seed, is_drift=True)).judgement
    assert judgement.grounds == (rw.Ground.CORRELATED,)
    assert "off in the same way as their neighbours" in judgement.reason
    calibration = rw.calibrate(drifting(seed, is_drift=False))
    assert calibration.outliers.number >= 2
    assert calibration.verdict is rw.Verdict.USE
