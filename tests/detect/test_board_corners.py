"""Boards' corners against their true places, for turned boards and tags and all lenses; other grids are rejected."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from rendered import BARREL, FISHEYE, OMNI, PINHOLE, Print, pose, printed, projected, render

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import AprilGrid, Charuco, Checkerboard, Target
from gtsam_rwhec.detect import board_corners as boards
from gtsam_rwhec.detect.board_evidence import evidence
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.detect.detector import Detection, Detector

BOARD = Charuco("board", "aruco_5x5_100", 6, 4, 0.03, 0.0225, first_id=7)
GRID = AprilGrid("grid", "tag36h11", 3, 2, 0.05, 0.3, first_id=11)
CHESS = Checkerboard("chess", 5, 4, 0.03)
CAMERAS = pytest.mark.parametrize(
    ("camera", "far"),
    [(PINHOLE, 0.30), (BARREL, 0.27), (FISHEYE, 0.18), (OMNI, 0.18)],
    ids=["pinhole", "barrel", "fisheye", "omni"],
)
TURNS = (-170.0, -100.0, -35.0, 10.0, 80.0, 155.0)


def the_detection(camera: Camera, target: Target, image: np.ndarray) -> Detection:
    (seen,) = Detector(camera, [target])([image])
    (detection,) = seen.detections
    return detection


@pytest.mark.parametrize("blur_px", [0.5, 1.0])
@CAMERAS
@pytest.mark.parametrize("target", [BOARD, GRID, CHESS], ids=lambda target: target.name)
def test_corners_are_at_their_true_places(target: Target, camera: Camera, far: float, blur_px: float) -> None:
    generator, picture, errors = np.random.default_rng(3), printed(target), []
    for turn in TURNS[::2]:
        T = pose((*generator.uniform(-25, 25, 2), turn), (*generator.uniform(-0.01, 0.01, 2), far))
        detection = the_detection(camera, target, render(camera, [(picture, T)], blur_px=blur_px))
        # Of the fisheye's small markers not all are read.
        assert len(detection.indices) >= (4 if target is BOARD else 16)
        errors.append(detection.corners_px - projected(camera, target.corners(), T)[detection.indices])
    off = np.concatenate(errors)
    assert np.abs(off).max() < (0.25 if target is BOARD else 0.15)
    assert np.sqrt((off**2).mean()) < (0.07 if target is BOARD else 0.05)
    np.testing.assert_allclose(off.mean(axis=0), 0.0, atol=4.0 * off.std() / np.sqrt(len(off)))


def test_blur_does_not_move_the_corners_of_boards() -> None:
    for target in (GRID, CHESS):
        T = pose((15.0, -10.0, 30.0), (0.0, 0.0, 0.3))
        detection = the_detection(PINHOLE, target, render(PINHOLE, [(printed(target), T)], blur_px=2.0))
        off = detection.corners_px - projected(PINHOLE, target.corners(), T)[detection.indices]
        assert np.sqrt((off**2).mean()) < 0.05


@pytest.mark.parametrize("quarter_turns", range(4))
@CAMERAS
def test_aprilgrids_tags_may_be_turned(camera: Camera, far: float, quarter_turns: int) -> None:
    # Kalibr's PDFs have them turned against OpenCV's; other generators not.
    T = pose((10.0, 20.0, -70.0), (0.005, 0.0, far))
    # Hardly blurred: contours of the squares that touch merge, and OpenCV's corners are pixels off.
    image = render(camera, [(printed(GRID, quarter_turns=quarter_turns), T)], blur_px=0.4)
    detection = the_detection(camera, GRID, image)
    assert len(detection.indices) >= 16
    off = detection.corners_px - projected(camera, GRID.corners(), T)[detection.indices]
    assert np.abs(off).max() < 0.15


def test_only_covered_corners_of_boards_are_missing() -> None:
    T = pose((10.0, -15.0, 5.0), (0.0, 0.0, 0.3))
    for target in (BOARD, GRID):
        covered = np.s_[100:, 200:]
        image = render(PINHOLE, [(printed(target), T)], covered=covered)
        detection = the_detection(PINHOLE, target, image)
        truth = projected(PINHOLE, target.corners(), T)
        hidden = (truth[:, 0] > 197) & (truth[:, 1] > 97)
        assert 5 <= len(detection.indices) < len(truth)
        assert not hidden[detection.indices].any()
        assert np.abs(detection.corners_px - truth[detection.indices]).max() < 0.2


def test_wrong_corners_are_left_out() -> None:
    for camera in (PINHOLE, BARREL, FISHEYE):
        T = pose((20.0, -30.0, 40.0), (0.0, 0.0, 0.25))
        corners = projected(camera, BOARD.corners(), T) + np.random.default_rng(0).normal(scale=0.1, size=(15, 2))
        corners[3] += [3.0, 0.0]
        corners[11] += [-4.0, 9.0]
        kept = boards.on_one_plane(camera, BOARD.corners(), corners)
        assert np.flatnonzero(~kept).tolist() == [3, 11]


def test_an_image_without_a_board_has_no_corners() -> None:
    empty = render(PINHOLE, [])
    for target in (BOARD, GRID, CHESS):
        (seen,) = Detector(PINHOLE, [target])([empty])
        assert seen.detections == ()
        assert seen.strangers == {}


def test_the_rendered_board_is_the_board_that_opencv_draws() -> None:
    # The AprilGrid that the tests draw is decoded by OpenCV with two border bits, with its ids where Kalibr has them.
    picture: Print = printed(GRID)
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = 2
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    gray = np.rint(255 * cv2.GaussianBlur(picture.picture, (0, 0), 1.0)).astype(np.uint8)
    corners, ids, _ = cv2.aruco.ArucoDetector(tags, parameters).detectMarkers(gray)
    middle = {int(i): np.reshape(c, (4, 2)).mean(axis=0) for i, c in zip(ids.ravel(), corners, strict=True)}
    assert sorted(middle) == list(GRID.ids)
    expected = GRID.corners().reshape(-1, 4, 3).mean(axis=1)
    for number, place in middle.items():
        u, v = (place - 0.5 * np.array(picture.picture.shape[::-1])) * picture.pixel_m
        np.testing.assert_allclose([u, -v], expected[number - 11, :2], atol=1e-3)


T = pose((15.0, -20.0, 10.0), (0.0, 0.0, 0.33))
#: Small, since rays through a lens take time.
SMALL_BARREL = Camera.of(
    160, 120, "plumb_bob", [[140.0, 0.0, 79.0], [0.0, 139.0, 60.5], [0.0, 0.0, 1.0]], (-0.28, 0.09), "test"
)
SMALL_CAMERAS = pytest.mark.parametrize("camera", [PINHOLE, SMALL_BARREL], ids=["pinhole", "barrel"])


def grid_of(camera: Camera, columns_off: int = 0, rows_off: int = 0) -> np.ndarray:
    """Corners of the board, or of one that is whole squares beside it."""
    corners = CHESS.corners() + 0.03 * np.array([columns_off, -rows_off, 0.0])
    return projected(camera, corners, T).reshape(4, 5, 2)


@SMALL_CAMERAS
def test_the_boards_corners_pass(camera: Camera) -> None:
    image = render(camera, [(printed(CHESS), T)])
    seen = evidence(image, grid_of(camera), camera)
    assert (seen.rejection, seen.first_is_dark) == (None, True)
    turned = evidence(image, grid_of(camera)[::-1, ::-1], camera)
    assert (turned.rejection, turned.first_is_dark) == (None, False)


@SMALL_CAMERAS
@pytest.mark.parametrize("off", [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (2, 0)], ids=str)
def test_a_board_whole_squares_off_is_rejected(camera: Camera, off: tuple[int, int]) -> None:
    image = render(camera, [(printed(CHESS), T)])
    assert evidence(image, grid_of(camera, *off), camera).rejection is Rejection.SQUARES


def test_a_thin_margin_does_not_hide_that_a_board_is_one_square_off() -> None:
    whole = printed(CHESS)
    thin = type(whole)(whole.picture[35:-35, 35:-35], whole.pixel_m)
    image = render(PINHOLE, [(thin, T)])
    assert evidence(image, grid_of(PINHOLE), PINHOLE).rejection is None
    for off in ((1, 0), (0, -1)):
        assert evidence(image, grid_of(PINHOLE, *off), PINHOLE).rejection is Rejection.SQUARES


def test_a_part_of_a_larger_board_is_rejected() -> None:
    image = render(PINHOLE, [(printed(Checkerboard("larger", 7, 4, 0.03)), T)])
    assert evidence(image, grid_of(PINHOLE), PINHOLE).rejection is Rejection.OTHER_SIZE


def test_wrong_corners_do_not_count_and_many_are_no_grid() -> None:
    image, grid = render(PINHOLE, [(printed(CHESS), T)]), grid_of(PINHOLE)
    grid[1, 2] += [1.0, 0.0]
    grid[3, 0] += [0.0, -2.0]
    seen = evidence(image, grid, PINHOLE)
    assert seen.rejection is None
    assert np.argwhere(~seen.kept).tolist() == [[1, 2], [3, 0]]
    off_board = grid_of(PINHOLE)
    off_board[0] -= [0.0, 3.0]
    assert evidence(image, off_board, PINHOLE).rejection is Rejection.NOT_A_GRID
    grid[:2, :3] += [3.0, 0.0]
    assert evidence(image, grid, PINHOLE).rejection is Rejection.NOT_A_GRID
    grid[:] = 7.0
    assert evidence(image, grid, PINHOLE).rejection is Rejection.NOT_A_GRID


def test_a_board_at_the_images_edge_is_rejected_where_its_outer_squares_are_not_in_it() -> None:
    near = pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.14))
    grid = projected(PINHOLE, CHESS.corners(), near).reshape(4, 5, 2)
    assert PINHOLE.inside(grid).all()
    image = render(PINHOLE, [(printed(CHESS), near)])
    assert evidence(image, grid, PINHOLE).rejection is Rejection.NOT_WHOLE


@pytest.mark.parametrize("value", [0, 128, 255])
def test_a_flat_patch_is_no_board(value: int) -> None:
    # The contrast of its squares is 0 / 0.
    flat = np.full((240, 320), value, np.uint8)
    assert evidence(flat, grid_of(PINHOLE), PINHOLE).rejection is Rejection.SQUARES


def test_shade_on_a_half_does_not_reject() -> None:
    image = render(PINHOLE, [(printed(CHESS), T)]).astype(float)
    image[:, :160] *= 0.25
    assert evidence(image.astype(np.uint8), grid_of(PINHOLE), PINHOLE).rejection is None
