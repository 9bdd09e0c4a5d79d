"""Boards in images of a lens that nobody calibrated: bent as no pinhole sees them, and read all the same."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest
from rendered import pose, printed, render

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.detect.detector import Detector
from gtsam_rwhec.files.progress import silent
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.rig import parse_rig
from gtsam_rwhec.runs.recorded_logs import write_folder_log
from gtsam_rwhec.runs.sensor_intrinsics import estimate_intrinsics

RIG = """\
carriers: {sensors: hand, targets: base, poses: {frames: [base, hand]}}
sensors:
  camera: {images: images, poses: poses.csv, intrinsics: estimate}
targets:
  board: {type: checkerboard, inner_corners: [5, 4], square_m: 0.05}
"""


def test_boards_that_a_lens_bends_are_read(tmp_path: Path) -> None:
    """No image of the board passes as a pinhole's: its corners, although rejected, say how the lens bends."""
    lens = Camera.of(320, 240, "radtan", [[280, 0, 161], [0, 279, 119], [0, 0, 1]], (-0.28, 0.09, 8e-4, -5e-4), "test")
    board = printed(Checkerboard("board", 5, 4, 0.05))
    turns = [(30, 0, 5), (-30, 10, 0), (5, 35, -8)]
    images = [render(lens, [(board, pose(turn, (0.0, 0.0, 0.42)))], seed=i) for i, turn in enumerate(turns)]
    (tmp_path / "images").mkdir()
    rows = ["name,x,y,z,qx,qy,qz,qw", *(f"{i}.png,0,0,{i},0,0,0,1" for i in range(len(images)))]
    (tmp_path / "poses.csv").write_text("\n".join(rows) + "\n")
    for i, image in enumerate(images):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), image)
    rig = parse_rig(RIG, "rig.yaml")
    write_folder_log(tmp_path, rig, tmp_path / "log.mcap")
    pinhole = Camera.of(320, 240, "pinhole", lens.K, (), "test")
    (as_pinhole,) = Detector(pinhole, rig.target_list)(images[:1])
    assert [seen.rejection for seen in as_pinhole.detections] == [Rejection.NOT_A_GRID]
    with open_log(tmp_path / "log.mcap") as log:
        found, failed = estimate_intrinsics(log, rig, workers=1, progress=silent)
    assert not failed
    camera = found["camera"].camera
    assert camera.K[[0, 1, 0, 1], [0, 1, 2, 2]] == pytest.approx([280.0, 279.0, 161.0, 119.0], abs=1.0)
    assert camera.D[:2] == pytest.approx([-0.28, 0.09], abs=0.05)
    assert found["camera"].views == len(turns)
