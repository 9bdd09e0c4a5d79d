"""What images say about a target that is not read: rendered images, each with one thing that is wrong."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from rendered import BARREL, FISHEYE, Print, pose, printed, render, tag_modules

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import AprilGrid, Charuco, Checkerboard, CircleGrid, Tag, Target
from gtsam_rwhec.detect.clues import About, Clue, clues, edge_blur_px, motion_blur_px, read, resized, tags_seen
from gtsam_rwhec.detect.detections import DetectionOptions
from gtsam_rwhec.detect.images import Gray

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
