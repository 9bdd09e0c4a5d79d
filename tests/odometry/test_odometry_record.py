"""The record of a calibration of odometries says its verdict first, and gives poses between any two sensors."""

from __future__ import annotations

import numpy as np
import pytest
from rwhec_factors import se3

from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.odometry import JointCertificate, OdometryCalibration, OdometryNoise, OtherAnswer, Windows
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
