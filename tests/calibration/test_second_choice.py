"""Where what was left out agrees with itself far better than what was kept, it is what counts."""

from __future__ import annotations

import numpy as np
from board_by_camera import poses, problem_of

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.outliers import more_consistent

COUNT, GOOD = 30, 14


def with_flipped(seed: int, wrong_noise: float) -> rw.Problem:
    """14 good measurements, and 16 of a board turned by half a turn, with another noise."""
    chance = np.random.default_rng(seed)

    X, Y = poses(chance, 2, 1.0, 0.4)
    A = poses(chance, COUNT, 0.6, 0.3)
    B = np.linalg.inv(Y) @ A @ X @ poses(chance, COUNT, 2e-3, 2e-3)
    flip = np.diag([-1.0, -1.0, 1.0, 1.0])
    B[GOOD:] = B[GOOD:] @ flip @ poses(chance, COUNT - GOOD, wrong_noise, 0.3 * wrong_noise)
    return problem_of(A, B)


def chosen(problem: rw.Problem, kept: np.ndarray) -> np.ndarray | None:
    (pair,) = problem.pairs
    found = more_consistent(problem, {pair: kept})
    return None if found is None else found[pair]


def test_what_agrees_far_better_with_itself_counts() -> None:
    kept = np.arange(COUNT) >= GOOD
    kept[:2] = True  # good ones between the flipped
    found = chosen(with_flipped(0, 0.12), kept)
    assert found is not None
    assert found[:GOOD].all()
    assert not found[GOOD:].any()


def test_a_choice_that_is_right_stands() -> None:
    good = np.arange(COUNT) < GOOD
    assert chosen(with_flipped(1, 0.12), good) is None  # what was left out agrees less
    assert chosen(with_flipped(2, 2e-3), good) is None  # as well
    assert chosen(with_flipped(3, 0.12), np.arange(COUNT) < COUNT - 5) is None  # few were left out


def test_half_flipped_measurements_are_not_to_be_used_and_the_good_ones_are_kept() -> None:
    """18 of 30 were kept with a noise of 8 degrees: USE, and the camera upside down."""
    problem = with_flipped(0, 0.12)
    calibration = rw.calibrate(problem)
    (pair,) = problem.pairs
    assert calibration.verdict is rw.Verdict.DO_NOT_USE
    assert calibration.outliers.inliers[pair][:GOOD].all()
    assert not calibration.outliers.inliers[pair][GOOD:].any()
