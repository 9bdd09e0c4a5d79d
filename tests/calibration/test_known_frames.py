"""The verdict names what is known to nothing, a vehicle's height that its motion does not tell, and what is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
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
    for name, Y in (("left", left), ("right", right)):
        B = inverse(Y[None]) @ A @ tag @ expmap(noise * rng.normal(size=(60, 6)))
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
