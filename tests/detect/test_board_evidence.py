"""A grid of corners that is not the board's is rejected with its reason; the board's own is not."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import PINHOLE, pose, printed, projected, render

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.detect.board_evidence import evidence
from gtsam_rwhec.detect.detections import Rejection

CHESS = Checkerboard("chess", 5, 4, 0.03)
T = pose((15.0, -20.0, 10.0), (0.0, 0.0, 0.33))
#: Small, since rays through a lens take time.
BARREL = Camera.of(
    160, 120, "plumb_bob", [[140.0, 0.0, 79.0], [0.0, 139.0, 60.5], [0.0, 0.0, 1.0]], (-0.28, 0.09), "test"
)
CAMERAS = pytest.mark.parametrize("camera", [PINHOLE, BARREL], ids=["pinhole", "barrel"])


def grid_of(camera: Camera, columns_off: int = 0, rows_off: int = 0) -> np.ndarray:
    """Corners of the board, or of one that is whole squares beside it."""
    corners = CHESS.corners() + 0.03 * np.array([columns_off, -rows_off, 0.0])
    return projected(camera, corners, T).reshape(4, 5, 2)


@CAMERAS
def test_the_boards_corners_pass(camera: Camera) -> None:
    image = render(camera, [(printed(CHESS), T)])
    seen = evidence(image, grid_of(camera), camera)
    assert (seen.rejection, seen.first_is_dark) == (None, True)
    turned = evidence(image, grid_of(camera)[::-1, ::-1], camera)
    assert (turned.rejection, turned.first_is_dark) == (None, False)


@CAMERAS
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
