"""The motion of LiDARs by their own sweeps, and what it tells of where they are on a vehicle."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import lidar_drive
import numpy as np
import pytest
from given_commands import command
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.clouds import Cloud, LidarPath, odometry, register_lidars
from gtsam_rwhec.clouds.named_fields import record_of_cloud
from gtsam_rwhec.errors import CloudError, LogError
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.logs import LogWriter, open_log
from gtsam_rwhec.rig.rig_file import parse_rig
from gtsam_rwhec.runs.detection_stage import detect_log
from gtsam_rwhec.simulate import Drive, frame_distance

RIG = """
reference: front
sensors:
  front: {odometry: {clouds: /front/points}}
  rear: {odometry: {clouds: /rear/points}}
"""
#: What a drive on a plane needs where the clouds are not registered with each other.
APART = (
    RIG.replace("points}", "points, together: false}")
    + "given: {heights_m: {front: 1.8, rear: 2.0}, height_sigma_mm: 5}\n"
)


@pytest.fixture(scope="module")
def drive() -> Drive:
    return lidar_drive.driven(6.0, seed=1)


@pytest.fixture(scope="module")
def recorded(drive: Drive) -> dict[str, list[Cloud]]:
    boxes = lidar_drive.yard(drive, 1)
    return {name: list(lidar_drive.sweeps(drive, boxes, name, k)) for k, name in enumerate(lidar_drive.MOUNTS)}


def test_the_motion_is_that_between_the_middles_of_the_sweeps(drive: Drive, recorded: dict[str, list[Cloud]]) -> None:
    track = odometry(recorded["front"])
    assert not track.why_no_times
    assert track.left_out == ()
    assert track.stamps_ns == pytest.approx(drive.stamps_ns[:-1] + 5e7, abs=1e6)
    poses = drive.T_world_vehicle @ lidar_drive.MOUNTS["front"]
    half = se3.expmap(0.5 * se3.logmap(se3.inverse(poses[:-1]) @ poses[1:]))
    true, found = poses[:-1] @ half, track.T_start_sensor
    off = se3.logmap(se3.inverse(se3.inverse(true[:-10]) @ true[10:]) @ se3.inverse(found[:-10]) @ found[10:])
    assert np.degrees(np.sqrt((off[:, :3] ** 2).mean(axis=0))).max() < 0.08  # over 1 s, of 23 degrees
    assert np.sqrt((off[:, 3:] ** 2).mean(axis=0)).max() < 0.02  # of 4 m


def test_two_lidars_of_a_vehicle_are_calibrated_by_their_sweeps(
    drive: Drive, recorded: dict[str, list[Cloud]], tmp_path: Path
) -> None:
    log, rig = tmp_path / "drive.mcap", tmp_path / "rig.yaml"
    rig.write_text(RIG)
    with LogWriter(log) as out:
        for name, clouds in recorded.items():
            for cloud in clouds:
                assert cloud.stamp_ns is not None
                out.point_cloud(record_of_cloud(cloud, f"/{name}/points", cloud.stamp_ns, name))
    status, printed = command("init", log, "-o", tmp_path / "first.yaml")
    assert status == 0, printed
    first = (tmp_path / "first.yaml").read_text()
    assert "front: {odometry: {clouds: /front/points}" in first or "clouds: /front/points" in first
    assert "reference:" in first
    status, printed = command("calibrate", log, "--rig", rig, "-o", tmp_path / "out")
    assert status == 0, printed
    together = rw.odometry.read_odometry_result(tmp_path / "out" / "result.json")
    rig.write_text(APART)
    status, printed = command("solve", tmp_path / "out" / "calibration.mcap", "--rig", rig, "-o", tmp_path / "apart")
    assert status == 0, printed
    apart = rw.odometry.read_odometry_result(tmp_path / "apart" / "result.json")
    for result, most_deg, most_mm in ((together, 0.05, 20.0), (apart, 0.3, 50.0)):
        off = frame_distance(result.pose("rear"), drive.T("front", "rear"))
        assert off.rotation_deg < most_deg
        assert off.translation_mm < most_mm
    assert "the clouds of front and rear are registered with each other at 3 places" in together.remarks[-1]
    assert not any("registered" in words for words in apart.remarks)
    with open_log(tmp_path / "out" / "calibration.mcap") as kept:
        assert len(kept.poses("/calibration/rear/odometry").stamps_ns) == len(recorded["rear"])


def test_what_the_surroundings_do_not_tell_is_left_out() -> None:
    walls = lidar_drive.Boxes(np.array([[0.0, 3.0], [0.0, -3.0]]), np.tile([300.0, 0.2, 5.0], (2, 1)), np.zeros(2))
    rng = np.random.default_rng(0)
    clouds = []
    for k in range(6):
        T, twist = se3.pose(np.eye(3), np.array([0.4 * k, 0.0, 1.8])), np.r_[0.0, 0.0, 0.0, 4.0, 0.0, 0.0]
        points, times = lidar_drive.sweep(walls, T, twist, rng)
        clouds.append(Cloud.of(points, times_s=times, stamp_ns=k * 10**8, source=f"sweep {k}"))
    with pytest.raises(CloudError, match=r"of 6 sweeps 1 can be .*sweep 1: .* do not tell its motion along x"):
        odometry(clouds)


def test_lidars_of_a_corridor_slide_along_it_and_those_that_saw_other_places_are_said() -> None:
    rng, truth = np.random.default_rng(0), se3.pose(np.eye(3), np.array([-2.0, 0.3, 0.4]))
    stamps, paths = np.arange(4) * 2 * 10**9, []
    for T in (np.eye(4), truth):
        poses = se3.pose(np.tile(np.eye(3), (4, 1, 1)), np.outer(np.arange(4), [4.0, 0.0, 0.0])) @ T
        clouds = []
        for stamp, pose in zip(stamps.tolist(), poses, strict=True):
            sides = rng.integers(0, 4, 2000)  # floor, ceiling, walls
            points = np.column_stack([rng.uniform(-8, 8, 2000), rng.uniform(-2, 2, 2000), rng.uniform(-1.5, 1.5, 2000)])
            for axis, half in ((1, 2.0), (2, 1.5)):
                for k, sign in enumerate((-1.0, 1.0)):
                    on = sides == 2 * axis - 2 + k
                    points[on, axis] = sign * half + rng.normal(0.0, 0.01, int(on.sum()))
            points[:, 0] += pose[0, 3]
            seen = (points - pose[:3, 3]) @ pose[:3, :3]
            clouds.append(Cloud.of(seen, times_s=np.zeros(2000), stamp_ns=stamp))
        paths.append(LidarPath(f"lidar {len(paths)}", clouds, Trajectory(stamps, poses)))
    off = se3.expmap(np.array([[0.02, -0.02, 0.03, 0.3, 0.2, -0.3]]))[0]
    found = register_lidars(paths[0], paths[1], truth @ off)
    assert not found.why_not
    assert found.places == 4
    assert "what slides (1 of 6 directions)" in str(found)
    assert abs(np.linalg.eigh(found.information)[1][3, 0]) == pytest.approx(1.0, abs=1e-3)
    error = se3.logmap((np.linalg.inv(truth) @ found.T_first_second)[None])[0]
    assert abs(error[3]) > 0.2  # as the start had it
    assert error @ found.information @ error < 20.0
    elsewhere = replace(paths[1], maps=[replace(each, points=each.points + 40.0) for each in paths[1].maps])
    said = str(register_lidars(paths[0], elsewhere, truth))
    assert said.startswith("the clouds of lidar 0 and lidar 1 do not tell their pose: they overlap ")
    assert "0 places have maps of both" in str(register_lidars(paths[0], replace(paths[1], maps=()), truth))


def test_a_sweep_of_elsewhere_costs_itself_alone(recorded: dict[str, list[Cloud]]) -> None:
    clouds = list(recorded["front"][:20])
    clouds[9] = Cloud.of(np.random.default_rng(0).uniform(-20.0, 20.0, (4000, 3)), times_s=np.linspace(0.0, 0.1, 4000))
    clouds[9] = replace(clouds[9], stamp_ns=recorded["front"][9].stamp_ns, source="wrong")
    track = odometry(clouds)
    assert len(track.stamps_ns) == 19
    assert [words.split(":")[0] for words in track.left_out] == ["wrong"]


def test_sweeps_without_times_or_out_of_order_are_said(recorded: dict[str, list[Cloud]], tmp_path: Path) -> None:
    few = recorded["front"][:12]
    assert odometry([replace(each, times_s=None) for each in few]).why_no_times == "points have no times"
    for factor in (0.0, 1e-3, 1e3):  # not filled in, microseconds taken for nanoseconds, milliseconds for seconds
        track = odometry([replace(each, times_s=factor * each.times_s) for each in few])  # type: ignore[operator]
        assert "where sweeps are 0.1 s apart" in track.why_no_times
        assert len(track.stamps_ns) == 12
    holed = np.where(np.arange(len(few[3])) % 7, few[3].times_s, np.nan)
    far = np.where(np.arange(len(few[4]))[:, None] == 5, 1e30, few[4].points)
    spoiled = [
        *few[:3],
        replace(few[3], times_s=holed),
        replace(few[4], points=far),
        few[4],
        few[5].selected(np.arange(3)),
        *few[6:],
    ]
    track = odometry(spoiled)
    assert len(track.stamps_ns) == 11
    assert "no later than that of the sweep before" in track.left_out[0]
    assert "points are left after thinning" in track.left_out[1]
    with pytest.raises(CloudError, match="of 2 sweeps 1 can be registered, and motions need 3; the first: sweep 1"):
        odometry([few[1], few[0]])
    with pytest.raises(CloudError, match=r"of 0 sweeps 0 can be registered, and motions need 3$"):
        odometry([])
    with pytest.raises(CloudError, match="sweep 0 has no stamp"):
        odometry([replace(few[0], stamp_ns=None)])
    log = tmp_path / "drive.mcap"
    with LogWriter(log) as out:
        for name in ("front", "rear"):
            for cloud in few:
                assert cloud.stamp_ns is not None
                plain = replace(cloud, times_s=None)
                out.point_cloud(record_of_cloud(plain, f"/{name}/points", cloud.stamp_ns, name))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        rig = parse_rig(RIG, "rig.yaml")
        detect_log(log, rig, tmp_path / "detected.mcap")
    assert any("points have no times. So" in str(each.message) for each in said)
    with LogWriter(tmp_path / "poses.mcap") as out:
        out.pose("/front/points", 1, "map", np.eye(4))
        out.pose("/rear/points", 1, "map", np.eye(4))
    with pytest.raises(LogError, match=r"rig\.yaml, line 4: .* has foxglove.PoseInFrame; give one of PointCloud2"):
        detect_log(tmp_path / "poses.mcap", rig, tmp_path / "detected.mcap")
