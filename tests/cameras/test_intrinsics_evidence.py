"""Corners of boards against stated intrinsics: right ones are not accused, nor on bent boards; wrong ones are named."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered import pose, projected

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.intrinsics_evidence import View, evidence_of_intrinsics
from gtsam_rwhec.cameras.targets import Checkerboard, CircleGrid
from gtsam_rwhec.detect.detector import Detector

K = np.array([[520.0, 0.0, 322.0], [0.0, 520.0, 231.0], [0.0, 0.0, 1.0]])
TRUE = Camera.of(640, 480, "", K.tolist(), (), "test")
LENS = Camera.of(640, 480, "plumb_bob", K.tolist(), (-0.25, 0.09, 8e-4, -5e-4), "test")
GRID, SMALL = CircleGrid("grid", 10, 10, 0.02, True), Checkerboard("small", 3, 4, 0.05)
ROOM = Camera.of(
    1920, 1080, "", [[1371.02278154, 0.0, 960.5], [0.0, 1371.02278154, 540.5], [0.0, 0.0, 1.0]], (), "test"
)


def off(camera: Camera, *, share: float = 1.0, px: tuple[float, float] = (0.0, 0.0)) -> Camera:
    stated = camera.K.copy()
    stated[[0, 1], [0, 1]] *= share
    stated[:2, 2] += px
    return replace(camera, K=stated)


def views(
    camera: Camera, board: CircleGrid | Checkerboard, n: int, seed: int, *, bent_m: float = 0.0, corner_px: float = 0.1
) -> list[View]:
    """Views of a board, turned by up to 35 degrees, that is bent about its y axis."""
    random = np.random.default_rng(seed)
    corners = board.corners()
    bent = corners.copy()
    bent[:, 2] = bent_m * (1.0 - (corners[:, 0] / np.abs(corners[:, 0]).max()) ** 2)

    def some() -> Iterator[View]:
        while True:
            d = random.uniform(0.4, 0.8)
            a, b = random.uniform(-25.0, 25.0, 2)
            T = pose((a, b, random.uniform(-180.0, 180.0)), (0.0, 0.0, d))
            T[:2, 3] = d * random.uniform([-0.3, -0.2], [0.3, 0.2])
            pixels = projected(camera, bent, T)
            if camera.inside(pixels).all():
                yield View(corners, pixels + corner_px * random.normal(size=pixels.shape), T)

    made = some()
    return [next(made) for _ in range(n)]


@pytest.mark.parametrize("board", [GRID, SMALL], ids=lambda board: board.name)
@pytest.mark.parametrize("camera", [TRUE, LENS], ids=["pinhole", "radtan"])
def test_right_intrinsics_are_not_accused(camera: Camera, board: CircleGrid | Checkerboard) -> None:
    least = []
    for seed in range(15):
        found = evidence_of_intrinsics(camera, views(camera, board, 8 + 2 * seed, seed))
        assert found is not None
        assert not found.contradicts, seed
        assert 0.09 < found.fitted_px < 0.15
        least.append(found.probability)
    assert np.median(least) > 0.3  # they are probabilities, of two tests the larger one


@pytest.mark.parametrize("board", [GRID, SMALL], ids=lambda board: board.name)
@pytest.mark.parametrize("bent_m", [0.001, 0.003])
def test_a_bent_board_is_no_reason_to_accuse_a_camera(board: CircleGrid | Checkerboard, bent_m: float) -> None:
    for seed in range(8):
        found = evidence_of_intrinsics(TRUE, views(TRUE, board, 15, seed, bent_m=bent_m))
        assert found is not None
        assert found.stated_px > 0.17  # where right corners have 0.14
        assert not found.contradicts, seed


@pytest.mark.parametrize("board", [GRID, SMALL], ids=lambda board: board.name)
@pytest.mark.parametrize("camera", [TRUE, LENS], ids=["pinhole", "radtan"])
@pytest.mark.parametrize(
    ("share", "px"), [(1.06, (0.0, 0.0)), (1.3, (0.0, 0.0)), (0.5, (0.0, 0.0)), (1.0, (-20.0, 15.0))]
)
def test_wrong_intrinsics_are_named_with_what_fits(
    camera: Camera, board: CircleGrid | Checkerboard, share: float, px: tuple[float, float]
) -> None:
    found = evidence_of_intrinsics(off(camera, share=share, px=px), views(camera, board, 25, 1))
    assert found is not None
    assert found.contradicts
    assert found.is_far_off
    error = np.abs((found.fitted.K - camera.K)[[0, 1, 0, 1], [0, 1, 2, 2]])
    assert (error < 4.0 * found.sigma[:4] + 0.03 * abs(share - 1.0) * 520.0).all()
    assert found.fitted_px < found.stated_px


@pytest.mark.parametrize("board", [GRID, SMALL], ids=lambda board: board.name)
@pytest.mark.parametrize("stated", [(), (0.25, 0.09, 8e-4, -5e-4)], ids=["left out", "of the wrong sign"])
def test_a_wrong_distortion_is_named_with_what_fits(
    board: CircleGrid | Checkerboard, stated: tuple[float, ...]
) -> None:
    camera = Camera.of(640, 480, "plumb_bob", K.tolist(), stated, "test")
    found = evidence_of_intrinsics(camera, views(LENS, board, 25, 3))
    assert found is not None
    assert found.contradicts
    assert found.is_far_off
    assert np.abs(found.fitted.D[0] - LENS.D[0]) < 4.0 * found.sigma[4]


def test_intrinsics_of_another_resolution_are_named_with_what_fits() -> None:
    small = Camera.of(640, 480, "", (np.diag([2.0 / 3.0, 2.0 / 3.0, 1.0]) @ K).tolist(), (), "test")
    found = evidence_of_intrinsics(small, views(TRUE, SMALL, 25, 4))
    assert found is not None
    assert found.is_far_off
    assert found.contradicts
    assert np.abs(found.fitted.K[0, 0] - 520.0) < 4.0 * found.sigma[0]


def test_few_views_or_few_corners_say_nothing() -> None:
    some = views(TRUE, GRID, 8, 0)
    assert evidence_of_intrinsics(TRUE, some) is not None
    assert evidence_of_intrinsics(TRUE, some[:7]) is None
    assert evidence_of_intrinsics(TRUE, [View(v.corners_m[:4], v.corners_px[:4], v.T) for v in some]) is None


def test_a_camera_at_rest_has_one_view() -> None:
    one = views(TRUE, SMALL, 1, 0)
    assert evidence_of_intrinsics(off(TRUE, share=1.2), one * 50) is None
    found = evidence_of_intrinsics(TRUE, [view for view in views(TRUE, SMALL, 9, 0) for _ in range(3)])
    assert found is not None
    assert found.views == 9


def detected(folder: Path, pattern: str, camera: Camera, board: CircleGrid | Checkerboard) -> list[View]:
    detector = Detector(camera, [board])
    found = []
    for path in sorted(folder.glob(pattern)):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        found += [d for d in detector([image])[0].detections if d.rejection is None]
    return [View(board.corners()[d.indices], d.corners_px, d.T[0]) for d in found]


def test_a_nominal_camera_of_other_people(circle_grid_10x10: Path) -> None:
    # cv2.calibrateCamera over these grids: f = 521 to 542, cy = 211 to 226. Stated are 550 and 240.
    nominal = Camera.of(640, 480, "", [[550.0, 0.0, 320.0], [0.0, 550.0, 240.0], [0.0, 0.0, 1.0]], (), "test")
    board = CircleGrid("grid", 10, 10, 0.0254, True)
    found = evidence_of_intrinsics(nominal, detected(circle_grid_10x10, "images/*.png", nominal, board))
    assert found is not None
    assert found.views == 15
    assert found.contradicts
    assert found.is_far_off
    assert 510.0 < found.fitted.K[0, 0] < 545.0
    assert 200.0 < found.fitted.K[1, 2] < 230.0
    assert found.fitted_px < 0.3


def test_a_calibrated_camera_of_other_people(workcell_camera2: Path) -> None:
    # Its principal point is a pixel off, which the corners do not show.
    board = Checkerboard("board", 3, 4, 0.05)
    found = evidence_of_intrinsics(ROOM, detected(workcell_camera2, "image/*", ROOM, board))
    assert found is not None
    assert found.views == 34
    assert not found.contradicts
    assert found.stated_px < 0.07
