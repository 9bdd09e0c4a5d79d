"""Intrinsics that a log's corners contradict are named with their line; those that fit, and single tags, are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.calibration.verdict import Finding, Ground, Judgement, Verdict
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.logs import DetectionRecord, LogWriter, open_log
from gtsam_rwhec.rig import Rig, parse_rig
from gtsam_rwhec.runs.doubted_statements import doubted_intrinsics, finding_against
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


def found_in(folder: Path, rig: Rig, seen_by: Camera, target: str, *, reason: str = "") -> tuple[Finding, ...]:
    """What is found against f = 550, c = (320, 240) in a log of corners that another camera saw."""
    random = np.random.default_rng(0)
    (corners,) = (one.corners() for one in rig.target_list if one.name == target)
    topic = detections_topic("camera")
    with LogWriter(folder / "log.mcap") as out:
        for stamp in range(20):
            turn = np.append(random.normal(size=3) * [0.4, 0.4, 1.0], np.zeros(3))
            T = np.diag([1.0, -1.0, -1.0, 1.0]) @ se3.expmap(turn[None])[0]
            T[:3, 3] = [0.0, 0.0, random.uniform(0.4, 0.6)]
            pixels = seen_by.project(corners @ T[:3, :3].T + T[:3, 3]) + 0.1 * random.normal(size=(len(corners), 2))
            record = DetectionRecord(
                logged_ns=stamp, stamp_ns=stamp, topic=topic, frame="camera", family="", id=target, corners_px=pixels,
                T_camera_tag=T, reason=reason, corner_indices=tuple(range(len(corners))),
            )  # fmt: skip
            out.detections(topic, stamp, "camera", [record])
    with open_log(folder / "log.mcap") as log:
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
