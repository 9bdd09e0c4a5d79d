"""Interpolation on SE(3), gaps, clocks, speeds; thinning and odometry's gates."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.geometry import Trajectory
from gtsam_rwhec.geometry.trajectory import SmoothPath
from gtsam_rwhec.runs import synchronise, thin, without_fast

TWIST = np.array([0.4, -0.2, 0.7, 0.3, 0.1, -0.5])


def screw(seconds: np.ndarray) -> np.ndarray:
    return se3.expmap(seconds[:, None] * TWIST)


STAMPS = np.arange(0, 50) * 10**8 + 7
ROAD = Trajectory.of(STAMPS, screw((STAMPS - 7) * 1e-9))


@settings(max_examples=50, deadline=None)
@given(st.integers(7, 49 * 10**8 + 7))
def test_a_constant_twist_is_interpolated_exactly(stamp: int) -> None:
    pose, gap = ROAD.at(np.array([stamp]))
    np.testing.assert_allclose(pose[0], screw(np.array([(stamp - 7) * 1e-9]))[0], atol=1e-9)
    assert gap[0] == pytest.approx(0.0 if (stamp - 7) % 10**8 == 0 else 0.1)


def test_it_is_gtsams_interpolation() -> None:
    T = np.array([gtsam.Pose3.Expmap(x).matrix() for x in np.random.default_rng(0).normal(size=(2, 6))])
    pose, _ = Trajectory.of(np.array([0, 1000]), T).at(np.array([300]))
    expected = gtsam.Pose3(T[0]).compose(
        gtsam.Pose3.Expmap(0.3 * gtsam.Pose3.Logmap(gtsam.Pose3(T[0]).between(gtsam.Pose3(T[1]))))
    )
    np.testing.assert_allclose(pose[0], expected.matrix(), atol=1e-12)


def test_gaps_and_ends_are_named() -> None:
    holes = np.delete(STAMPS, np.arange(20, 30))
    road = Trajectory.of(holes, screw((holes - 7) * 1e-9), "/odom")
    stamps = np.array([0, 7, 5 * 10**7, 25 * 10**8, 48 * 10**8, 60 * 10**8])
    A, kept = synchronise(road, stamps)
    assert kept.mask.tolist() == [False, True, True, False, True, False]
    assert A.shape == (6, 4, 4)
    assert kept.counts == {"outside the carrier's trajectory (s)": 2, "gap in the carrier's poses (s)": 1}
    assert [item.index for item in kept.removed] == [0, 3, 5]
    assert kept.removed[1].value == pytest.approx(1.1)


def test_the_offset_moves_the_sensors_stamps() -> None:
    A, _ = synchronise(ROAD, np.array([10**9]), time_offset_s=0.25)
    np.testing.assert_allclose(A[0], screw(np.array([1.25 - 7e-9]))[0], atol=1e-9)


def test_stamps_without_overlap_are_of_another_clock() -> None:
    with pytest.raises(rw.errors.StampError, match=r"no overlap in time: .* different clocks"):
        synchronise(ROAD, np.array([10**18, 10**18 + 1]))


@pytest.mark.parametrize(
    ("stamps", "words"),
    [
        (np.zeros(3, dtype=int), "all 3 stamps are 0"),
        (np.array([1, 3, 2]), r"stamp 2 \(2 ns\) is before"),
        (np.array([1, 3, 3]), r"stamp 2 \(3 ns\) repeats"),
        (np.array([1.0, 2.0, 3.0]), "integer nanoseconds"),
        (np.array([1, 2]), "shape"),
    ],
)
def test_bad_stamps(stamps: np.ndarray, words: str) -> None:
    with pytest.raises(rw.errors.StampError, match=words):
        Trajectory.of(stamps, screw(np.arange(3.0)), "/tf")


def test_bad_poses() -> None:
    with pytest.raises(rw.errors.PoseError, match="no poses"):
        Trajectory.of(np.zeros(0, dtype=int), np.zeros((0, 4, 4)))
    with pytest.raises(rw.errors.PoseError, match="/tf"):
        Trajectory.of(np.array([1]), 2 * np.eye(4)[None], "/tf")


def test_speeds() -> None:
    inside = STAMPS[1:-1]
    turning, moving = ROAD.speeds(inside, 1_000_000)
    np.testing.assert_allclose(turning, np.linalg.norm(TWIST[:3]), rtol=1e-6)
    assert moving.max() < 1.1 * np.linalg.norm(TWIST[3:])
    kept = without_fast(turning, moving, inside, max_turning_rad_s=2.0, max_moving_m_s=2.0)
    assert kept.mask.all()
    kept = without_fast(turning, moving, inside, max_turning_rad_s=0.5, max_moving_m_s=0.1)
    assert kept.counts == {"turning fast (rad/s)": 48}


def test_standstill_is_thinned_to_one() -> None:
    moving = screw(np.arange(10) * 0.1)
    A = np.concatenate([np.repeat(moving[:1], 30, axis=0), moving, np.repeat(moving[-1:], 20, axis=0)])
    kept = thin(A, np.arange(60))
    np.testing.assert_array_equal(A[kept.mask], moving)
    assert kept.counts == {"standstill (m moved)": 50}
    # Turning on the spot is motion.
    turning = se3.expmap(np.arange(10)[:, None] * np.array([0, 0, 0.02, 0, 0, 0]))
    assert thin(turning, np.arange(10)).mask.all()


STAMPS_OF_PATH = np.arange(1000) * 10_000_000
INSIDE = np.arange(500_000_000, 9_000_000_000, 13_000_001)


def road(t: np.ndarray, hertz: float = 0.4) -> np.ndarray:
    w = 2.0 * np.pi * hertz
    return se3.expmap(np.column_stack([np.sin(w * t), np.cos(0.7 * w * t), 0.5 * np.sin(0.4 * w * t + 1.0)] * 2))


def velocity(t: np.ndarray, hertz: float = 0.4) -> np.ndarray:
    h = 1e-5
    return se3.logmap(se3.inverse(road(t - h, hertz)) @ road(t + h, hertz)) / (2.0 * h)


def test_noise_is_averaged_and_its_variance_is_known() -> None:
    noise = se3.expmap(0.003 * np.random.default_rng(0).normal(size=(1000, 6)))
    smooth = SmoothPath.of(Trajectory.of(STAMPS_OF_PATH, road(STAMPS_OF_PATH * 1e-9) @ noise))
    poses, found, variance = smooth.at(INSIDE)
    assert np.sqrt(smooth.scatter).mean() == pytest.approx(0.003, rel=0.1)
    off = se3.logmap(se3.inverse(road(INSIDE * 1e-9)) @ poses)
    assert np.sqrt(np.mean(off**2)) < 0.6 * 0.003
    ratio = np.mean((found - velocity(INSIDE * 1e-9)) ** 2 / variance)
    assert 0.4 < ratio < 2.5


@pytest.mark.parametrize("hertz", [0.4, 3.0])
def test_exact_paths_stay_exact(hertz: float) -> None:
    smooth = SmoothPath.of(Trajectory.of(STAMPS_OF_PATH, road(STAMPS_OF_PATH * 1e-9, hertz)))
    poses, found, _ = smooth.at(INSIDE)
    t = INSIDE * 1e-9
    assert np.abs(se3.logmap(se3.inverse(road(t, hertz)) @ poses)).max() < 2e-3
    assert np.abs(found - velocity(t, hertz)).max() < 0.01 * np.abs(velocity(t, hertz)).max()


def test_a_gap_does_not_reach_into_what_is_beside_it() -> None:
    kept = (STAMPS_OF_PATH < 4_000_000_000) | (STAMPS_OF_PATH > 6_000_000_000)
    smooth = SmoothPath.of(Trajectory.of(STAMPS_OF_PATH[kept], road(STAMPS_OF_PATH[kept] * 1e-9)))
    beside = np.array([3_900_000_000, 6_100_000_000])
    off = se3.logmap(se3.inverse(road(beside * 1e-9)) @ smooth.at(beside)[0])
    assert np.abs(off).max() < 1e-3


def test_too_few_poses() -> None:
    with pytest.raises(rw.errors.StampError, match="/hand: 7 poses are too few"):
        SmoothPath.of(Trajectory.of(STAMPS_OF_PATH[:7], road(STAMPS_OF_PATH[:7] * 1e-9), "/hand"))
