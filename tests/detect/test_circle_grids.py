"""Grids of circles: real and rendered ones are read the right way up, to hundredths of a pixel; wrong ones are not."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered import BARREL, circles, pose, printed, projected, render

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import CORNERS, AprilGrid, Checkerboard, CircleGrid, Target
from gtsam_rwhec.detect.circle_grids import find_circle_grid
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.detect.detector import Detector

NOMINAL = Camera.of(640, 480, "", [[550.0, 0.0, 320.0], [0.0, 550.0, 240.0], [0.0, 0.0, 1.0]], (), "test")
LONG = Camera.of(640, 480, "", [[600.0, 0.0, 319.5], [0.0, 600.0, 239.5], [0.0, 0.0, 1.0]], (), "test")
GRID = CircleGrid("grid", 7, 5, 0.025, True)
PRINTED = CircleGrid("grid", 10, 10, 0.0254, True)
FRONT = pose((20.0, -15.0, 12.0), (0.0, 0.0, 0.33))


def image_of(folder: Path, name: str) -> np.ndarray:
    image = cv2.imread(str(folder / "images" / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return image


def rejection_of(image: np.ndarray, board: CircleGrid, camera: Camera = LONG) -> Rejection | None:
    found = find_circle_grid(image, board, camera)
    assert found is not None
    return found.rejection


def test_all_grids_before_a_wrist_are_read_the_right_way_up(circle_grid_10x10: Path) -> None:
    detector = Detector(NOMINAL, [PRINTED])
    for number in range(15):
        image = image_of(circle_grid_10x10, str(number))
        (detection,) = detector([image])[0].detections
        assert detection.rejection is None, number
        assert len(detection.indices) >= 95
        # The larger dot is the darkest of the circles in the blurred image, and is circle 90: lower left.
        blurred = cv2.GaussianBlur(255.0 - image, (0, 0), 4.0)
        places = np.rint(projected(NOMINAL, PRINTED.corners(), detection.T[0])).astype(int)
        assert np.argmax(blurred[places[:, 1], places[:, 0]]) == 90, number


@pytest.mark.parametrize(("columns", "rows"), [(9, 10), (10, 9), (9, 9)])
@pytest.mark.parametrize("dot", [False, True])
def test_a_real_grid_is_not_read_as_one_of_another_size(
    circle_grid_10x10: Path, columns: int, rows: int, dot: bool
) -> None:
    for name in ("0", "6"):
        found = find_circle_grid(
            image_of(circle_grid_10x10, name), CircleGrid("grid", columns, rows, 0.0254, dot), NOMINAL
        )
        assert found is None or found.rejection is not None


@pytest.mark.parametrize("light", [False, True])
@pytest.mark.parametrize("camera", [LONG, BARREL], ids=["pinhole", "radtan"])
def test_centres_are_those_of_the_circles_and_not_of_their_images(camera: Camera, light: bool) -> None:
    errors = []
    for seed, (tilt, turn) in enumerate([(55.0, 20.0), (-45.0, 130.0), (30.0, -100.0)]):
        T = pose((tilt, 10.0, turn), (0.01, 0.0, 0.3))
        image = render(camera, [(circles(GRID, light=light), T)], blur_px=1.0, seed=seed)
        found = find_circle_grid(image, GRID, camera)
        assert found is not None
        assert found.rejection is None
        errors.append(found.corners_px - projected(camera, GRID.corners(), T)[found.indices])
    off = np.concatenate(errors)
    assert np.sqrt((off**2).mean()) < 0.03
    assert np.abs(off.mean(axis=0)).max() < 0.01


@pytest.mark.parametrize("corner", CORNERS)
@pytest.mark.parametrize("columns", [5, 7])
def test_the_larger_dot_says_which_way_up(corner: str, columns: int) -> None:
    board = CircleGrid("grid", columns, 5, 0.025, corner)
    for turn in (-100.0, 10.0, 170.0):
        T = pose((20.0, -15.0, turn), (0.0, 0.0, 0.33))
        found = find_circle_grid(render(LONG, [(circles(board), T)]), board, LONG)
        assert found is not None
        assert found.rejection is None
        assert np.abs(found.corners_px - projected(LONG, board.corners(), T)[found.indices]).max() < 0.1


@pytest.mark.parametrize(("columns", "rows", "light"), [(4, 11, False), (4, 7, True), (3, 6, False)])
def test_asymmetric_grids_are_opencvs(columns: int, rows: int, light: bool) -> None:
    board = CircleGrid("grid", columns, rows, 0.02, asymmetric=True)
    for camera, angles in ((LONG, (10.0, 15.0, 5.0)), (LONG, (-20.0, 60.0, 110.0)), (BARREL, (50.0, 10.0, -140.0))):
        T = pose(angles, (0.0, 0.0, 0.45))
        image = render(camera, [(circles(board, light=light), T)])
        found = find_circle_grid(image, board, camera)
        assert found is not None
        assert found.rejection is None
        truth = projected(camera, board.corners(), T)
        if board.ways == 2 and np.abs(found.corners_px[0] - truth[found.indices[0]]).max() > 1.0:
            truth = truth[::-1]  # half a turn
        assert np.abs(found.corners_px - truth[found.indices]).max() < 0.15
        if camera is LONG and angles[0] > 0.0 and rows == 11:  # OpenCV orders an upright grid as we do
            is_found, theirs = cv2.findCirclesGrid(image, (columns, rows), flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
            assert is_found
            assert np.abs(theirs.reshape(-1, 2) - truth).max() < 1.0


@pytest.mark.parametrize(("columns", "rows"), [(4, 11), (5, 6), (3, 3)])
def test_asymmetric_grids_of_another_size_are_not_read(columns: int, rows: int) -> None:
    board = CircleGrid("grid", columns, rows, 0.02, asymmetric=True)
    image = render(LONG, [(circles(board), pose((20.0, -15.0, 12.0), (0.0, 0.0, 0.45)))])
    assert rejection_of(image, board) is None
    for other in ((columns - 1, rows), (columns, rows - 1), (columns + 1, rows), (columns, rows + 1), (rows, columns)):
        if min(other) >= 3 and other != (columns, rows):
            found = find_circle_grid(image, CircleGrid("grid", *other, 0.02, asymmetric=True), LONG)
            assert found is None or found.rejection is not None, other
    found = find_circle_grid(image, CircleGrid("grid", 4, 5, 0.02), LONG)
    assert found is None or found.rejection is not None


def test_circles_at_a_shadows_edge_do_not_count() -> None:
    board = CircleGrid("grid", 7, 5, 0.025)
    image = render(LONG, [(circles(board), FRONT)]).astype(float)
    light = 1.0 - 0.5 / (1.0 + np.exp(-(np.arange(640) - 330.0) / 5.0))
    found = find_circle_grid(np.rint(image * light).astype(np.uint8), board, LONG)
    assert found is not None
    assert found.rejection is None
    assert 21 <= len(found.indices) < 35
    truth = projected(LONG, board.corners(), FRONT)
    turned = found.corners_px - truth[::-1][found.indices]
    assert min(np.abs(found.corners_px - truth[found.indices]).max(), np.abs(turned).max()) < 0.15


def test_a_larger_dot_elsewhere_or_none_is_said() -> None:
    plain = CircleGrid("grid", 7, 5, 0.025)
    dotted, bare = render(LONG, [(circles(GRID), FRONT)]), render(LONG, [(circles(plain), FRONT)])
    assert rejection_of(bare, plain) is None
    assert rejection_of(bare, GRID) is Rejection.CIRCLES
    assert rejection_of(dotted, plain) is Rejection.CIRCLES
    # In a grid of 7 x 5 half a turn takes the lower left corner to the upper right one, and never to the lower right.
    assert rejection_of(dotted, CircleGrid("grid", 7, 5, 0.025, "lower_right")) is Rejection.CIRCLES
    assert rejection_of(render(LONG, [(circles(GRID, at=(2, 3)), FRONT)]), GRID) is Rejection.CIRCLES


def test_a_grid_that_goes_on_is_of_another_size() -> None:
    image = render(LONG, [(circles(CircleGrid("grid", 7, 6, 0.025)), FRONT)])
    found = find_circle_grid(image, CircleGrid("grid", 7, 5, 0.025), LONG)
    assert found is None or found.rejection is Rejection.OTHER_SIZE


def test_a_covered_circle_is_not_made_up() -> None:
    corner = np.rint(projected(LONG, GRID.corners(), FRONT)[17]).astype(int)
    covered = (slice(corner[1] - 12, corner[1] + 12), slice(corner[0] - 12, corner[0] + 12))
    image = render(LONG, [(circles(GRID), FRONT)])
    image[covered] = 220
    found = find_circle_grid(image, GRID, LONG)
    assert found is None or found.rejection is not None


def test_large_images_are_searched_at_half_their_size() -> None:
    camera = Camera.of(1280, 960, "", [[1200.0, 0.0, 639.5], [0.0, 1200.0, 479.5], [0.0, 0.0, 1.0]], (), "test")
    found = find_circle_grid(render(camera, [(circles(GRID), FRONT)], blur_px=1.0), GRID, camera)
    assert found is not None
    assert found.rejection is None
    assert np.abs(found.corners_px - projected(camera, GRID.corners(), FRONT)[found.indices]).max() < 0.1


@pytest.mark.parametrize("target", [Checkerboard("c", 5, 4, 0.03), AprilGrid("a", "tag36h11", 3, 3, 0.03, 0.3)])
def test_squares_are_no_circles(target: Target) -> None:
    others = [CircleGrid("g", 3, 3, 0.03), CircleGrid("g", 3, 3, 0.03, asymmetric=True), CircleGrid("g", 4, 3, 0.03)]
    for turn in (0.0, 20.0):
        image = render(LONG, [(printed(target), pose((turn, -turn, 2.0 * turn), (0.0, 0.0, 0.33)))])
        for other in others:
            found = find_circle_grid(image, other, LONG)
            assert found is None or found.rejection is not None


def test_images_without_a_grid() -> None:
    for shape in ((480, 640), (5, 5), (1, 1)):
        assert find_circle_grid(np.full(shape, 128, np.uint8), GRID, LONG) is None
    noise = np.random.default_rng(0).integers(0, 256, (480, 640), dtype=np.uint8)
    found = find_circle_grid(cv2.GaussianBlur(noise, (0, 0), 2.0), GRID, LONG)
    assert found is None or found.rejection is not None
