"""Errors of trajectories that are no random walk: what they do to windows, how they are found, and what is left."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drives_with_sensors import drive, squares, tracks
from rwhec_factors import se3
from scipy.special import chdtrc

from gtsam_rwhec import odometry
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry import trajectory_errors
from gtsam_rwhec.odometry.trajectory_errors import ErrorKind
from gtsam_rwhec.odometry.window_likelihood import Layout
from gtsam_rwhec.odometry.window_motions import SampledTrack, WindowMotions

#: Small enough that effects are of first order.
SMALL = 1e-5


def windows_of(stamps_ns: np.ndarray, T: Array) -> WindowMotions:
    """Windows of five steps of two tracks, of which the second is this one."""
    good = np.ones(len(T) - 1, dtype=bool)
    both = [SampledTrack(odometry.OdometryTrack(name, stamps_ns, T), 0, 0.0, good) for name in ("first", "second")]
    return WindowMotions.of(both, stamps_ns[::5] * 1e-9, 0.5)


def erring(kind: ErrorKind, T: Array, seconds: Array, size: float) -> Array:
    """A trajectory T (N, 4, 4) that errs in one way."""
    place, twist = T[:, :3, 3], np.zeros((len(T), 6))
    if kind is ErrorKind.BENT:  # its map turns about y as it goes along x
        twist[:, :3] = size * place[:, :1] * T[:, 1, :3]
        return T @ se3.expmap(twist)
    if kind is ErrorKind.STRETCHED:
        twist[:, 3:] = size * (place[:, :1] * place[:, 1:2]) * T[:, 2, :3]
        return T @ se3.expmap(twist)
    steps = se3.logmap(se3.inverse(T[:-1]) @ T[1:])
    if kind is ErrorKind.SCALE:
        steps[len(steps) // 2 :, 3:] *= 1.0 + size
    else:
        steps[:, 1 if kind is ErrorKind.TURNING else 4] += size * np.diff(seconds)
    found = T.copy()
    for k, step in enumerate(se3.expmap(steps)):
        found[k + 1] = found[k] @ step
    return found


@pytest.mark.parametrize("kind", [kind for kind in ErrorKind if kind is not ErrorKind.CLOCK])
def test_effects_are_what_an_error_does_to_the_windows(kind: ErrorKind) -> None:
    """Some combination of the kind's columns is what a small error of that kind changes."""
    driven = drive("3d", 3)
    stamps, T = driven.tracks["rear"]
    seconds = (stamps - stamps[0]) * 1e-9
    windows, erred = windows_of(stamps, T), windows_of(stamps, erring(kind, T, seconds, SMALL))
    change = se3.logmap(se3.inverse(windows.M[1]) @ erred.M[1])
    layout = Layout.of(np.array([False, False]), clocks=False, has_ground=False)
    columns = dict(trajectory_errors._effects(windows, layout, 1))[kind]
    flat = columns.reshape(-1, columns.shape[2])
    left = change.ravel() - flat @ np.linalg.lstsq(flat, change.ravel(), rcond=1e-10)[0]
    assert np.linalg.norm(left) < 0.03 * np.linalg.norm(change)


def test_the_most_probable_sizes_are_those_that_made_the_effects() -> None:
    chance = np.random.default_rng(1)
    root = chance.normal(size=(80, 60))
    G, of = 5.0 * root.T @ root, np.repeat([0, 1, 2], 20)
    tau = np.array([0.5, 0.003, 0.1])
    b = G @ (tau[of] * chance.normal(size=60)) + np.linalg.cholesky(G) @ chance.normal(size=60)
    found = trajectory_errors.most_probable(G, b, of)[[0, 20, 40]]
    np.testing.assert_allclose(found[[0, 2]], tau[[0, 2]], rtol=0.4)
    assert found[1] < 0.02


@pytest.mark.parametrize("kind", [ErrorKind.BENT, ErrorKind.SCALE])
def test_what_is_no_random_walk_is_found_and_taken_off(kind: ErrorKind) -> None:
    driven = drive("3d", 5, seconds=60.0)
    stamps, T = driven.tracks["rear"]
    size = 0.05 if kind is ErrorKind.SCALE else 0.3 / np.ptp(T[:, :3, 3], axis=0).max()
    true = {track.sensor: track for track in tracks(driven)}
    off = odometry.OdometryTrack("rear", stamps, erring(kind, T, (stamps - stamps[0]) * 1e-9, size))
    options = odometry.OdometryOptions(estimate_time_offsets=False)
    found = odometry.calibrate_odometries([true["lidar"], off], reference="lidar", options=options)
    assert any(kind.value in remark for remark in found.remarks), found.remarks
    assert chdtrc(6, squares(found, driven)[0]) > 1e-3
    plain = odometry.calibrate_odometries([true["lidar"], true["rear"]], reference="lidar", options=options)
    assert not any("random walk" in remark for remark in plain.remarks)
    error, exact = (
        np.linalg.norm(se3.logmap(se3.inverse(driven.T("lidar", "rear")[None]) @ one.T_reference_sensor["rear"])[0])
        for one in (found, plain)
    )
    assert error < 5.0 * exact + 0.005


def test_outliers_do_not_look_like_errors_that_last() -> None:
    """Effects on measured motions would be proportional to their noise: a camera was known to 1.6 km."""
    found = odometry.calibrate_odometries(tracks(drive("3d", 21, outliers=0.02)), reference="lidar")
    assert found.judgement.verdict == "use"
    for name in found.order:
        assert np.sqrt(found.covariance_of(name)[3:, 3:].trace()) < 0.08
    assert not any("random walk" in remark for remark in found.remarks)


def test_noise_may_be_stated_of_every_sensor() -> None:
    noise = odometry.OdometryNoise(0.002, 0.02)
    stated = [replace(track, noise=noise) for track in tracks(drive("3d", 2))]
    found = odometry.calibrate_odometries(stated, reference="lidar")
    assert found.noise["rear"] == noise
    assert not found.noise_was_found


def test_tracks_that_repeat_their_pose_while_they_stand_are_no_less_noisy() -> None:
    def standing(track: odometry.OdometryTrack) -> odometry.OdometryTrack:
        T = np.asarray(track.T_start_sensor)
        T = np.concatenate([T[:200], np.repeat(T[200:201], 400, axis=0), T[200:]])
        return replace(track, stamps_ns=np.arange(len(T)) * 10**8, T_start_sensor=T)

    driven = drive("3d", 7)
    found = odometry.calibrate_odometries([standing(track) for track in tracks(driven)[:2]], reference="lidar")
    assert found.judgement.verdict == "use"
    assert chdtrc(6, squares(found, driven)[0]) > 1e-3
