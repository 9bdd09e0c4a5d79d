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
from scipy.spatial.transform import Rotation

import gtsam_rwhec as rw
from gtsam_rwhec.clouds import Cloud, LidarPath, odometry, register_lidars
from gtsam_rwhec.clouds.named_fields import record_of_cloud
from gtsam_rwhec.errors import CloudError, FrameError, LogError
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


def maps_of(world: np.ndarray, poses: np.ndarray, stamps: np.ndarray, seed: int) -> list[Cloud]:
    """What a sensor at T_world_sensor (N, 4, 4) sees of points (n, 3) within 10 m, to 1 cm."""
    rng, clouds = np.random.default_rng(seed), []
    for T, stamp in zip(poses, stamps.tolist(), strict=True):
        near = (world - T[:3, 3]) @ T[:3, :3]
        near = near[(np.linalg.norm(near, axis=1) < 10.0) & (rng.uniform(size=len(near)) < 0.5)]
        seen = near + rng.normal(0.0, 0.01, near.shape)
        clouds.append(Cloud.of(seen, times_s=np.zeros(len(seen)), stamp_ns=stamp))
    return clouds


def test_lidars_of_a_corridor_slide_along_it_and_those_that_saw_other_places_are_said() -> None:
    rng, truth = np.random.default_rng(0), se3.pose(np.eye(3), np.array([-2.0, 0.3, 0.4]))
    x, across, sign = rng.uniform(-12.0, 24.0, 16_000), rng.uniform(-2.0, 2.0, 16_000), rng.choice([-2.0, 2.0], 16_000)
    sides = rng.integers(0, 2, 16_000)[:, None] == 0  # walls, or floor and ceiling
    world = np.where(sides, np.column_stack([x, sign, across]), np.column_stack([x, across, sign]))
    stamps, poses = np.arange(4) * 2 * 10**9, np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = 4.0 * np.arange(4)
    paths = [
        LidarPath(f"lidar {k}", maps_of(world, poses @ T, stamps, k), Trajectory(stamps, poses @ T))
        for k, T in enumerate((np.eye(4), truth))
    ]
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


def test_a_slide_that_turns_and_shifts_has_no_weight_where_places_disagree() -> None:
    # The vehicle turns in the middle of a round tank, so that it slides about the vehicle's own axis.
    rng, truth = np.random.default_rng(0), se3.pose(np.eye(3), np.array([-2.0, 0.3, 0.4]))
    around, up, out = rng.uniform(-np.pi, np.pi, 30_000), rng.uniform(-2.0, 2.0, 30_000), rng.uniform(0.0, 8.0, 30_000)
    is_wall = rng.integers(0, 2, 30_000) == 0
    radius = np.where(is_wall, 8.0, out)
    world = np.column_stack([radius * np.cos(around), radius * np.sin(around), np.where(is_wall, up, -2.0)])
    stamps = np.arange(6) * 2 * 10**9
    poses = se3.expmap(np.outer(0.4 * np.arange(6), np.eye(6)[2]))
    one, other = (maps_of(world, poses @ T, stamps, k) for k, T in enumerate((np.eye(4), truth)))
    for cloud, T in zip(other, se3.expmap(rng.normal(0.0, 3e-3, (6, 6))), strict=True):
        cloud.points[:] = cloud.points @ T[:3, :3].T + T[:3, 3]
    slid = se3.expmap(-0.05 * np.eye(6)[2:3])[0] @ truth
    paths = [LidarPath(f"lidar {k}", each, Trajectory(stamps, poses)) for k, each in enumerate((one, other))]
    found = register_lidars(*paths, slid)
    assert max(found.scatter) > 2.0
    assert "what slides (1 of 6 directions)" in str(found)
    error = se3.logmap((np.linalg.inv(truth) @ found.T_first_second)[None])[0]
    assert np.linalg.norm(error) > 0.03  # as the start had it
    assert error @ found.information @ error < 20.0


def yard_and_way(rng: np.random.Generator, first_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of a ground and of low walls every 7 m, from one on, and poses with stamps of a way through it."""
    ground = rng.uniform(-20.0, 40.0, (40_000, 3)) * (1.0, 1.0, 0.0)
    one = ground[:20_000]
    walls = np.column_stack([np.round(one[:, :1] / 7.0) * 7.0 + first_m, one[:, 1], rng.uniform(0.0, 3.0, len(one))])
    stamps, poses = np.arange(6) * 2 * 10**9, np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, 3] = np.arange(6)[:, None] * (3.0, 1.0, 0.0) + (0.0, 0.0, 1.8)
    return np.concatenate([ground, walls, walls[:, [1, 0, 2]]]), poses, stamps


@pytest.mark.parametrize("raised_deg", [(-0.1, 0.0), (0.1, -0.1), (0.0, -0.3)])
def test_elevations_that_are_off_are_in_the_covariance(raised_deg: tuple[float, float]) -> None:
    # 0.1 degrees are two standard deviations of what is expected; 0.3 are not, and residuals show them.
    truth, paths = lidar_drive.MOUNTS["rear"], []
    world, poses, stamps = yard_and_way(np.random.default_rng(0), 0.0)
    for k, (T, off_deg) in enumerate(zip((np.eye(4), truth), raised_deg, strict=True)):
        maps = maps_of(world, poses @ T, stamps, k)
        for cloud in maps:
            sideways = np.cross(cloud.points, np.eye(3)[2])
            sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
            cloud.points[:] += np.radians(off_deg) * np.cross(sideways, cloud.points)
        paths.append(LidarPath(f"lidar {k}", maps, Trajectory(stamps, poses @ T)))
    found = register_lidars(*paths, truth)
    error = se3.logmap((np.linalg.inv(truth) @ found.T_first_second)[None])[0]
    assert error @ found.information @ error < 12.6  # 95 % of chi2(6)


def test_lidars_in_two_yards_of_one_ground_are_not_registered() -> None:
    truth, paths = lidar_drive.MOUNTS["rear"], []
    for k, T in enumerate((np.eye(4), truth)):
        world, poses, stamps = yard_and_way(np.random.default_rng(k), 3.5 * k)
        paths.append(LidarPath(f"lidar {k}", maps_of(world, poses @ T, stamps, k), Trajectory(stamps, poses @ T)))
    assert "they overlap by " in register_lidars(*paths, truth).why_not


def driven_with_maps(mounts: dict[str, np.ndarray]) -> tuple[Drive, dict[str, list[Cloud]]]:
    """A drive on a plane with sensors there, and what they see of a ground and walls."""
    driven = rw.simulate.drive(
        {name: rw.simulate.SimulatedOdometry(T) for name, T in mounts.items()}, "planar", seconds=20.0, seed=2
    )
    rng, way = np.random.default_rng(0), driven.T_world_vehicle[:, :3, 3]
    ground = rng.uniform(way.min(axis=0) - 12.0, way.max(axis=0) + 12.0, (15_000, 3)) * (1.0, 1.0, 0.0)
    walls = np.column_stack([np.round(ground[:, :1] / 7.0) * 7.0, ground[:, 1:2], rng.uniform(0.0, 3.0, 15_000)])
    world = np.concatenate([ground, walls, walls[:, [1, 0, 2]]])
    at = np.arange(10, 200, 40)
    maps = {
        name: maps_of(world, driven.T_world_vehicle[at] @ T, driven.stamps_ns[at], k)
        for k, (name, T) in enumerate(mounts.items())
    }
    return driven, maps


def test_three_lidars_agree_by_their_clouds() -> None:
    aside = Rotation.from_euler("zyx", [95, -6, 10], degrees=True).as_matrix()
    mounts = {**lidar_drive.MOUNTS, "left": se3.pose(aside, np.array([0.2, 0.9, 1.6]))}
    driven, maps = driven_with_maps(mounts)
    tracks = [rw.odometry.OdometryTrack(name, *each) for name, each in driven.tracks.items()]
    options = rw.odometry.OdometryOptions(estimate_time_offsets=False, window_s=0.5)
    found = rw.odometry.calibrate_odometries(tracks, reference="front", options=options, maps=maps)
    assert [each.why_not for each in found.together] == ["", "", ""]
    assert found.judgement.verdict == "use", found.judgement
    for name in ("rear", "left"):
        T = np.linalg.inv(driven.T("front", name)) @ found.T_reference_sensor[name]
        error = se3.logmap(T[None])[0]
        assert error @ np.linalg.solve(found.covariance_of(name), error) < 16.8  # 99 % of chi2(6)


def test_clouds_that_the_motions_contradict_are_left_out() -> None:
    driven, maps = driven_with_maps(lidar_drive.MOUNTS)
    tracks = [rw.odometry.OdometryTrack(name, *each) for name, each in driven.tracks.items()]
    options = rw.odometry.OdometryOptions(estimate_time_offsets=False, window_s=0.5)
    shifted = {**maps, "rear": [replace(each, points=each.points + np.eye(3)[0]) for each in maps["rear"]]}
    for given, verdict in ((maps, "use"), (shifted, "do_not_use")):
        found = rw.odometry.calibrate_odometries(tracks, reference="front", options=options, maps=given)
        (record,) = rw.odometry.result_of(found).together
        assert record.used == (found.judgement.verdict == "use") == (verdict == "use"), found.judgement
    assert "by their clouds, the pose of rear in front contradicts the motions" in found.judgement.reason
    with pytest.raises(FrameError, match="maps are of 'roof'"):
        rw.odometry.calibrate_odometries(tracks, reference="front", maps={"roof": maps["rear"]})


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
    with warnings.catch_warnings(record=True, action="always") as said:
        rig = parse_rig(RIG, "rig.yaml")
        detect_log(log, rig, tmp_path / "detected.mcap")
    assert any("points have no times. So" in str(each.message) for each in said)
    with LogWriter(tmp_path / "poses.mcap") as out:
        out.pose("/front/points", 1, "map", np.eye(4))
        out.pose("/rear/points", 1, "map", np.eye(4))
    with pytest.raises(LogError, match=r"rig\.yaml, line 4: .* has foxglove.PoseInFrame; give one of PointCloud2"):
        detect_log(tmp_path / "poses.mcap", rig, tmp_path / "detected.mcap")
