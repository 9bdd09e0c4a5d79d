"""Logs of a camera that nobody calibrated: intrinsics from its images, and what is said where they do not tell."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from cells_of_others import CIRCLES, WORKCELL
from places import CELL
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.errors import CameraError, LogWarning
from gtsam_rwhec.files.progress import silent
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.rig import parse_rig
from gtsam_rwhec.runs import detect_source
from gtsam_rwhec.runs.doubted_statements import doubted_intrinsics
from gtsam_rwhec.runs.kept_detections import inputs_of
from gtsam_rwhec.runs.recorded_logs import write_folder_log
from gtsam_rwhec.runs.run_log import read_cameras, read_embedded_rig
from gtsam_rwhec.runs.sensor_intrinsics import estimate_intrinsics

UNKNOWN = CIRCLES.replace("{K: [550, 550, 320, 240], size: [640, 480]}", "estimate")
BLANK = """\
carriers: {sensors: hand, targets: base, poses: {frames: [base, hand]}}
sensors:
  camera: {images: images, poses: poses.csv, intrinsics: estimate}
targets:
  board: {type: checkerboard, inner_corners: [5, 4], square_m: 0.05}
"""


def part_of(folder: Path, cell: Path, numbers: list[int]) -> Path:
    """A folder with some of the images of a cell, and all of its poses."""
    images = sorted((cell / "images").glob("*.png"))
    (folder / "images").mkdir(parents=True)
    for number in numbers:
        (folder / "images" / images[number].name).symlink_to(images[number])
    (folder / "poses").symlink_to(cell / "poses")
    return folder


def test_images_alone_give_a_camera_that_the_log_records(circle_grid_10x10: Path, tmp_path: Path) -> None:
    folder, out = part_of(tmp_path / "cell", circle_grid_10x10, [0, 3, 6, 9, 12, 14]), tmp_path / "detected.mcap"
    with pytest.warns(LogWarning, match="poses have no image"):
        report = detect_source(folder, parse_rig(UNKNOWN, "rig.yaml"), out, workers=1)
    assert [track.used for track in report.tracks] == [6]
    (words,) = report.remarks
    assert words.startswith(
        "No intrinsics of camera are stated. Detection worked with a first estimate, from 6 views of"
    )
    assert "in its images of 640 x 480 pixels: radtan, fx, fy = 5" in words
    with open_log(out) as log:
        camera, rig = read_cameras(log)["camera"], read_embedded_rig(log)
        assert doubted_intrinsics(log, rig, {"camera": camera}) == {}  # nobody stated them
    assert (camera.width, camera.height, camera.model) == (640, 480, "radtan")
    assert camera.K[[0, 1], [0, 1]] == pytest.approx(542.0, abs=8.0)  # of all 15 images together
    assert rig.sensors["camera"].stated == "unknown"


def test_the_same_images_give_the_same_camera(circle_grid_10x10: Path, tmp_path: Path) -> None:
    folder = part_of(tmp_path / "cell", circle_grid_10x10, [0, 6, 14])
    rig = parse_rig(UNKNOWN, "rig.yaml")
    with pytest.warns(LogWarning, match="poses have no image"):
        write_folder_log(folder, rig, tmp_path / "log.mcap")
    inputs = []
    with open_log(tmp_path / "log.mcap") as log:
        for workers in (1, 2):
            found, failed = estimate_intrinsics(log, rig, workers=workers, progress=silent)
            assert not failed
            inputs.append(inputs_of(log, rig, {name: of.camera for name, of in found.items()}))
    assert inputs[0] == inputs[1]  # an interrupted run goes on


def write_cell(folder: Path, images: list[Gray]) -> None:
    """A folder of images, each with a pose."""
    (folder / "images").mkdir(parents=True)
    rows = ["name,x,y,z,qx,qy,qz,qw"]
    for i, image in enumerate(images):
        cv2.imwrite(str(folder / "images" / f"{i}.png"), image)
        rows.append(f"{i}.png,0,0,{i},0,0,0,1")
    (folder / "poses.csv").write_text("\n".join(rows) + "\n")


@pytest.mark.parametrize(
    ("target", "said"),
    [
        (None, "Does an image show it, whole and in focus"),
        ("tag: {type: tag, family: tag36h11, id: 0, size_m: 0.1}", "The rig file has only single tags"),
    ],
    ids=["no board", "single tags"],
)
def test_images_that_show_no_board_are_refused_with_what_to_do(target: str | None, said: str, tmp_path: Path) -> None:
    write_cell(tmp_path, [np.full((48, 64), 200, np.uint8)] * 4)
    text = BLANK if target is None else BLANK.partition("  board:")[0] + f"  {target}\n"
    with pytest.raises(CameraError) as caught:
        detect_source(tmp_path, parse_rig(text, "rig.yaml"), tmp_path / "detected.mcap", workers=1)
    words = str(caught.value)
    assert words.startswith("rig.yaml, line 3: sensors.camera.intrinsics: the intrinsics of camera cannot be estimated")
    assert "from 0 views of a flat target with 6 corners and more; at least 3 are needed" in words
    assert "4 of its 4 images were searched. Or state intrinsics" in words
    assert said in words
    assert (tmp_path / "detected.seen.png").is_file()
    assert not (tmp_path / "detected.mcap").exists()


@pytest.mark.slow
def test_a_workcell_of_other_people_from_images_and_poses_alone(workcell_camera2: Path, tmp_path: Path) -> None:
    rig = parse_rig(WORKCELL.replace("intrinsic_pars_file.yaml", "estimate"), "rig.yaml")
    calibrated = rw.calibrate_log(workcell_camera2, rig, tmp_path / "out", workers=1)
    x, y, z = calibrated.refined.Y["camera2"].translation()
    assert (x, y, z) == pytest.approx((1.767, 2.062, 1.156), abs=0.02)
    refined = rw.calibrate_corners(
        rw.runs.read_corners(tmp_path / "out" / "calibration.mcap"), rw.CornerOptions(stated="unknown")
    ).refined
    K = refined.intrinsics["camera2"].camera.K
    # as the people who made the set state them, half a pixel off
    assert K[[0, 1, 0, 1], [0, 1, 2, 2]] == pytest.approx([1371.0, 1371.0, 959.5, 539.5], abs=5.0)


@pytest.mark.slow
def test_the_demo_without_its_intrinsics_has_the_truth_in_its_ellipsoids(tmp_path: Path) -> None:
    text = re.sub(r"intrinsics: \{topic: .*\}", "intrinsics: estimate", (CELL / "rig.yaml").read_text(encoding="utf-8"))
    rig = parse_rig(text, "rig.yaml", CELL)
    assert [sensor.stated for sensor in rig.sensors.values()] == ["unknown", "unknown"]
    refined = rw.calibrate_log(CELL / "robot_cell.mcap", rig, tmp_path / "out", workers=1).refined
    truth = json.loads((CELL / "truth.json").read_text(encoding="utf-8"))["T_hand_camera"]
    for name, T in truth.items():
        xi = se3.logmap((se3.inverse(refined.Y[name].matrix()) @ np.array(T))[None])[0]
        assert xi @ np.linalg.solve(refined.covariance(name), xi) < 12.6  # 95 %
    assert refined.intrinsics["cam_wide"].model == "equidistant"
