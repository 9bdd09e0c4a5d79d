"""Vehicles whose sensors each know only their own motion, the whole road: from a log or TUM files to the files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_logs as made
from given_commands import given
from rwhec_factors import se3
from scipy.spatial.transform import Rotation

import gtsam_rwhec as rw
from gtsam_rwhec.cli.failures import ExitStatus, exit_status
from gtsam_rwhec.errors import FileFormatError, LogError
from gtsam_rwhec.logs.records import Topic
from gtsam_rwhec.odometry.odometry_report import odometry_page, pose_table
from gtsam_rwhec.odometry.odometry_result import read_odometry_result, result_json
from gtsam_rwhec.report.report_blocks import Number, Table, every
from gtsam_rwhec.rig.log_contents import PoseTopic
from gtsam_rwhec.rig.log_proposal import propose_odometries
from gtsam_rwhec.simulate import Drive, SimulatedOdometry, drive, frame_distance

#: Of each sensor: about x, y, z in degrees, and where it is on the vehicle in metres.
MOUNTS = {
    "lidar_front": ((0, 0, 0), (1.8, 0.0, 0.6)),
    "lidar_rear": ((3, -2, 178), (-1.5, 0.1, 0.9)),
    "lidar_roof": ((1, 2, 30), (0.2, -0.1, 1.9)),
    "camera_left": ((-90, 0, 0), (0.9, 0.7, 1.4)),
    "camera_right": ((-90, 5, 180), (0.9, -0.7, 1.3)),
    "wheels": ((0, 0, 0), (0.0, 0.0, 0.3)),
}
SCALE = 0.3
RIG = "reference: lidar_front\nsensors:\n" + "".join(
    f"  {name}: {{odometry: {{topic: /{name}/odom{', scale: estimate' if name == 'camera_left' else ''}}}}}\n"
    for name in MOUNTS
)
FREE = (
    "the heights of lidar_rear and lidar_roof over lidar_front (along the z axis of lidar_front) are not determined: "
    "the vehicle moved in a plane"
)


def sensors(*names: str) -> dict[str, SimulatedOdometry]:
    return {
        name: SimulatedOdometry(
            made.pose(*MOUNTS[name]),
            rotation_rad_per_sqrt_s=0.001,
            translation_m_per_sqrt_s=0.01,
            scale=SCALE if name == "camera_left" else 1.0,
        )
        for name in names
    }


def write_log(path: Path, driven: Drive) -> Path:
    messages = [
        made.pose_in_frame(made.BEGIN_NS + int(stamp), f"{name}_start", T, f"/{name}/odom")
        for name, (stamps, poses) in driven.tracks.items()
        for stamp, T in zip(stamps, poses, strict=True)
    ]
    return made.write(path, sorted(messages, key=lambda message: message.logged_ns))


def write_tum(folder: Path, driven: Drive) -> None:
    for name, (stamps, poses) in driven.tracks.items():
        quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        rows = np.c_[1.7e9 + stamps * 1e-9, poses[:, :3, 3], quaternions]
        np.savetxt(folder / f"{name}.tum", rows, fmt="%.9f", header="t x y z qx qy qz qw")


def at(tree: Any, pointer: str) -> Any:
    for key in pointer.partition("#/")[2].split("/"):
        tree = tree[int(key)] if isinstance(tree, list) else tree[key]
    return tree


@pytest.fixture(scope="module")
def six(tmp_path_factory: pytest.TempPathFactory) -> tuple[Drive, Path, Any]:
    """A drive with six sensors in three dimensions, calibrated by the command."""
    folder = tmp_path_factory.mktemp("six")
    driven = drive(sensors(*MOUNTS), "3d", seconds=12.0, rate_hz=5.0, seed=5)
    log = write_log(folder / "raw.mcap", driven)
    (folder / "rig.yaml").write_text(RIG, encoding="utf-8")
    return driven, folder, given("calibrate", log, "--rig", folder / "rig.yaml", "-o", folder / "out")


def test_six_odometries_through_the_command(six: tuple[Drive, Path, Any]) -> None:
    driven, folder, done = six
    assert done.exit_code == ExitStatus.CERTIFIED, done.stdout + done.stderr
    assert done.stdout.startswith("Use these poses")
    assert done.stdout.count("\n") <= 24  # a screen, as of cameras
    result = read_odometry_result(folder / "out" / "result.json")
    assert result.certificate.status == "certified"
    assert result.not_determined == ()
    assert {(one.parent, one.child) for one in result.sensors} == {("lidar_front", name) for name in list(MOUNTS)[1:]}
    for one in result.sensors:
        truth = driven.T("lidar_front", one.sensor)
        off = se3.logmap(se3.inverse(result.pose(one.sensor)[None]) @ truth[None])[0]
        w, *xyz = one.quaternion_wxyz
        assert np.allclose(Rotation.from_quat([*xyz, w]).as_matrix(), result.pose(one.sensor)[:3, :3])
        covariance = np.array(one.covariance, dtype=float)
        assert off @ np.linalg.solve(covariance, off) < 35.0, one.sensor
        assert frame_distance(result.pose(one.sensor), truth).translation_mm < 200.0, one.sensor
        if one.sensor == "camera_left":
            assert one.scale == pytest.approx(SCALE, rel=0.02)
    urdf = (folder / "out" / "rig.urdf.xacro").read_text(encoding="utf-8")
    assert all(f'<link name="{name}"/>' in urdf for name in MOUNTS if name != "lidar_front")
    assert "Sensors in the frame of lidar_front" in (folder / "out" / "report.html").read_text(encoding="utf-8")


def test_what_a_stage_writes_the_next_reads(six: tuple[Drive, Path, Any], tmp_path: Path) -> None:
    _, folder, _ = six
    first = read_odometry_result(folder / "out" / "result.json")
    solved = rw.odometry.solve_odometries_into(folder / "out" / "calibration.mcap", None, tmp_path)
    assert solved.result == first
    of_folder = given("export", folder / "out", "-o", tmp_path / "exported")  # as that of cameras is exported
    assert of_folder.exit_code == ExitStatus.DONE, of_folder.stdout + of_folder.stderr
    assert (tmp_path / "exported" / "tf.yaml").read_bytes() == (folder / "out" / "tf.yaml").read_bytes()
    assert rw.odometry.read_odometries(tmp_path / "calibration.mcap").result == first
    assert {path.name for path in rw.odometry.export_odometries(tmp_path / "calibration.mcap", tmp_path)} >= {"tf.yaml"}
    with rw.logs.open_log(tmp_path / "calibration.mcap") as log:
        pairs = rw.runs.read_pairs(log, solved.rig)
    assert {pair.sensor for pair in pairs} == set(MOUNTS)
    assert all(one.used.sum() > 50 for one in pairs.values())
    tree = json.loads(result_json(first))
    del tree["reference"]
    (tmp_path / "result.json").write_text(json.dumps(tree))
    with pytest.raises(FileFormatError, match=r"is no result of a calibration of odometries: \$.reference"):
        read_odometry_result(tmp_path / "result.json")


def test_a_plane_leaves_heights_free_until_they_are_given(tmp_path: Path) -> None:
    names = ("lidar_front", "lidar_rear", "lidar_roof")
    driven = drive(sensors(*names), "planar", seconds=20.0, rate_hz=5.0, seed=2)
    write_tum(tmp_path, driven)
    text = "reference: lidar_front\nsensors:\n" + "".join(
        f"  {name}: {{odometry: {{file: {name}.tum}}}}\n" for name in names
    )
    rig = rw.rig.parse_rig(text, "rig.yaml")
    free = rw.odometry.calibrate_odometry_log(tmp_path, rig, tmp_path / "free")
    assert free.judgement.verdict is rw.Verdict.DO_NOT_USE
    assert exit_status(free.judgement, of_rig=True) is ExitStatus.NOT_UNIQUE
    assert free.result.not_determined == (FREE,)
    assert f"{FREE}. What to do: state the missing heights in the rig file" in str(free.judgement)
    assert not (tmp_path / "free" / "tf.yaml").exists()
    for _, *cells in pose_table(free.result).rows:  # no number in the place of a height that is not known
        assert [cell == "free" for cell in cells[:6]] == [False, False, True, False, False, False]
    assert {path.name for path in (tmp_path / "free").iterdir()} >= {"result.json", "report.html", "calibration.mcap"}
    given = "given: {heights_m: {lidar_front: 0.6, lidar_rear: 0.9, lidar_roof: 1.9}}\n"
    known = rw.odometry.calibrate_odometry_log(tmp_path, rw.rig.parse_rig(text + given, "rig.yaml"), tmp_path / "known")
    assert known.result.not_determined == ()
    assert known.judgement.verdict is not rw.Verdict.DO_NOT_USE, str(known.judgement)
    assert {one.what for one in known.result.given} >= {"height of lidar_rear"}
    page = odometry_page(known.result)
    tree = json.loads((tmp_path / "known" / "result.json").read_text(encoding="utf-8"))
    tables = [block for section in page.sections for block in every(section.blocks) if isinstance(block, Table)]
    numbers = [cell for table in tables for row in table.rows for cell in row if isinstance(cell, Number)]
    assert len(numbers) == 15
    for number in numbers:
        assert number.value == at(tree, number.of), number.of
    for name in names[1:]:
        off = frame_distance(known.result.pose(name), driven.T("lidar_front", name))
        assert off.translation_mm < 100.0
    assert (tmp_path / "known" / "tf.yaml").exists()


def test_files_that_are_not_there_and_rigs_of_another_road_are_refused(tmp_path: Path) -> None:
    text = "reference: a\nsensors:\n  a: {odometry: {file: a.tum}}\n  b: {odometry: {file: b.tum}}\n"
    rig = rw.rig.parse_rig(text, "rig.yaml")
    (tmp_path / "a.tum").write_text("1.0 0 0 0 0 0 0 1\n1.1 1 0 0 0 0 0 1\n1.2 2 0 0 0 0 0 1\n")
    with pytest.raises(LogError, match=r"rig.yaml, line 4: sensors.b.odometry: there is no file .*b\.tum"):
        rw.odometry.calibrate_odometry_log(tmp_path, rig, tmp_path / "out")
    with pytest.raises(LogError, match=r"line 2: sensors: no sensor sees a target"):
        rw.calibrate_log(tmp_path, rig, tmp_path / "out")
    of_log = rw.rig.parse_rig(text.replace("file: b.tum", "topic: /b"), "rig.yaml")
    with pytest.raises(LogError, match=r"has no MCAP file, and rig.yaml, line 4: sensors.b.odometry is of a log"):
        rw.odometry.calibrate_odometry_log(tmp_path, of_log, tmp_path / "out")


def test_the_reference_may_be_a_file_beside_the_log(tmp_path: Path) -> None:
    driven = drive(sensors("lidar_front", "lidar_rear"), "3d", seconds=12.0, rate_hz=5.0, seed=5)
    log = write_log(tmp_path / "raw.mcap", driven)
    track = driven.tracks["lidar_front"]
    rows = np.c_[
        (made.BEGIN_NS + track[0]) * 1e-9, track[1][:, :3, 3], Rotation.from_matrix(track[1][:, :3, :3]).as_quat()
    ]
    np.savetxt(tmp_path / "front.tum", rows, fmt="%.9f")
    rig = "reference: lidar_front\nsensors:\n  lidar_front: {odometry: {file: front.tum}}\n"
    rig += "  lidar_rear: {odometry: {topic: /lidar_rear/odom}}\n"
    (tmp_path / "rig.yaml").write_text(rig, encoding="utf-8")
    done = given("calibrate", log, "--rig", tmp_path / "rig.yaml", "-o", tmp_path / "out")
    assert done.exit_code == ExitStatus.CERTIFIED, done.stdout + done.stderr
    result = read_odometry_result(tmp_path / "out" / "result.json")
    assert np.linalg.norm(result.pose("lidar_rear")[:3, 3] - driven.T("lidar_front", "lidar_rear")[:3, 3]) < 0.1


def test_a_first_rig_file_names_the_odometries_of_a_log(six: tuple[Drive, Path, Any]) -> None:
    _, folder, _ = six
    with rw.logs.open_log(folder / "raw.mcap") as log:
        text, notes = rw.rig.propose_rig(log, "rig.yaml")
    rig = rw.rig.parse_rig(text, "rig.yaml")
    assert rig.is_of_odometries
    assert set(rig.odometries) == set(MOUNTS)
    assert rig.reference in {"lidar_front", "lidar_rear", "lidar_roof", "wheels"}
    assert {line.key for line in rw.rig.todo_lines(text)} >= {"reference", "odometry"}
    assert sum(note.startswith("moves: ") for note in notes) == 6


def test_one_lidar_beside_poses_of_a_vehicle_is_no_camera_on_an_arm() -> None:
    """Its sweeps were taken for views of a thing."""
    points = Topic("/velodyne/points", "sensor_msgs/msg/PointCloud2", "cdr", 200, 0, 20_000_000_000, "")
    driven = PoseTopic("/tf", "odom", "base_link", is_tf=True, is_static=False)
    for x in np.linspace(0.0, 9.0, 10):
        driven.add(se3.pose(np.eye(3), np.array([x, 0.0, 0.0])))
    proposed = propose_odometries([driven], "drive.mcap", [points])
    assert proposed is not None
    rig = rw.rig.parse_rig(proposed[0], "rig.yaml")
    assert rig.reference == "base_link"
    assert (rig.odometries["base_link"].odometry.tf, rig.odometries["velodyne"].odometry.clouds) == (
        ("odom", "base_link"),
        "/velodyne/points",
    )
    driven.kept = driven.kept[:2]  # within an arm's reach
    assert propose_odometries([driven], "arm.mcap", [points]) is None


@pytest.mark.slow
def test_a_height_that_the_motions_contradict_is_named(tmp_path: Path) -> None:
    names = ("lidar_front", "lidar_rear")
    write_tum(tmp_path, drive(sensors(*names), "3d", seconds=20.0, rate_hz=5.0, seed=2))
    text = "reference: lidar_front\nsensors:\n" + "".join(
        f"  {name}: {{odometry: {{file: {name}.tum}}}}\n" for name in names
    )
    text += "given: {heights_m: {lidar_rear: 2.9}, ground: {up: [0, 0, 1], below_m: 0.6}}\n"
    solved = rw.odometry.calibrate_odometry_log(tmp_path, rw.rig.parse_rig(text, "rig.yaml"), tmp_path / "out")
    assert solved.judgement.verdict is rw.Verdict.DO_NOT_USE
    assert exit_status(solved.judgement, of_rig=True) is ExitStatus.CONTRADICTED
    assert "what is given contradicts the motions (by so many standard deviations): " in str(solved.judgement)
    assert "the ground's normal" in str(solved.judgement)
    assert "What to do: measure again what is given" in str(solved.judgement)
