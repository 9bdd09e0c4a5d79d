"""What is stated or known: frames that are known to nothing, and stated poses that the measurements contradict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from board_by_camera import X, Y, noisy, problem_of
from rwhec_factors import se3
from rwhec_factors.se3 import expmap, inverse

import gtsam_rwhec as rw
from gtsam_rwhec.calibration.known_frames import of_knowledge
from gtsam_rwhec.calibration.point_uncertainty import Carriers
from gtsam_rwhec.calibration.verdict import Judgement
from gtsam_rwhec.fitting.unknowns import Unknown
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate.simulated_noise import random_poses

#: T_vehicle_lidar: 1.8 m above the vehicle's origin.
LIDAR: Array = expmap(np.array([[0.0, 0.0, 0.3, 0.9, 0.1, 1.8]]))[0]


def driven(pitch_deg: float, noise: float, seed: int = 1) -> rw.Calibration:
    """A vehicle that turns about its z axis by 20 degrees a motion, and about the others by ``pitch_deg``."""
    rng = np.random.default_rng(seed)
    turns = np.radians([pitch_deg, pitch_deg, 20.0])
    xi = rng.normal(size=(200, 6)) * np.r_[turns, 2.0, 0.5, 0.02 if pitch_deg else 0.0]
    A = expmap(xi)
    B = (
        inverse(LIDAR[None])
        @ A
        @ LIDAR
        @ expmap(noise * np.r_[1.0, 1.0, 1.0, 5.0, 5.0, 5.0] * rng.normal(size=(200, 6)))
    )
    problem = rw.Problem(sensor_carrier="ins")
    problem.add_motion("lidar", A, B)
    return rw.calibrate(problem)


def test_a_free_height_of_a_vehicle_is_named_as_height() -> None:
    found = driven(0.0, 1e-3)
    assert found.verdict is rw.Verdict.DO_NOT_USE
    assert "the height of lidar on ins is free" in found.verdict_reason


def test_a_weak_height_is_named_with_its_deviation_and_holds_the_truth() -> None:
    found = driven(1.0, 2e-3)
    assert rw.Ground.HEIGHT_WEAK in found.judgement.grounds
    words = next(one.words for one in found.findings if one.ground is rw.Ground.HEIGHT_WEAK)
    assert words.startswith("the height of lidar on ins is 1.") or words.startswith("the height of lidar on ins is 2")
    height, deviation = found.Y["lidar"].translation()[2], found.standard_deviations("lidar")[1][2] / 1e3
    assert abs(height - 1.8) < 4.0 * deviation
    assert f"+- {deviation:.1g}"[:5] in words


def test_a_height_that_is_known_to_metres_only_is_never_care_alone() -> None:
    found = driven(0.1, 0.01)
    assert found.verdict is rw.Verdict.DO_NOT_USE
    assert rw.Ground.HEIGHT_WEAK in found.judgement.grounds or "height of lidar on ins is free" in found.verdict_reason
    assert "lidar" in found.verdict_reason


def test_a_vehicle_that_pitches_has_a_height() -> None:
    found = driven(10.0, 1e-3)
    assert rw.Ground.HEIGHT_WEAK not in found.judgement.grounds
    assert "height" not in found.verdict_reason


def stereo(turn_rad: float, noise: float) -> rw.Calibration:
    """Two cameras on a body that hardly turns: neither's pose on it is known, and one is known in the other."""
    rng = np.random.default_rng(5)
    left, base, tag = random_poses(3, 0.4, rng)
    right = left @ expmap(np.array([[0.0, 0.02, 0.0, 0.11, 0.0, 0.0]]))[0]
    A = base @ expmap(rng.normal(size=(60, 6)) * np.repeat([turn_rad, 0.1], 3))
    problem = rw.Problem(sensor_carrier="body", target_carrier="world")
    for name, sensor in (("left", left), ("right", right)):
        B = inverse(sensor[None]) @ A @ tag @ expmap(noise * rng.normal(size=(60, 6)))
        problem.add("tag", name, A, B)
    return rw.calibrate(problem)


def test_beside_free_directions_the_verdict_names_what_is_known() -> None:
    found = stereo(0.002, 0.004)
    assert found.judgement.grounds[0] is rw.Ground.NOT_UNIQUE
    assert "known all the same is right in left to" in found.verdict_reason


@pytest.fixture(scope="module")
def known() -> rw.Calibration:
    return stereo(0.3, 0.004)


@pytest.mark.parametrize(("off_rad", "off_m", "is_known"), [(0.1, 0.1, True), (0.7, 0.0, False), (0.0, 3.0, False)])
def test_deviations_of_no_pose_are_a_ground_of_their_own(
    known: rw.Calibration, off_rad: float, off_m: float, is_known: bool
) -> None:
    """Both cameras have an error of the body, as from a path that drifts; in one another they are known as before."""
    refined = known.refined
    assert refined is not None
    shift = np.zeros((len(refined.joint.unit), 6))
    for name in ("left", "right"):
        shift[refined.joint.slots[Unknown.of(name)]] = refined.Y[name].inverse().AdjointMap()
    more = (shift * np.repeat([off_rad, off_m], 3) ** 2) @ shift.T
    doubtful = replace(refined, joint=replace(refined.joint, finite=refined.joint.finite + more))
    found = of_knowledge(known.problem, {}, doubtful, known.views, Carriers("body", "world"))
    judgement = Judgement.of(found, "praise")
    if is_known:
        assert judgement.verdict is rw.Verdict.USE
        return
    assert judgement.verdict is rw.Verdict.DO_NOT_USE
    assert judgement.grounds == (rw.Ground.KNOWN_TO_NOTHING,)
    assert judgement.reason.startswith("left, right on body are known to nothing: standard deviations are up to")
    assert "known all the same is right in left to" in judgement.reason


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
