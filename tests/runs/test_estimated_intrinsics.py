"""Which camera of which file is a sensor's, and logs of a camera that nobody calibrated: from images, with lines."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from cells_of_others import CIRCLES, UNKNOWN_LENS, WORKCELL
from intrinsics_samples import CAMCHAIN, ROS
from places import CELL
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.errors import CameraError, CameraWarning, FileFormatError, LogWarning, RwhecError
from gtsam_rwhec.files.progress import silent
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.rig import parse_rig
from gtsam_rwhec.runs import detect_source
from gtsam_rwhec.runs.doubted_statements import doubted_intrinsics
from gtsam_rwhec.runs.kept_detections import inputs_of
from gtsam_rwhec.runs.log_evidence import BOARDS_ALONE, origins_before_corners
from gtsam_rwhec.runs.recorded_logs import write_folder_log
from gtsam_rwhec.runs.run_log import read_cameras, read_embedded_rig
from gtsam_rwhec.runs.sensor_intrinsics import check_intrinsics_files, estimate_intrinsics, read_intrinsics

UNKNOWN = CIRCLES.replace("{K: [550, 550, 320, 240], size: [640, 480]}", "estimate")


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
    text = UNKNOWN_LENS if target is None else UNKNOWN_LENS.partition("  board:")[0] + f"  {target}\n"
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


FILES = {
    "chain.yaml": CAMCHAIN,
    "alone.yaml": CAMCHAIN[: CAMCHAIN.index("cam1:")],
    "ost.yaml": ROS,
    "cameras.txt": "# Camera list\n1 PINHOLE 640 480 500 500 320 240\n2 OPENCV 640 480 600 600 320 240 0.1 0 0 0\n",
}
RIG = """\
carriers: {{sensors: base, targets: hand, poses: {{frames: [base, hand]}}}}
sensors:
  cam1: {{images: images, poses: poses.csv, intrinsics: {source}}}
targets:
  board: {{type: checkerboard, inner_corners: [3, 4], square_m: 0.05}}
"""


def rig(folder: Path, source: str) -> rw.rig.Rig:
    for name, text in FILES.items():
        (folder / name).write_text(text)
    return parse_rig(RIG.format(source=source), "rig.yaml", folder)


@pytest.fixture
def log(tmp_path: Path) -> rw.logs.Log:
    """A log without topics of intrinsics."""
    with rw.logs.LogWriter(tmp_path / "log.mcap") as out:
        out.transforms("/tf", 1, [("base", "hand", np.eye(4))])
    return rw.logs.open_log(tmp_path / "log.mcap")


@pytest.mark.parametrize(
    ("source", "fx"),
    [
        ("chain.yaml", 300.0),  # the camera of the sensor's name
        ("{kalibr: chain.yaml}", 300.0),
        ("{kalibr: chain.yaml, camera: cam0}", 458.6),
        ("{file: chain.yaml, camera: cam0}", 458.6),
        ("alone.yaml", 458.6),  # the only one
        ("ost.yaml", 430.2),
        ("{file: cameras.txt, camera: '2'}", 600.0),
        ("{size: [640, 480], K: [700, 700, 320, 240], model: unified, D: [1.2, -0.1, 0, 0, 0]}", 700.0),
    ],
)
def test_whose_intrinsics(tmp_path: Path, log: rw.logs.Log, source: str, fx: float) -> None:
    with log:
        assert read_intrinsics(log, rig(tmp_path, source))["cam1"].K[0, 0] == fx


def test_what_a_calibration_wrote_is_read_again(tmp_path: Path, log: rw.logs.Log) -> None:
    K = [[400.0, 0.0, 320.0], [0.0, 400.0, 240.0], [0.0, 0.0, 1.0]]
    camera = rw.cameras.Camera.of(640, 480, "radtan", K, [0.1, 0.0, 0.0, 1.0 / 3.0], "test")
    frames = rw.rig.RigFrames("base", "hand", {"cam0": np.eye(4), "cam1": np.eye(4)}, {}, {"cam1": camera})
    rw.rig.export_all(frames, tmp_path)
    with log:
        for source in ("cameras.opencv.yaml", "{file: camera_info/cam1.yaml, stated: calibration}", "camchain.yaml"):
            given = parse_rig(RIG.format(source=source), "rig.yaml", tmp_path)
            read = read_intrinsics(log, given)["cam1"]
            assert (read.K.tolist(), read.D.tolist()) == (K, camera.D.tolist())


def test_a_lens_that_folds_back_within_the_image_is_warned_of(tmp_path: Path, log: rw.logs.Log) -> None:
    source = "{size: [640, 480], K: [500, 500, 320, 240], model: radtan, D: [-0.9, 0, 0, 0]}"
    words = r"sensor cam1: the distortion \(radtan, D = \[-0.9, .*\) folds back 203 pixels .*: 5\d % of the image"
    with log, pytest.warns(CameraWarning, match=words):
        read_intrinsics(log, rig(tmp_path, source))


def test_intrinsics_that_nobody_stated_are_not_said_to_be_stated(tmp_path: Path) -> None:
    assert origins_before_corners(rig(tmp_path, "estimate"), ["cam1"]) == {"cam1": BOARDS_ALONE}
    assert origins_before_corners(rig(tmp_path, "ost.yaml"), ["cam1"]) == {}


@pytest.mark.parametrize(
    ("source", "error", "words"),
    [
        ("cameras.txt", CameraError, r"line 3: sensors.cam1.intrinsics: .*has no camera of the sensor's name, 'cam1'; "
         r"it has 1, 2: write {file: cameras\.txt, camera: '1'}"),
        ("{file: chain.yaml, camera: cam7}", CameraError, "has no camera 'cam7'; it has cam0, cam1"),
        ("{file: ost.yaml, camera: cam1}", CameraError, "it has one alone, without a name: leave camera out"),
        ("none.yaml", FileFormatError, r"none\.yaml cannot be read: No such file.*\(rig\.yaml, line 3: sensors\.c"),
    ],
)  # fmt: skip
def test_whose_are_not_there(tmp_path: Path, source: str, error: type[RwhecError], words: str) -> None:
    with pytest.raises(error, match=words):
        check_intrinsics_files(rig(tmp_path, source))


def test_missing_intrinsics_are_noticed_before_images_are_copied(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    _, png = cv2.imencode(".png", np.zeros((4, 6), dtype=np.uint8))
    for i in range(2):
        (tmp_path / "images" / f"{i}.png").write_bytes(png.tobytes())
    (tmp_path / "poses.csv").write_text("0,0,0,0,0,0,0,1\n1,1,0,0,0,0,0,1\n")
    described = rig(tmp_path, "none.yaml")
    with pytest.raises(FileFormatError, match="none"):
        rw.runs.calibrate_log(tmp_path, described, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert write_folder_log(tmp_path, described, tmp_path / "whole.mcap") == (2, 2)
