"""Intrinsics and boards of a rig file that a log's corners contradict are named with their line; right ones are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rwhec_factors import se3

from gtsam_rwhec.calibration.verdict import Finding, Ground, Judgement, Verdict
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, LogWriter, open_log
from gtsam_rwhec.rig import Rig, parse_rig
from gtsam_rwhec.runs.doubted_statements import continued_boards, doubted_intrinsics, doubted_shapes, finding_against
from gtsam_rwhec.runs.run_log import detections_topic

RIG = """\
carriers: {sensors: wrist, targets: base, poses: {frames: [base, wrist]}}
sensors:
  camera: {images: images, poses: poses, intrinsics: {K: [550, 550, 320, 240], size: [640, 480]}}
targets:
  grid: {type: circle_grid, circles: [7, 5], spacing_m: 0.03, larger_dot: true}
  tag: {type: tag, family: tag36h11, id: 3, size_m: 0.1}
"""


def camera_of(f: float, cy: float) -> Camera:
    return Camera.of(640, 480, "", [[f, 0.0, 320.0], [0.0, f, cy], [0.0, 0.0, 1.0]], (), "test")


def write_views(
    log: Path, camera: Camera, target: str, corners: Array, reason: str, *, first: int = 0, images: int = 20,
    tilt: float = 0.4, depth_m: float = 0.5,
) -> Path:  # fmt: skip
    """A log with a target's corners, numbered from the first one on, as a camera sees them in so many poses."""
    random = np.random.default_rng(0)
    topic = detections_topic("camera")
    with LogWriter(log) as out:
        for stamp in range(images):
            turn = np.append(random.normal(size=3) * [tilt, tilt, 1.0], np.zeros(3))
            T = np.diag([1.0, -1.0, -1.0, 1.0]) @ se3.expmap(turn[None])[0]
            T[:3, 3] = [0.0, 0.0, random.uniform(depth_m - 0.1, depth_m + 0.1)]
            pixels = camera.project(corners @ T[:3, :3].T + T[:3, 3]) + 0.1 * random.normal(size=(len(corners), 2))
            record = DetectionRecord(
                logged_ns=stamp, stamp_ns=stamp, topic=topic, frame="camera", family="", id=target, corners_px=pixels,
                T_camera_tag=T, reason=reason, corner_indices=tuple(range(first, first + len(corners))),
            )  # fmt: skip
            out.detections(topic, stamp, "camera", [record])
    return log


def found_in(folder: Path, rig: Rig, seen_by: Camera, target: str, *, reason: str = "") -> tuple[Finding, ...]:
    """What is found against f = 550, c = (320, 240) in a log of corners that another camera saw."""
    (corners,) = (one.corners() for one in rig.target_list if one.name == target)
    with open_log(write_views(folder / "log.mcap", seen_by, target, corners, reason)) as log:
        doubted = doubted_intrinsics(log, rig, {"camera": camera_of(550.0, 240.0)})
    return tuple(finding_against(name, one, rig) for name, one in doubted.items())


def test_wrong_intrinsics_are_named_with_their_line_and_what_fits(tmp_path: Path) -> None:
    rig = parse_rig(RIG, "rig.yaml")
    (finding,) = found_in(tmp_path, rig, camera_of(500.0, 215.0), "grid")
    assert finding.ground is Ground.INTRINSICS_DOUBTED
    assert finding.words.startswith(
        "the intrinsics of camera (rig.yaml, line 3: sensors.camera.intrinsics) do not fit its corners: "
        "fx, fy = 550, 550 and cx, cy = 320, 240, as stated, leave "
    )
    assert "px rms in 20 images, and fx, fy = " in finding.words


def test_a_shared_camera_of_another_lens_is_told_so(tmp_path: Path) -> None:
    first = RIG.splitlines()[2]
    other = first.replace("camera:", "left:").replace("images: images", "images: left")
    shared = "  camera: {images: images, poses: poses, intrinsics: {shared: left}}"
    rig = parse_rig(RIG.replace(first, f"{other}\n{shared}"), "rig.yaml")
    (finding,) = found_in(tmp_path, rig, camera_of(500.0, 215.0), "grid")
    assert finding.words.endswith("; they are those of left (shared), and camera is another camera: give it its own")


def test_slightly_wrong_ones_ask_for_care(tmp_path: Path) -> None:
    (finding,) = found_in(tmp_path, parse_rig(RIG, "rig.yaml"), camera_of(550.0, 247.0), "grid")
    assert finding.ground is Ground.INTRINSICS_UNCERTAIN


def test_right_ones_rejected_detections_and_tags_accuse_nobody(tmp_path: Path) -> None:
    rig = parse_rig(RIG, "rig.yaml")
    assert found_in(tmp_path, rig, camera_of(550.0, 240.0), "grid") == ()
    assert found_in(tmp_path, rig, camera_of(500.0, 215.0), "grid", reason="blurred") == ()
    assert found_in(tmp_path, rig, camera_of(500.0, 215.0), "tag") == ()


def test_intrinsics_come_before_sizes_and_the_arm() -> None:
    size = Finding(Ground.SIZE_DOUBTED, "the stated size of grid is 2 % too large")
    arm = Finding(Ground.SYSTEMATIC, "errors vary with the configuration")
    intrinsics = Finding(Ground.INTRINSICS_DOUBTED, "the intrinsics of camera do not fit its corners")
    judgement = Judgement.of([size, arm, intrinsics], "praise")
    assert judgement.verdict is Verdict.DO_NOT_USE
    assert judgement.grounds == (Ground.INTRINSICS_DOUBTED,)
    free = Finding(Ground.NOT_UNIQUE, "the measurements do not determine all poses")
    assert Judgement.of([free, intrinsics], "praise").grounds == (Ground.INTRINSICS_DOUBTED,)
    assert "intrinsics: estimate" in str(judgement)
    assert str(judgement).startswith("Do not use these poses: the intrinsics of camera")
    assert "What to do: calibrate the intrinsics of the named sensor" in str(judgement)
    slightly = Finding(Ground.INTRINSICS_UNCERTAIN, intrinsics.words)
    assert Judgement.of([slightly], "praise").verdict is Verdict.CARE
    assert Judgement.of([size, slightly], "praise").grounds == (Ground.SIZE_DOUBTED, Ground.INTRINSICS_UNCERTAIN)


BOARD_RIG = """\
carriers: {{sensors: wrist, targets: base, poses: {{frames: [base, wrist]}}}}
sensors:
  camera: {{images: images, poses: poses, intrinsics: {{K: [600, 600, 320, 240], size: [640, 480]}}}}
targets:
  board: {}
"""
LAYOUT = "{{type: bundle, family: tag36h11, layout: [{{id: 1, size: 0.05, x: -0.05, y: -0.04}}, {{id: 2, size: 0.05, x: 0.05, y: -0.04}}, {{id: 3, size: 0.05, x: {}, y: 0.05}}]}}"  # noqa: E501
GRID = "{{type: aprilgrid, family: tag36h11, tags: [5, 4], tag_m: 0.03, spacing: {}}}"
GAPS = "{{type: tag_grid, family: aruco_4x4_50, tags: [4, 3], tag_m: 0.03, gap_m: {}}}"
CAMERA = Camera.of(640, 480, "", [[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]], (), "test")


def rig_of(board: str) -> Rig:
    return parse_rig(BOARD_RIG.format(board), "rig.yaml")


def found_of_board(folder: Path, printed: Rig, stated: Rig, *, first: int = 0, reason: str = "") -> tuple[Finding, ...]:
    """What is found against the stated rig in a log of the printed board's corners, from the first one on."""
    corners, log = printed.target_list[0].corners()[first:], folder / "log.mcap"
    write_views(log, CAMERA, "board", corners, reason, first=first, images=12, tilt=0.3, depth_m=0.6)
    with open_log(log) as opened:
        return doubted_shapes(opened, stated, {"camera": CAMERA})


@pytest.mark.parametrize("board", [LAYOUT.format(0), GRID.format(0.3), GAPS.format(0.008)], ids=["b", "g", "t"])
def test_right_boards_are_not_named(tmp_path: Path, board: str) -> None:
    assert found_of_board(tmp_path, rig_of(board), rig_of(board)) == ()


def test_wrong_boards_are_named_with_their_line_and_what_is_seen(tmp_path: Path) -> None:
    (tag,) = found_of_board(tmp_path, rig_of(LAYOUT.format(0)), rig_of(LAYOUT.format(0.003)))
    assert tag.ground is Ground.SHAPE_DOUBTED
    assert tag.words.startswith("tag 3 of board is 3.0 mm from where the rig file has it (x -3.0, ")
    assert "(rig.yaml, line 5: targets.board)" in tag.words
    (grid,) = found_of_board(tmp_path, rig_of(GRID.format(0.3)), rig_of(GRID.format(0.31)))
    assert grid.ground is Ground.SHAPE_UNCERTAIN
    assert grid.words.startswith("the images show spacing 0.300")
    assert " on board, and not 0.31 (rig.yaml, line 5: targets.board)" in grid.words
    (gaps,) = found_of_board(tmp_path, rig_of(GAPS.format(0.008)), rig_of(GAPS.format(0.009)))
    assert gaps.words.startswith("the images show gap_m 0.0080")


def test_a_tag_that_is_never_seen_asks_for_care(tmp_path: Path) -> None:
    rig = rig_of(LAYOUT.format(0))
    (finding,) = found_of_board(tmp_path, rig, rig, first=4)
    assert finding.ground is Ground.SHAPE_UNCERTAIN
    assert finding.words.startswith("camera never saw tag 1 of board (rig.yaml, line 5: targets.board)")
    assert found_of_board(tmp_path, rig, rig, first=4, reason="blurred") == ()


def test_markers_that_continue_a_charuco_board_ask_for_care() -> None:
    rig = rig_of("{type: charuco, family: aruco_5x5_100, squares: [7, 4], square_m: 0.03, marker_m: 0.022}")
    (finding,) = continued_boards({f"aruco_5x5_100 {i}": 9 for i in (14, 15, 16)}, rig)
    assert finding.ground is Ground.SHAPE_UNCERTAIN
    assert "markers 14 to 16 of aruco_5x5_100, which continue the ids of board (rig.yaml, line 5" in finding.words
    assert "write squares: [7, 5]" in finding.words
    assert continued_boards({"aruco_5x5_100 14": 4}, rig) == ()  # too few
    assert continued_boards({"aruco_5x5_100 20": 9, "aruco_4x4_50 14": 9}, rig) == ()


def test_the_verdict_says_what_to_measure() -> None:
    off = Finding(Ground.SHAPE_DOUBTED, "tag 3 of board is 3.0 mm from where the rig file has it")
    judgement = Judgement.of([off], "praise")
    assert judgement.verdict is Verdict.DO_NOT_USE
    assert "What to do: measure the named board" in str(judgement)
    assert Judgement.of([Finding(Ground.SHAPE_UNCERTAIN, off.words)], "praise").verdict is Verdict.CARE
