"""Boards of a rig file that a log's corners contradict are named with the line; right ones are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rwhec_factors import se3

from gtsam_rwhec.calibration.verdict import Finding, Ground, Judgement, Verdict
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.logs import DetectionRecord, LogWriter, open_log
from gtsam_rwhec.rig import Rig, parse_rig
from gtsam_rwhec.runs.doubted_statements import continued_boards, doubted_shapes
from gtsam_rwhec.runs.run_log import detections_topic

RIG = """\
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
    return parse_rig(RIG.format(board), "rig.yaml")


def found_in(folder: Path, printed: Rig, stated: Rig, *, first: int = 0, reason: str = "") -> tuple[Finding, ...]:
    """What is found against the stated rig in a log of the printed board's corners, from the first one on."""
    random = np.random.default_rng(0)
    corners = printed.target_list[0].corners()[first:]
    topic = detections_topic("camera")
    with LogWriter(folder / "log.mcap") as out:
        for stamp in range(12):
            turn = np.append(random.normal(size=3) * [0.3, 0.3, 1.0], np.zeros(3))
            T = np.diag([1.0, -1.0, -1.0, 1.0]) @ se3.expmap(turn[None])[0]
            T[:3, 3] = [0.0, 0.0, random.uniform(0.5, 0.7)]
            pixels = CAMERA.project(corners @ T[:3, :3].T + T[:3, 3]) + 0.1 * random.normal(size=(len(corners), 2))
            record = DetectionRecord(
                logged_ns=stamp, stamp_ns=stamp, topic=topic, frame="camera", family="", id="board", corners_px=pixels,
                T_camera_tag=T, reason=reason, corner_indices=tuple(range(first, first + len(corners))),
            )  # fmt: skip
            out.detections(topic, stamp, "camera", [record])
    with open_log(folder / "log.mcap") as log:
        return doubted_shapes(log, stated, {"camera": CAMERA})


@pytest.mark.parametrize("board", [LAYOUT.format(0), GRID.format(0.3), GAPS.format(0.008)], ids=["b", "g", "t"])
def test_right_boards_are_not_named(tmp_path: Path, board: str) -> None:
    assert found_in(tmp_path, rig_of(board), rig_of(board)) == ()


def test_wrong_boards_are_named_with_their_line_and_what_is_seen(tmp_path: Path) -> None:
    (tag,) = found_in(tmp_path, rig_of(LAYOUT.format(0)), rig_of(LAYOUT.format(0.003)))
    assert tag.ground is Ground.SHAPE_DOUBTED
    assert tag.words.startswith("tag 3 of board is 3.0 mm from where the rig file has it (x -3.0, ")
    assert "(rig.yaml, line 5: targets.board)" in tag.words
    (grid,) = found_in(tmp_path, rig_of(GRID.format(0.3)), rig_of(GRID.format(0.31)))
    assert grid.ground is Ground.SHAPE_UNCERTAIN
    assert grid.words.startswith("the images show spacing 0.300")
    assert " on board, and not 0.31 (rig.yaml, line 5: targets.board)" in grid.words
    (gaps,) = found_in(tmp_path, rig_of(GAPS.format(0.008)), rig_of(GAPS.format(0.009)))
    assert gaps.words.startswith("the images show gap_m 0.0080")


def test_a_tag_that_is_never_seen_asks_for_care(tmp_path: Path) -> None:
    rig = rig_of(LAYOUT.format(0))
    (finding,) = found_in(tmp_path, rig, rig, first=4)
    assert finding.ground is Ground.SHAPE_UNCERTAIN
    assert finding.words.startswith("camera never saw tag 1 of board (rig.yaml, line 5: targets.board)")
    assert found_in(tmp_path, rig, rig, first=4, reason="blurred") == ()


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
