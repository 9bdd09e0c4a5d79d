"""Stated poses that the measurements contradict are found, and true ones are not accused."""

from __future__ import annotations

import numpy as np
import pytest
from board_by_camera import X, Y, noisy, problem_of
from rwhec_factors import se3

import gtsam_rwhec as rw


def seen(seed: int = 3, planar: bool = False) -> rw.Problem:
    """Twenty measurements of a board by a camera, 1 mm and 1 mrad."""
    chance = np.random.default_rng(seed)
    xi = np.hstack([0.6 * chance.normal(size=(20, 3)), 0.3 * chance.normal(size=(20, 3))])
    A = se3.expmap(xi * [0, 0, 1, 1, 1, 0] if planar else xi)
    return problem_of(A, noisy(chance, A, 1e-3))


def off(T: np.ndarray, degrees: float, metres: float) -> np.ndarray:
    return T @ se3.expmap(np.array([[np.radians(degrees), 0.0, 0.0, metres, 0.0, 0.0]]))[0]


@pytest.mark.parametrize(("degrees", "metres"), [(29.0, 0.5), (3.0, 0.05), (0.6, 0.01)])
def test_a_prior_far_from_what_the_measurements_say_is_not_to_be_used(degrees: float, metres: float) -> None:
    problem = seen()
    problem.add_prior("board", off(X, degrees, metres), 1e-3, 5e5)
    calibration = rw.calibrate(problem)
    assert calibration.verdict is rw.Verdict.DO_NOT_USE
    assert calibration.judgement.grounds[0] in (rw.Ground.POSE_DOUBTED, rw.Ground.IMPLAUSIBLE)
    if degrees < 10.0:
        assert "the stated pose of board is" in calibration.judgement.reason
        assert calibration.judgement.grounds == (rw.Ground.POSE_DOUBTED,)
        assert calibration.judgement.reason.endswith(rw.Ground.POSE_DOUBTED.advice)


def test_wrong_fixed_poses_are_not_to_be_used() -> None:
    problem = seen()
    problem.fix("board", off(X, 5.7, 0.2))
    problem.fix("camera", Y)
    calibration = rw.calibrate(problem)
    assert calibration.verdict is rw.Verdict.DO_NOT_USE
    assert rw.Ground.POSE_DOUBTED in calibration.judgement.grounds
    assert "camera" not in calibration.judgement.reason.split(";")[0]


def test_measurements_that_were_not_kept_contradict_a_wrong_prior_too() -> None:
    raw = seen().measurements("board", "camera")
    problem = rw.Problem(keep_measurements=False)
    problem.add("board", "camera", raw.A, raw.B)
    problem.add_prior("board", off(X, 5.0, 0.1), 1e-3, 5e5)
    before = problem.priors["board"]
    calibration = rw.calibrate(problem)
    assert "the stated pose of board is" in calibration.judgement.reason
    assert problem.priors["board"] is before
    assert rw.Ground.POSE_DOUBTED in calibration.judgement.grounds


@pytest.mark.parametrize("seed", range(3))
def test_true_stated_poses_are_not_accused(seed: int) -> None:
    problem = seen(seed)
    problem.add_prior("board", off(X, 0.05, 0.001), 1e-3, 5e5)
    problem.fix("camera", Y)
    assert rw.calibrate(problem).verdict is rw.Verdict.USE


def test_what_the_motion_leaves_free_contradicts_nothing() -> None:
    """A planar robot cannot tell the height of the board; the rest of a stated pose is tested."""
    for metres, verdict in ((0.0, rw.Verdict.USE), (0.1, rw.Verdict.DO_NOT_USE)):
        problem = seen(planar=True)
        problem.fix("board", off(X, 0.0, metres))
        assert rw.calibrate(problem).verdict is verdict


@pytest.mark.parametrize(("sigmas", "ground"), [(5.7, rw.Ground.POSE_UNCERTAIN), (9.0, rw.Ground.CONTRADICTED)])
def test_a_fixed_pose_that_fits_badly_asks_for_care(sigmas: float, ground: rw.Ground) -> None:
    """Between chance and contradiction: as with sizes, there is no sharp step from use to refusal."""
    problem = seen()
    free = rw.calibrate(problem)
    along = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    size = sigmas / np.sqrt(along @ np.linalg.solve(free.covariance("board"), along))
    problem.fix("board", free.X["board"].matrix() @ se3.expmap(-size * along[None])[0])
    calibration = rw.calibrate(problem)
    assert "the stated pose of board is" in calibration.verdict_reason
    if ground is rw.Ground.POSE_UNCERTAIN:
        assert calibration.judgement.grounds == (ground,)
        assert calibration.verdict is rw.Verdict.CARE
    else:
        assert calibration.judgement.grounds[0] in (ground, rw.Ground.COVARIANCE_DOUBTED)
