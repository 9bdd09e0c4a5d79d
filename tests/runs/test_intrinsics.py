"""Which camera of which file is a sensor's; what is missing is said with its line, before anything is copied."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from intrinsics_samples import CAMCHAIN, ROS

import gtsam_rwhec as rw
from gtsam_rwhec.errors import CameraError, CameraWarning, FileFormatError, RwhecError
from gtsam_rwhec.rig.rig_file import parse_rig
from gtsam_rwhec.runs.log_evidence import BOARDS_ALONE, origins_before_corners
from gtsam_rwhec.runs.recorded_logs import write_folder_log
from gtsam_rwhec.runs.sensor_intrinsics import check_intrinsics_files, read_intrinsics

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
