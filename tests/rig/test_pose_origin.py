"""Where poses come from, by names and types; whether images were taken at rest."""

from __future__ import annotations

import numpy as np
import pytest
from rwhec_factors import se3

from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.rig import PoseNoise
from gtsam_rwhec.rig.carrier_roles import ARM, MOTION_CAPTURE, ODOMETRY, origin_of, rest_of, smoothness_m


@pytest.mark.parametrize(
    ("names", "schema", "noise", "reason"),
    [
        (["/vicon/hand/pose", "world", "hand"], "", MOTION_CAPTURE, "motion capture, by the name /vicon/hand/pose"),
        (["base_link", "tool0"], "", ARM, "a robot's arm, by the name base_link"),
        (["odom", "base_link"], "", ODOMETRY, "visual-inertial odometry or SLAM, by the name odom"),
        (["world", "body"], "nav_msgs/msg/Odometry", ODOMETRY, "by the messages' type nav_msgs/msg/Odometry"),
        (["world", "body"], "", None, "no name tells"),
    ],
)
def test_names_and_types_tell(names: list[str], schema: str, noise: PoseNoise | None, reason: str) -> None:
    origin = origin_of(names, schema)
    assert origin.noise == noise
    assert reason in origin.words


def path(rate_hz: float, number: int, speed_m_s: float = 0.2, noise_m: float = 0.0, stops: bool = False) -> Trajectory:
    stamps = (10**9 + np.arange(number) * 1e9 / rate_hz).astype(np.int64)
    seconds = 1e-9 * (stamps - stamps[0])
    if stops:  # three seconds at each station, one on the way
        seconds = 4.0 * np.floor(seconds / 4.0) + np.clip(4.0 * (seconds % 4.0 - 3.0), 0.0, None)
    xi = np.zeros((number, 6))
    xi[:, 3] = speed_m_s * seconds
    T = se3.expmap(xi)
    T[:, :3, 3] += noise_m * np.random.default_rng(0).normal(size=(number, 3))
    return Trajectory(stamps, T)


@pytest.mark.parametrize("noise_m", [0.0001, 0.003])
def test_how_smooth_a_path_is(noise_m: float) -> None:
    rough = path(100.0, 400, noise_m=noise_m)
    assert smoothness_m(rough) == pytest.approx(noise_m, rel=0.15)
    assert "100 poses a second, smooth to" in origin_of(["base", "hand"], path=rough).words


def test_at_rest_or_in_motion() -> None:
    moving, stopping = path(50.0, 2000), path(50.0, 2000, stops=True)
    at_stations = (10**9 + 10**9 * (4.0 * np.arange(1, 9) + 1.5)).astype(np.int64)
    assert not rest_of(at_stations, moving).at_rest
    assert rest_of(at_stations, stopping).at_rest
    assert rest_of(at_stations, stopping).words == "the carrier stood still at 8 of 8 images"
    assert not rest_of(at_stations + 2 * 10**9, stopping).at_rest  # on the way
    stations = path(0.2, 20)
    assert rest_of(stations.stamps_ns, stations).at_rest
    assert "5 s apart" in rest_of(stations.stamps_ns, stations).words
