"""A plan in files and on the terminal: what other programs read is what was planned."""

from __future__ import annotations

import csv
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from places import REPOSITORY
from rwhec_factors import se3
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import gtsam_rwhec as rw
from gtsam_rwhec.cli.app import app
from gtsam_rwhec.errors import FileFormatError

sys.path.insert(0, str(REPOSITORY / "benchmarks"))
from planned_cells import cell

RIG = """
carriers: {sensors: hand, targets: base, poses: {tf: [base, hand]}}
sensors:
  cam:
    images: /cam/image
    intrinsics: {K: [1200.0, 1200.0, 639.5, 479.5], size: [1280, 960]}
targets:
  board: {type: charuco, family: aruco_4x4_100, squares: [7, 5], square_m: 0.04, marker_m: 0.03}
"""


@pytest.fixture(scope="module")
def plan() -> rw.Plan:
    true = cell("hand", 0)
    problem = rw.Problem(sensor_carrier="hand", target_carrier="base")
    for i, A in enumerate(true.random_poses(5, 60.0)):
        true.take(problem, A, i)
    return rw.plan(problem, replace(true.options, present=None, candidates=40, poses=4))


def test_all_files_hold_the_same_poses(plan: rw.Plan, tmp_path: Path) -> None:
    files = rw.capture.write_plan(plan, tmp_path / "plan")
    assert all(file.is_file() for file in files)
    content = yaml.safe_load((tmp_path / "plan" / "plan.yaml").read_text())
    rows = list(csv.DictReader((tmp_path / "plan" / "plan.csv").open()))
    with (tmp_path / "plan" / "plan.mcap").open("rb") as file:
        ((_, channel, _, message),) = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
    assert channel.topic == "/plan/poses"
    assert message.header.frame_id == "base"
    assert len(message.poses) == len(rows) == len(content["poses"]) == len(plan.poses) == 4
    for pose, row, entry, ros in zip(plan.poses, rows, content["poses"], message.poses, strict=True):
        assert (pose.parent, pose.child) == (row["parent"], row["child"]) == (entry["parent"], entry["child"])
        R = Rotation.from_quat([entry[name] for name in ("qx", "qy", "qz", "qw")]).as_matrix()
        T = se3.pose(R, [entry[name] for name in ("x_m", "y_m", "z_m")])
        assert np.abs(T - pose.T_parent_child).max() < 1e-12
        assert np.abs(se3.inverse(T) - pose.T_sensorcarrier_targetcarrier).max() < 1e-12  # the hand carries the sensor
        assert [float(row[name]) for name in ("x_m", "y_m", "z_m")] == [entry[n] for n in ("x_m", "y_m", "z_m")]
        assert [ros.position.x, ros.orientation.w] == pytest.approx([entry["x_m"], entry["qw"]], abs=1e-12)
        assert entry["sees"] == row["sees"].split() == [f"{pair.sensor}:{pair.target}" for pair in pose.sees]
    assert sorted(entry["tour"] for entry in content["poses"]) == [1, 2, 3, 4]


def test_pictures_show_the_board_where_the_camera_should_see_it(plan: rw.Plan, tmp_path: Path) -> None:
    pose = plan.poses[0]
    camera = plan.kit.cameras["cam_0"]
    picture = rw.capture.picture_of(plan, pose, "cam_0")
    scale = picture.shape[1] / camera.width
    board, B = plan.kit.boards["board_0"], pose.T_sensor_target[rw.Pair("board_0", "cam_0")]
    middle = scale * camera.project(board @ B[:3, :3].T + B[:3, 3]).mean(axis=0)
    paper = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) > 200
    assert paper[int(middle[1]) - 25 : int(middle[1]) + 25, int(middle[0]) - 25 : int(middle[0]) + 25].mean() > 0.3
    now = np.full((camera.height, camera.width), 90, np.uint8)
    assert np.median(rw.capture.picture_of(plan, pose, "cam_0", now)) == 90


def test_a_folder_that_cannot_be_written_is_said(plan: rw.Plan, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FileFormatError, match="cannot be written"):
        rw.capture.write_plan(plan, tmp_path / "file" / "plan")


def test_the_command_says_first_what_the_poses_lead_to(tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(RIG)
    called = ["plan", "--rig", str(rig), "--wanted-mm", "2", "--at-m", "0.8", "--poses", "4"]
    done = CliRunner().invoke(app, [*called, "-o", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    assert "reach" in lines[0]
    table = [line for line in lines[1:] if line.strip()[:2] in ("1 ", "2 ", "3 ", "4 ")]
    assert len(table) == 4
    assert len({line.index("cam board") for line in table}) == 1
    assert (tmp_path / "out" / "pictures" / "01_cam.jpg").is_file()
    for arguments, status in (
        (["--wanted-mm", "0.0001"], 3),
        (["--box", *map(str, (9, 9, 9, 10, 10, 10))], 3),
        (["--present", *["0"] * 7], 2),
        (["--sensor", "other"], 2),
        (["--urdf", str(tmp_path / "none.urdf")], 2),
    ):
        assert CliRunner().invoke(app, ["plan", "--rig", str(rig), *arguments]).exit_code == status, arguments
    assert CliRunner().invoke(app, ["plan"]).exit_code == 2
