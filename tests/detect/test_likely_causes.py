"""The causes that are named where most targets are not read: which, with how many images, with the rig file's line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered import pose, printed, render

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Checkerboard, CircleGrid, Tag, Target
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import DetectionRecord
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.rig.rig_file import parse_rig
from gtsam_rwhec.runs.detection_stage import detect_source
from gtsam_rwhec.runs.sensor_detections import SensorDetections, of_size
from gtsam_rwhec.runs.unread_targets import of_rejections

CAMERA = Camera.of(640, 480, "", [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]], (), "test")
RIG = """\
carriers: {{sensors: base, targets: hand, poses: {{frames: [base, hand]}}}}
sensors:
  camera: {{images: image, poses: poses.txt, intrinsics: {{K: [500, 500, 320, 240], size: [640, 480]}}}}
targets:
  it: {{{target}}}
"""


def rig(target: str) -> Rig:
    return parse_rig(RIG.format(target=target), "rig.yaml")


def folder_of(path: Path, target: Target, count: int = 2, *, blur_px: float = 0.7) -> Path:
    """Images of a target from a few places."""
    (path / "image").mkdir(parents=True)
    for i in range(count):
        T = pose((10 + 3 * i, 15 - 4 * i, 5 * i), (0.01 * i, -0.01 * i, 0.7))
        cv2.imwrite(str(path / "image" / f"{i}.png"), render(CAMERA, [(printed(target), T)], seed=i, blur_px=blur_px))
    rows = [f"{0.1 * i} 0 0 {np.sin(0.1 * i)} 0 0 {np.cos(0.1 * i)}" for i in range(count)]
    (path / "poses.txt").write_text("\n".join(rows))
    return path


@pytest.mark.parametrize(
    ("shown", "stated", "words"),
    [
        (Checkerboard("b", 6, 4, 0.04), "type: checkerboard, inner_corners: [7, 5], square_m: 0.04",
         ["2 of 2 images show a board of 6 x 4 inner corners, and the rig file says 7 x 5 (it counts squares",
          "write inner_corners: [6, 4] (rig.yaml, line 5: targets.it.inner_corners)."]),
        (CircleGrid("g", 7, 5, 0.04, True), "type: circle_grid, circles: [7, 5], spacing_m: 0.04",
         ["2 of 2 images show the grid with its larger dot at the lower left: write larger_dot: lower_left (rig."]),
        (CircleGrid("g", 7, 5, 0.04, True), "type: circle_grid, circles: [5, 7], spacing_m: 0.04, larger_dot: true",
         ["show a board of 7 x 5 circles, or its larger dot at another corner than the lower left: write circles: "
          "[7, 5] (rig.yaml, line 5: targets.it.circles), or larger_dot: lower_right."]),
        (Tag("t", "aruco_4x4_50", 7, 0.15), "type: tag, family: aruco_5x5_100, id: 7, size_m: 0.15",
         ["2 of 2 images show tags of aruco_4x4_50 and none of aruco_5x5_100: write family: aruco_4x4_50 (rig.yaml, "]),
    ],
    ids=["squares counted", "dot", "exchanged", "family"],
)  # fmt: skip
def test_what_is_likely_is_said_with_the_line_to_write(
    tmp_path: Path, shown: Target, stated: str, words: Sequence[str]
) -> None:
    with pytest.raises(LogError, match="no usable detection") as caught:
        detect_source(folder_of(tmp_path / "cell", shown), rig(stated), tmp_path / "out.mcap", workers=1)
    assert str(caught.value).startswith("cell: no usable detection of a target of the rig file.\n- it: ")
    for word in words:
        assert word in str(caught.value)


def test_a_blurred_tag(tmp_path: Path) -> None:
    target = Tag("t", "tag36h11", 7, 0.15)
    stated = rig("type: tag, family: tag36h11, id: 7, size_m: 0.15")
    with pytest.raises(LogError) as caught:
        detect_source(folder_of(tmp_path / "cell", target, blur_px=4.0), stated, tmp_path / "out.mcap", workers=1)
    assert "blurred" in str(caught.value)
    assert "Focus the lens, stand still for each image, or expose for a shorter time." in str(caught.value)


def test_a_target_that_is_read_has_no_likely_causes(tmp_path: Path) -> None:
    stated = rig("type: checkerboard, inner_corners: [7, 4], square_m: 0.04")
    folder = folder_of(tmp_path / "cell", Checkerboard("b", 7, 4, 0.04), 2)
    assert detect_source(folder, stated, tmp_path / "out.mcap", workers=1).likely == ()


def test_a_target_that_is_in_no_image_is_not_explained(tmp_path: Path) -> None:
    other = "other: {type: tag, family: tag36h11, id: 3, size_m: 0.1"
    two = rig(f"type: checkerboard, inner_corners: [7, 4], square_m: 0.04}}\n  {other}")
    folder = folder_of(tmp_path / "cell", Checkerboard("b", 7, 4, 0.04))
    report = detect_source(folder, two, tmp_path / "out.mcap", workers=1)
    assert report.unseen == ("other",)
    assert report.likely == ()


def rejected(reason: str, count: int = 10, side_px: float = 8.0, off_px: float = 2.5) -> dict[str, SensorDetections]:
    corners = np.array([[0.0, 0.0], [side_px, 0.0], [side_px, side_px], [0.0, side_px]])
    records = [
        DetectionRecord(i, i, "/d", "camera", "f", "it", corners, reprojection_px=off_px, reason=reason)
        for i in range(count)
    ]
    return {"camera": SensorDetections(records, count, {})}  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("reason", "words"),
    [
        (Rejection.SMALL, "10 of 10 detections are small: a side of about 8 pixels, and at least 12 are wanted"),
        (Rejection.BLURRED, "10 of 10 detections are blurred, and at most 3 (standard deviation) is wanted. Focus"),
        (Rejection.REPROJECTION, "the corners are 2.5 pixels off those of a plane that this camera sees. Are the "
         "intrinsics those of these images (rig.yaml, line 3: sensors.camera.intrinsics), and is the target flat?"),
        (Rejection.AMBIGUOUS, "10 of 10 detections are ambiguous: two of its poses look alike"),
        (f"{Rejection.LAYOUT}: write squares: [5, 4]", "the tags are not where the rig file has them: write squares: "
         "[5, 4] (rig.yaml, line 5: targets.it)"),
    ],
)  # fmt: skip
def test_what_rejections_say_themselves(reason: str, words: str) -> None:
    stated = rig("type: tag, family: tag36h11, id: 7, size_m: 0.15")
    (cause,) = of_rejections(stated, stated.target_list[0], rejected(reason), {})
    assert words in cause
    assert not list(of_rejections(stated, stated.target_list[0], rejected(Rejection.GRAZING), {}))


@pytest.mark.parametrize(
    ("size", "of_intrinsics", "words"),
    [
        ((640, 480), (1280, 960), "multiply fx, fy, cx and cy by 0.5 and write size"),
        ((480, 640), (640, 480), "Width and height are exchanged"),
        ((640, 400), (640, 480), "what was cut out of an image has another centre"),
        ((640, 480), (640, 480), ""),
        (None, (640, 480), ""),
    ],
)
def test_images_of_another_size_than_the_intrinsics(
    size: tuple[int, int] | None, of_intrinsics: tuple[int, int], words: str
) -> None:
    camera = Camera.of(*of_intrinsics, "pinhole", [[500, 0, 320], [0, 500, 240], [0, 0, 1]], (), "test")
    said = of_size(rig("type: tag, family: tag36h11, id: 7, size_m: 0.15"), "camera", size, camera)
    assert words in said
    assert bool(words) == ("rig.yaml, line 3: sensors.camera.intrinsics" in said)
