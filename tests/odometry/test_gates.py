"""Steps that no vehicle makes, poses between stamps, windows, and motions of two tracks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drives_with_sensors import drive, tracks
from rwhec_factors import se3

from gtsam_rwhec import odometry
from gtsam_rwhec.errors import CountError, StampError
from gtsam_rwhec.odometry.window_motions import SampledTrack, best_length
from gtsam_rwhec.runs.odometry_cleaning import gated


def test_a_jump_is_one_bad_step_and_the_track_goes_on_without_it() -> None:
    track = tracks(drive("3d", 1))[0]
    T = track.T_start_sensor.copy()
    jump = se3.expmap(np.array([[0.3, 0.0, 0.0, 0.0, 2.0, 0.0]]))[0]
    T[200:] = T[199] @ jump @ se3.inverse(T[199][None])[0] @ T[200:]
    found = gated(replace(track, T_start_sensor=T), odometry.OdometryOptions().gates)
    np.testing.assert_array_equal(np.flatnonzero(~found.good), [199])
    assert found.removed[0].index == 200
    step = se3.inverse(found.track.T_start_sensor[199][None])[0] @ found.track.T_start_sensor[200]
    true = se3.inverse(track.T_start_sensor[199][None])[0] @ track.T_start_sensor[200]
    np.testing.assert_allclose(step, true, atol=0.05)
    later = se3.inverse(found.track.T_start_sensor[200][None])[0] @ found.track.T_start_sensor[300]
    np.testing.assert_allclose(later, se3.inverse(T[200][None])[0] @ T[300], atol=1e-9)


def test_speeds_are_limited_by_rate() -> None:
    track = tracks(drive("3d", 1))[0]
    found = gated(track, odometry.OdometryOptions(max_speed_m_per_s=3.0).gates)
    assert 0 < found.good.sum() < len(found.good)
    assert not gated(track, odometry.OdometryOptions().gates).removed


def test_poses_between_stamps() -> None:
    track = tracks(drive("3d", 1))[0]
    coarse = replace(track, stamps_ns=track.stamps_ns[::2], T_start_sensor=track.T_start_sensor[::2])
    sampled = SampledTrack(coarse, 0, 0.25, np.ones(len(coarse.stamps_ns) - 1, dtype=bool))
    at = track.stamps_ns[21:60:2] * 1e-9
    off = se3.logmap(se3.inverse(sampled.poses(at + 0.25)) @ track.T_start_sensor[21:60:2])
    assert np.abs(off).max() < 0.02
    np.testing.assert_allclose(
        sampled.poses(coarse.stamps_ns[10:12] * 1e-9 + 0.25), coarse.T_start_sensor[10:12], atol=1e-9
    )
    covered = sampled.covers(np.array([0.0, 0.3, 39.0]), np.array([0.1, 0.4, 50.0]), 0.5)
    np.testing.assert_array_equal(covered, [False, True, False])


def test_windows_are_longer_where_the_noise_is_larger() -> None:
    lengths = []
    for factor in (1.0, 30.0):
        driven = drive("3d", 2)
        generator = np.random.default_rng(0)
        samples = []
        for track in tracks(driven)[:2]:
            T = track.T_start_sensor
            steps = se3.inverse(T[:-1]) @ T[1:] @ se3.expmap(generator.normal(0.0, 3e-4 * factor, (len(T) - 1, 6)))
            noisy = [T[0]]
            for step in steps:
                noisy.append(noisy[-1] @ step)
            good = np.ones(len(T) - 1, dtype=bool)
            samples.append(SampledTrack(replace(track, T_start_sensor=np.array(noisy)), 0, 0.0, good))
        lengths.append(best_length(samples, 0.5))
    assert lengths[1] > lengths[0] >= 0.0999


def test_stamps_that_do_not_ascend_are_named() -> None:
    with pytest.raises(StampError, match=r"lidar goes back in time at row 2: 15 ns after 20 ns"):
        odometry.OdometryTrack("lidar", np.array([10, 20, 15]), np.tile(np.eye(4), (3, 1, 1)))


def test_one_pose_for_each_stamp() -> None:
    with pytest.raises(CountError, match="3 stamps and poses of shape"):
        odometry.OdometryTrack("lidar", np.array([10, 20, 30]), np.tile(np.eye(4), (2, 1, 1)))
