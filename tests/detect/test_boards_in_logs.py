"""A board that looks the same turned has one frame in all images of all cameras, or the run says which are unsure."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from cells_of_others import UNKNOWN_LENS
from rendered import PINHOLE, pose, printed, render
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.detect.detector import Detector
from gtsam_rwhec.files.progress import silent
from gtsam_rwhec.logs import LogWriter, open_log
from gtsam_rwhec.rig.rig_file import parse_rig
from gtsam_rwhec.runs.carrier_motion import read_carrier_motion
from gtsam_rwhec.runs.recorded_logs import write_folder_log
from gtsam_rwhec.runs.sensor_detections import detect_in_log
from gtsam_rwhec.runs.sensor_intrinsics import estimate_intrinsics, read_intrinsics

BOARD = Checkerboard("board", 5, 3, 0.03)
IMAGES = 8
CAMERA = "{images: /IMAGES, intrinsics: {model: pinhole, width: 320, height: 240, K: [300, 302, 157, 121.5]}}"
RIG = f"""
carriers: {{sensors: base, targets: hand, poses: {{frames: [base, hand]}}}}
sensors:
  left: {CAMERA.replace("IMAGES", "left")}
  right: {CAMERA.replace("IMAGES", "right")}
targets:
  board: {{type: checkerboard, inner_corners: [5, 3], square_m: 0.03}}
"""


@pytest.fixture(scope="module")
def log_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two cameras on the base, the right one turned by 130 degrees about its line of sight, and a board on the hand."""
    generator = np.random.default_rng(5)
    path = tmp_path_factory.mktemp("turned") / "log.mcap"
    T_hand_board = se3.expmap(generator.normal(size=(1, 6)))[0]
    with LogWriter(path) as out:
        for name, about_z in (("left", 0.0), ("right", 130.0)):
            T_camera_base = se3.expmap(generator.normal(size=(1, 6)))[0]
            for k in range(IMAGES):
                stamp = 1_000_000_000 * (1 + k + (IMAGES if name == "right" else 0))
                tilt = (*generator.uniform(-30.0, 30.0, 2), about_z + generator.uniform(-120.0, 120.0))
                T = pose(tilt, (*generator.uniform(-0.01, 0.01, 2), 0.35))
                T_base_hand = np.linalg.inv(T_camera_base) @ T @ np.linalg.inv(T_hand_board)
                out.transforms("/tf", stamp, [("base", "hand", T_base_hand)])
                image = cv2.imencode(".png", render(PINHOLE, [(printed(BOARD), T)], seed=k))[1].tobytes()
                out.compressed_image(f"/{name}", stamp, name, "png", image)
    return path


def test_a_board_has_one_frame_for_two_cameras(log_path: Path) -> None:
    rig = parse_rig(RIG, "rig.yaml")
    with open_log(log_path) as log:
        motion = read_carrier_motion(log, rig)
        found = detect_in_log(log, rig, read_intrinsics(log, rig), motion, workers=1, progress=silent)
    hand_board = []
    for sensor in ("left", "right"):
        records = found[sensor].records
        assert [record.reason for record in records] == [""] * IMAGES
        A = motion.A_where_known(np.array([record.stamp_ns for record in records]), 1.0)
        B = np.array([record.T_camera_tag for record in records])
        # Axes of the board in the hand's frame: A_i^-1 A_j = X B_i^-1 B_j X^-1.
        a, b = (se3.so3_logmap(x[:-1, :3, :3].swapaxes(1, 2) @ x[1:, :3, :3]) for x in (A, B))
        U, _, Vt = np.linalg.svd(a.T @ b)
        hand_board.append(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
        assert np.abs(a - b @ hand_board[-1].T).max() < np.radians(3.0)
    np.testing.assert_allclose(hand_board[0], hand_board[1], atol=0.05)


def test_turns_that_a_camera_without_poses_cannot_tell_are_ambiguous(log_path: Path) -> None:
    rig = parse_rig(RIG, "rig.yaml")
    with open_log(log_path) as log:
        motion = read_carrier_motion(log, rig)
        late = motion.trajectory.stamps_ns[-1] - motion.trajectory.stamps_ns[0] + 10**12
        moved = type(motion)(type(motion.trajectory)(motion.trajectory.stamps_ns + late, motion.trajectory.T), None)
        found = detect_in_log(log, rig, read_intrinsics(log, rig), moved, workers=1, progress=silent)
    for sensor in ("left", "right"):
        assert {record.reason for record in found[sensor].records} == {Rejection.AMBIGUOUS}


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
    rig = parse_rig(UNKNOWN_LENS, "rig.yaml")
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
