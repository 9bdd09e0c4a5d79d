"""The record of a calibration of odometries says its verdict first, and gives poses between any two sensors."""

from __future__ import annotations

import numpy as np
import pytest
from rwhec_factors import se3

from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.odometry import JointCertificate, OdometryCalibration, OdometryNoise, OtherAnswer, Windows
from gtsam_rwhec.odometry.odometry_outcome import poorly_known
from gtsam_rwhec.solver.certificate import Status


def _calibration(status: Status, others: tuple[OtherAnswer, ...] = ()) -> OdometryCalibration:
    at = {name: se3.expmap(np.array([twist]))[0] for name, twist in (("camera", [0.1, 0, 0, 1, 2, 3]),)}
    return OdometryCalibration(
        reference="lidar",
        sensors=("lidar", "camera"),
        T_reference_sensor={"lidar": np.eye(4), **at},
        scales={"camera": 0.5},
        time_offsets_s={"camera": 0.0},
        time_offset_sigmas_s={},
        order=("camera",),
        covariance=np.eye(7) * 1e-4,
        certificate=JointCertificate(status, 10.0, 9.0, 1.0, 1e-5, 100.0),
        free_directions=(),
        windows=Windows(0.5, 3, {"lidar": 3, "camera": 2}, np.arange(3), np.arange(3) + 1),
        noise={name: OdometryNoise(1e-3, 1e-2) for name in ("lidar", "camera")},
        noise_was_found=frozenset(["camera"]),
        removed={"lidar": (), "camera": ()},
        residuals={"lidar": (1.0, 1.0), "camera": (1.0, 1.0)},
        others=others,
    )


@pytest.mark.parametrize(
    ("status", "others", "grounds"),
    [
        (Status.CERTIFIED, (), ()),
        (Status.GAP, (), (Ground.NOT_CERTIFIED,)),
        (Status.CERTIFIED, (OtherAnswer("the distance has two signs", {}),), (Ground.NOT_UNIQUE,)),
    ],
)
def test_the_verdict_is_of_proof_and_uniqueness(
    status: Status, others: tuple[OtherAnswer, ...], grounds: tuple[Ground, ...]
) -> None:
    found = _calibration(status, others)
    assert found.judgement.grounds == grounds
    assert str(found) == str(found.judgement)


def test_poses_between_any_two_sensors() -> None:
    found = _calibration(Status.CERTIFIED)
    np.testing.assert_allclose(found.T("camera", "lidar") @ found.T_reference_sensor["camera"], np.eye(4), atol=1e-15)
    assert found.is_unique
    assert not found.covariance_of("lidar").any()
    np.testing.assert_array_equal(found.covariance_of("camera"), 1e-4 * np.eye(6))


@pytest.mark.parametrize(
    ("deviation_m", "upright", "ground", "words"),
    [
        (0.5, True, Ground.HEIGHT_WEAK, "the height of rear over lidar (along the z axis of lidar) is 1.3 +- 0.5 m"),
        (6.3, True, Ground.KNOWN_TO_NOTHING, "the height of rear over lidar (along the z axis of lidar) is 1.3 +- 6.3"),
        (0.5, False, Ground.COVARIANCE_DOUBTED, "rear is known only to 0.5 m"),
        (6.3, False, Ground.KNOWN_TO_NOTHING, "rear is known only to 6.3 m"),
    ],
)
def test_a_poorly_known_height_is_named_as_height(
    deviation_m: float, upright: bool, ground: Ground, words: str
) -> None:
    """A height of 33.0 +- 6.3 m had the verdict "care", and no word of height."""
    T = se3.expmap(np.array([[0.3, -0.4, 0.5, 0.0, 0.0, 0.0]]))[0]
    T[:3, 3] = [2.0, 0.1, 1.3]
    up = np.array([0.0, 0.0, 1.0])
    along = up @ T[:3, :3]
    covariance = 1e-6 * np.eye(6)
    covariance[3:, 3:] += deviation_m**2 * np.outer(along, along)
    found = poorly_known("rear", T, covariance, up if upright else None, "lidar")
    assert found.ground is ground
    assert found.words.startswith(words)
