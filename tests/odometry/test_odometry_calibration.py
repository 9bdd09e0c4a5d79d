"""All sensors of a drive at once: poses within their covariances, what is free is named, and bad input in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drives_with_sensors import drive, squares, tracks
from rwhec_factors import se3
from scipy.stats import chi2

from gtsam_rwhec import odometry
from gtsam_rwhec.calibration.verdict import Ground, Verdict
from gtsam_rwhec.errors import (
    CountError,
    FrameError,
    OptionError,
    OutlierError,
    ScaleError,
    StampError,
    UnderdeterminedError,
)
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate.drives import Drive, SimulatedOdometry
from gtsam_rwhec.simulate.drives import drive as simulated_drive

ONE_CLOCK = odometry.OdometryOptions(estimate_time_offsets=False, window_s=0.5)


@pytest.fixture(scope="module")
def hilly() -> Drive:
    return drive("3d", 1)


@pytest.fixture(scope="module")
def planar() -> Drive:
    return drive("planar", 2)


@pytest.fixture(scope="module")
def found(hilly: Drive) -> odometry.OdometryCalibration:
    return odometry.calibrate_odometries(tracks(hilly), reference="lidar", options=ONE_CLOCK)


def test_poses_scale_and_noise_of_a_drive_with_hills(hilly: Drive, found: odometry.OdometryCalibration) -> None:
    assert found.certificate.is_optimal
    assert found.is_unique
    square, degrees = squares(found, hilly)
    assert degrees == 18
    assert square < chi2.ppf(1.0 - 1e-4, degrees)
    assert found.scales["camera"] == pytest.approx(0.4, abs=5.0 * 0.4 * np.sqrt(found.covariance[-1, -1]))
    for name, sensor in hilly.sensors.items():
        assert found.noise[name].rotation_rad_per_sqrt_s == pytest.approx(sensor.rotation_rad_per_sqrt_s, rel=0.3)
    assert found.judgement.verdict is Verdict.USE


def test_a_reference_of_unknown_scale_gives_the_same_poses(hilly: Drive, found: odometry.OdometryCalibration) -> None:
    seen_from_camera = odometry.calibrate_odometries(tracks(hilly), reference="camera", options=ONE_CLOCK)
    np.testing.assert_allclose(seen_from_camera.T("lidar", "rear"), found.T_reference_sensor["rear"], atol=1e-6)
    square, degrees = squares(seen_from_camera, hilly)
    assert square < chi2.ppf(1.0 - 1e-4, degrees)


def test_a_drive_on_a_plane_leaves_every_height_free_and_says_so(planar: Drive) -> None:
    found = odometry.calibrate_odometries(tracks(planar), reference="lidar", options=ONE_CLOCK)
    assert len(found.free_directions) == 3
    assert {name for free in found.free_directions for name in free.frames} == {"rear", "stereo", "camera"}
    for free in found.free_directions:
        (name,) = free.frames
        shift = np.array(free.frames[name][3:])
        up = found.T_reference_sensor[name][:3, :3] @ shift / np.linalg.norm(shift)
        assert abs(up[2]) > 0.99
        assert "turned about one axis only" in str(free)
    assert found.status == "certified_not_unique"
    assert found.judgement.grounds == (Ground.NOT_UNIQUE,)


def test_heights_hold_it_and_the_answer_says_how_it_depends_on_them(planar: Drive) -> None:
    heights = {name: (2.0 + float(sensor.T_vehicle_sensor[2, 3]), 0.01) for name, sensor in planar.sensors.items()}
    given = odometry.Given(heights_m=heights)
    found = odometry.calibrate_odometries(tracks(planar), reference="lidar", given=given, options=ONE_CLOCK)
    assert found.is_unique
    assert found.certificate.is_optimal
    square, degrees = squares(found, planar)
    assert degrees == 18
    assert square < chi2.ppf(1.0 - 1e-4, degrees)
    (of_rear,) = [number for number in found.influences if number.what == "height of rear"]
    up = found.T_reference_sensor["rear"][:3, :3] @ np.array(of_rear.per_unit["rear"][3:])
    np.testing.assert_allclose(up, [0.0, 0.0, 1.0], atol=0.02)  # a metre up moves it a metre up
    assert np.linalg.norm(of_rear.per_sigma["stereo"]) < 1e-3


def test_a_pose_that_another_measurement_has_holds_it_and_must_agree() -> None:
    driven = drive("planar", 2, seconds=20.0)
    truth, sigma = driven.T("lidar", "rear"), np.r_[np.full(3, 0.002), np.full(3, 0.01)]
    off = 0.5 * sigma * (1.0, -1.0, 1.0, 1.0, -1.0, 1.0)
    along = np.linalg.inv(truth)[:3, :3] @ (0.0, 0.0, 1.0)
    beside = np.linalg.inv(truth)[:3, :3] @ (1.0, 0.0, 0.0)
    for shift, verdict in ((2.0 * along, Verdict.USE), (2.0 * beside, Verdict.DO_NOT_USE)):
        T = truth @ se3.expmap((off + np.r_[np.zeros(3), shift])[None])[0]
        known = odometry.KnownPose("lidar", "rear", T, np.diag(sigma**-2))
        given = odometry.Given(poses=(known,))
        found = odometry.calibrate_odometries(tracks(driven)[:2], reference="lidar", given=given, options=ONE_CLOCK)
        assert found.judgement.verdict is verdict, found
        assert found.is_unique
        if verdict is Verdict.USE:  # no motion on a plane tells a height
            error = se3.logmap((np.linalg.inv(T) @ found.T("lidar", "rear"))[None])[0]
            assert error @ np.linalg.solve(found.covariance_of("rear"), error) < 30.0
    assert "the pose of rear in lidar" in found.judgement.reason


def test_a_distance_has_two_signs_and_both_are_said(planar: Drive) -> None:
    pair = [track for track in tracks(planar) if track.sensor in ("lidar", "rear")]
    true = planar.T("lidar", "rear")
    given = odometry.Given(distances_m={("lidar", "rear"): (float(np.linalg.norm(true[:3, 3])), 0.002)})
    found = odometry.calibrate_odometries(pair, reference="lidar", given=given, options=ONE_CLOCK)
    assert not found.free_directions
    (other,) = found.others
    heights = sorted([found.T_reference_sensor["rear"][2, 3], other.T_reference_sensor["rear"][2, 3]])
    assert heights[0] == pytest.approx(-heights[1], abs=0.02)
    assert any(height == pytest.approx(true[2, 3], abs=0.05) for height in heights)
    assert "two signs" in str(found)


@pytest.mark.slow
def test_clocks_and_outliers() -> None:
    driven = drive("3d", 3, seconds=80.0, outliers=0.01, clocks=True)
    found = odometry.calibrate_odometries(tracks(driven), reference="lidar")
    for name, sensor in driven.sensors.items():
        if name != "lidar":
            sigma = found.time_offset_sigmas_s[name]
            assert found.time_offsets_s[name] == pytest.approx(sensor.clock_offset_s, abs=5.0 * sigma)
            assert sigma < 0.005
    square, degrees = squares(found, driven)
    assert square < chi2.ppf(1.0 - 1e-4, degrees)
    assert all(found.removed.values())


def test_bad_input_is_refused_in_words(hilly: Drive) -> None:
    known = tracks(hilly)

    def refused(error: type[Exception], words: str, of: list[odometry.OdometryTrack], **more: object) -> None:
        with pytest.raises(error, match=words):
            odometry.calibrate_odometries(of, **{"reference": "lidar", "options": ONE_CLOCK} | more)  # type: ignore[arg-type]

    refused(CountError, "two tracks or more", known[:1])
    refused(FrameError, "two tracks are of 'lidar'", [known[0], known[0]])
    refused(FrameError, "no track is of it", known, reference="radar")
    refused(FrameError, "no track is of that sensor", known, given=odometry.Given(heights_m={"radar": (1.0, 0.1)}))
    refused(ScaleError, "how long a metre is", [replace(track, has_unknown_scale=True) for track in known])
    later = replace(known[1], stamps_ns=known[1].stamps_ns + 10**12)
    refused(StampError, "no common time", [known[0], later])
    ground = odometry.Ground((0.0, 0.0, 1.0), 1.0, 0.01, 0.01)
    refused(OptionError, "reference of known scale", known, reference="camera", given=odometry.Given(ground=ground))
    straight = drive("straight", 4)
    refused(UnderdeterminedError, "did not turn", tracks(straight))


def test_a_track_of_another_drive_is_refused(hilly: Drive) -> None:
    other = tracks(drive("3d", 5))
    mixed = [*tracks(hilly)[:3], replace(other[1], sensor="alien")]
    with pytest.raises(OutlierError, match="alien"):
        odometry.calibrate_odometries(mixed, reference="lidar", options=ONE_CLOCK)


def test_tracks_that_are_read_in_a_wrong_way_do_not_say_use(hilly: Drive) -> None:
    good = tracks(hilly)
    inverted = [replace(track, T_start_sensor=se3.inverse(track.T_start_sensor)) for track in good]
    found = odometry.calibrate_odometries(inverted, reference="lidar", options=ONE_CLOCK)
    judgement = found.judgement
    assert judgement.verdict == "do_not_use"
    assert "the poses of rear look inverted" in judgement.reason
    resting = replace(good[1], T_start_sensor=np.tile(np.eye(4), (len(good[1].stamps_ns), 1, 1)))
    with pytest.raises(OutlierError, match="rear turns by 0 degrees a second"):
        odometry.calibrate_odometries([good[0], resting, *good[2:]], reference="lidar", options=ONE_CLOCK)
    with pytest.raises(OutlierError, match="lidar and rear are the same"):
        odometry.calibrate_odometries([good[0], replace(good[0], sensor="rear")], reference="lidar")
    short = replace(good[1], stamps_ns=good[1].stamps_ns[:3], T_start_sensor=good[1].T_start_sensor[:3])
    with pytest.raises(UnderdeterminedError, match="windows with another sensor"):
        odometry.calibrate_odometries([good[0], short, *good[2:]], reference="lidar")
    for stamps in (good[1].stamps_ns * 1000, good[1].stamps_ns + 30_000_000_000_000_000):
        with pytest.raises(StampError, match="no common time"):
            odometry.calibrate_odometries([good[0], replace(good[1], stamps_ns=stamps)], reference="lidar")


def test_a_wrong_distance_and_an_unchecked_height_do_not_say_use(planar: Drive) -> None:
    pair = [track for track in tracks(planar) if track.sensor in ("lidar", "rear")]
    far = odometry.Given(distances_m={("lidar", "rear"): (40.0, 0.002)})
    found = odometry.calibrate_odometries(pair, reference="lidar", given=far, options=ONE_CLOCK)
    judgement = found.judgement
    assert judgement.verdict == "do_not_use"
    assert str(found).startswith("Do not use these poses")
    high = odometry.Given(heights_m={"lidar": (2.0, 0.01), "rear": (9.0, 0.01)})
    found = odometry.calibrate_odometries(pair, reference="lidar", given=high, options=ONE_CLOCK)
    assert "The motions do not check all that was given" in found.judgement.reason
    below = odometry.Ground((0.0, 0.0, -1.0), 2.0, 0.01, 0.01)
    turned = odometry.Given(heights_m={"rear": (2.0, 0.01)}, ground=below)
    found = odometry.calibrate_odometries(pair, reference="lidar", given=turned, options=ONE_CLOCK)
    assert "hangs upside down" in str(found)


def test_heights_are_asked_for_the_ground_where_the_reference_may_hang_upside_down() -> None:
    made = {name: SimulatedOdometry(np.eye(4), 0.001, 0.01) for name in ("lidar", "rear", "wheels")}
    hanging = np.diag([1.0, -1.0, -1.0, 1.0])
    made["lidar"] = replace(made["lidar"], T_vehicle_sensor=hanging)
    driven = simulated_drive(made, "planar", seconds=30.0, seed=2)
    heights = dict.fromkeys(made, (1.0, 0.01))
    found = odometry.calibrate_odometries(
        tracks(driven), reference="lidar", given=odometry.Given(heights_m=heights), options=ONE_CLOCK
    )
    judgement = found.judgement
    assert judgement.verdict == "do_not_use"
    assert "beside it rear, wheels would hang upside down" in judgement.reason
    ground = odometry.Ground((0.0, 0.0, -1.0), 1.0, 0.01, 0.01)
    given = odometry.Given(heights_m={"rear": (1.0, 0.01), "wheels": (1.0, 0.01)}, ground=ground)
    found = odometry.calibrate_odometries(tracks(driven), reference="lidar", given=given, options=ONE_CLOCK)
    assert found.judgement.verdict == "use"


def test_answers_from_short_and_long_windows_must_agree() -> None:
    """A map that bends: short and long windows, or blocks of them, say more different things than they claim."""
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 60.0, 0.05)
    frequency, phase = rng.uniform(0.05, 0.5, (6, 6)), rng.uniform(0.0, 6.28, (6, 6))
    twist = np.sin(2.0 * np.pi * frequency * t[:, None, None] + phase).sum(axis=1) * [0.2, 0.2, 0.4, 0.5, 0.5, 0.2]
    body = se3.expmap(twist * [1, 1, 1, 0, 0, 0])
    body[:, :3, 3] = twist[:, 3:]
    T_body_camera = se3.expmap(np.array([[0.3, -0.2, 0.1, 0.1, 0.05, -0.08]]))[0]
    camera = np.linalg.inv(body[0] @ T_body_camera) @ body @ T_body_camera
    about = camera[:, :3, 3] @ rng.normal(0.0, 0.02, (3, 3))
    bent = camera.copy()
    bent[:, :3, :3] = se3.expmap(np.c_[about, 0.0 * about])[:, :3, :3] @ camera[:, :3, :3]
    noise = rng.normal(size=(2, len(t), 6)) * np.repeat([3e-4, 5e-4], 3)
    stamps = np.round(1e9 * t).astype(np.int64)

    def calibrated(of_camera: Array) -> odometry.OdometryCalibration:
        tracks = [
            odometry.OdometryTrack("body", stamps, np.linalg.inv(body[0]) @ body @ se3.expmap(noise[0])),
            odometry.OdometryTrack("camera", stamps, of_camera @ se3.expmap(noise[1])),
        ]
        return odometry.calibrate_odometries(tracks, reference="body")

    assert calibrated(camera).judgement.verdict is Verdict.USE
    found = calibrated(bent)
    assert found.judgement.verdict is Verdict.CARE
    assert {Ground.COVARIANCE_DOUBTED, Ground.CORRELATED}.intersection(found.judgement.grounds)
