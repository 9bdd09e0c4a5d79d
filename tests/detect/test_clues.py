"""Why targets are not read: what rendered images say, and which causes are named, with the line of the rig file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered import BARREL, FISHEYE, Print, pose, printed, render, tag_modules

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import AprilGrid, Charuco, Checkerboard, CircleGrid, Tag, Target
from gtsam_rwhec.detect.clues import About, Clue, clues, edge_blur_px, motion_blur_px, read, resized, tags_seen
from gtsam_rwhec.detect.detections import DetectionOptions, Rejection
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import DetectionRecord
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.rig.rig_file import parse_rig
from gtsam_rwhec.runs.detection_stage import detect_source
from gtsam_rwhec.runs.sensor_detections import SensorDetections, of_size
from gtsam_rwhec.runs.unread_targets import of_rejections

OPTIONS = DetectionOptions()
CAMERA = Camera.of(640, 480, "", [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]], (), "test")
HERE, FAR = pose((15, 20, 10), (0.0, 0.0, 0.7)), pose((15, 20, 10), (0.0, 0.0, 4.5))
BOARD = Checkerboard("board", 6, 4, 0.04)
GRID = CircleGrid("grid", 7, 5, 0.04, larger_dot=True)
TAG = Tag("tag", "tag36h11", 5, 0.15)
APRILGRID = AprilGrid("grid", "tag36h11", 4, 3, 0.06, 0.3)
CHARUCO = Charuco("board", "aruco_5x5_100", 6, 5, 0.05, 0.037)


def image(target: Target, T: np.ndarray = HERE, *, blur_px: float = 0.7) -> Gray:
    return render(CAMERA, [(printed(target), T)], blur_px=blur_px)


def of(gray: Gray, target: Target) -> list[tuple[About, object]]:
    assert read(gray, CAMERA, target, OPTIONS) is None
    return [(clue.about, clue.value) for clue in clues(gray, target, CAMERA, OPTIONS)]


@pytest.mark.parametrize(
    ("columns", "rows", "counts"),
    [(7, 5, (6, 4)), (5, 7, (4, 6)), (5, 3, (6, 4)), (8, 6, (6, 4)), (6, 5, (6, 4)), (4, 4, (4, 6))],
)
def test_other_counts_of_a_checkerboard(columns: int, rows: int, counts: tuple[int, int]) -> None:
    (clue,) = clues(image(BOARD), replace(BOARD, columns=columns, rows=rows), CAMERA, OPTIONS)
    assert (clue.about, clue.value) == (About.COUNTS, counts)


@pytest.mark.parametrize(
    ("stated", "clue"),
    [
        ({"columns": 5, "rows": 7}, (About.COUNTS, (7, 5))),
        ({"columns": 8}, (About.COUNTS, (7, 5))),
        ({"columns": 6, "rows": 4}, (About.COUNTS, (7, 5))),
        ({"larger_dot": False}, (About.DOT, "lower_left")),
        ({"larger_dot": "lower_right"}, (About.COUNTS, (5, 7))),  # the same grid, seen from its side
    ],
)
def test_other_circles(stated: dict[str, object], clue: tuple[About, object]) -> None:
    assert of(image(GRID), replace(GRID, **stated)) == [clue]  # type: ignore[arg-type]


def test_other_families_ids_and_borders() -> None:
    gray = image(TAG)
    assert tags_seen(gray) == [("tag36h11", 1, 5)]
    assert of(gray, replace(TAG, id=7)) == [(About.ID, 5)]
    assert of(gray, replace(TAG, family="tag25h9")) == [(About.FAMILY, "tag36h11")]
    assert of(image(CHARUCO), replace(CHARUCO, family="aruco_4x4_100")) == [(About.FAMILY, "aruco_5x5_1000")]
    kalibrs = image(APRILGRID)
    assert of(kalibrs, replace(APRILGRID, family="tag25h9", first_id=0)) == [(About.FAMILY, "tag36h11")]
    assert of(image(CHARUCO), AprilGrid("grid", "aruco_5x5_100", 4, 3, 0.06, 0.3)) == [(About.BORDER, 1)]


def test_too_small_in_the_image() -> None:
    (clue,) = clues(image(BOARD, FAR), BOARD, CAMERA, OPTIONS)
    assert clue.about is About.SMALL
    assert 10.0 < clue.figure < 25.0  # three squares of 4 cm, 4.5 m away, with f = 500


@pytest.mark.parametrize("blur_px", [4.0, 6.0])
def test_too_much_blur(blur_px: float) -> None:
    (clue,) = clues(image(TAG, blur_px=blur_px), TAG, CAMERA, OPTIONS)
    assert clue.about is About.BLURRED
    assert 2.0 < clue.figure < 1.2 * blur_px  # its cells are no wider than the blur, so that it seems smaller


def test_too_dark_and_too_bright() -> None:
    noise = 0.5 * np.random.default_rng(0).normal(size=(480, 640))
    dark = np.clip(image(BOARD) * 0.03 + noise, 0, 255).astype(np.uint8)
    (clue,) = clues(dark, BOARD, CAMERA, OPTIONS)
    assert (clue.about, clue.figure) == (About.DARK, pytest.approx(7.0, abs=1.0))
    bright = np.full((480, 640), 255, dtype=np.uint8)
    assert clues(bright, BOARD, CAMERA, OPTIONS) == [Clue(About.BRIGHT, figure=1.0)]


@pytest.mark.parametrize("ground", [0.03, 0.06])
def test_a_tag_without_its_white_margin(ground: float) -> None:
    modules = tag_modules(TAG.family, TAG.id)
    picture = np.pad(np.kron(modules, np.ones((16, 16))), 400, constant_values=ground)
    gray = render(CAMERA, [(Print(picture, TAG.size_m / len(modules) / 16), HERE)])
    assert of(gray, TAG) == [(About.MARGIN, None)]


@pytest.mark.parametrize("target", [BOARD, GRID, TAG, APRILGRID, CHARUCO])
def test_where_nothing_is_there_nothing_is_said(target: Target) -> None:
    assert of(render(CAMERA, []), target) == []
    assert clues(image(target), target, CAMERA, OPTIONS, lambda: True) == []  # no time to try anything


def step(blur_px: float, noise: float = 2.0) -> np.ndarray:
    """A slanted edge from 40 to 200, blurred."""
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    sharp = np.where(x + 0.3 * y > 190.0, 200.0, 40.0)
    soft = cv2.GaussianBlur(sharp, (0, 0), blur_px) if blur_px else sharp
    noisy = soft + noise * np.random.default_rng(0).normal(size=soft.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("blur_px", [1.0, 2.0, 3.0, 5.0])
def test_the_blur_of_an_edge(blur_px: float) -> None:
    assert edge_blur_px(step(blur_px)) == pytest.approx(blur_px, rel=0.2)


def test_images_without_edges_have_no_blur() -> None:
    assert np.isnan(edge_blur_px(np.full((240, 320), 90, np.uint8)))
    assert edge_blur_px(step(0.0)) < 0.8


@pytest.mark.parametrize("camera", [BARREL, FISHEYE])
@pytest.mark.parametrize("scale", [0.5, 2.0, 0.37])
def test_a_resized_image_has_its_camera(camera: Camera, scale: float) -> None:
    gray, of_it = resized(np.zeros((240, 320), np.uint8), camera, scale)
    assert gray.shape == (of_it.height, of_it.width)
    points = np.array([[0.1, 0.05, 1.0], [-0.2, 0.1, 1.0], [0.0, 0.0, 1.0]])
    factor = np.array([of_it.width / 320, of_it.height / 240])
    np.testing.assert_allclose(of_it.project(points) + 0.5, (camera.project(points) + 0.5) * factor, atol=1e-9)


def squares(way_px: int, defocus_px: float) -> np.ndarray:
    """A turned checkerboard that moved along x while the shutter was open, out of focus."""
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    u, v = 0.8 * x + 0.6 * y, -0.6 * x + 0.8 * y
    sharp = np.where((u // 31 + v // 31) % 2 == 0, 200.0, 40.0) + 30.0 * (np.sin(x / 9.0) > 0.0) + 30.0 * (y % 60 > 30)
    moved = cv2.filter2D(sharp, -1, np.full((1, way_px), 1.0 / way_px))
    noisy = cv2.GaussianBlur(moved, (0, 0), defocus_px) + 2.0 * np.random.default_rng(0).normal(size=moved.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("way_px", "defocus_px", "is_motion"), [(1, 0.8, False), (1, 2.0, False), (9, 0.8, True)])
def test_motion_blurs_edges_across_its_way_only(way_px: int, defocus_px: float, is_motion: bool) -> None:
    wide_px, narrow_px = motion_blur_px(squares(way_px, defocus_px))
    assert (wide_px > 1.5 * narrow_px) is is_motion
    assert 0.4 < narrow_px < 1.6


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
