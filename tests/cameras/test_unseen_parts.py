"""Parts of a board that no image has are named where the images have their place, and not elsewhere."""

from __future__ import annotations

import numpy as np
from rendered import pose, projected

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.shape_evidence import BoardView, never_seen
from gtsam_rwhec.cameras.targets import Charuco, TagGrid, Target

CAMERA = Camera.of(640, 480, "", [[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]], (), "test")
BOARD = Charuco("board", "aruco_5x5_100", 7, 7, 0.03, 0.022)
TAGS = TagGrid("tags", "aruco_4x4_50", 3, 2, 0.03, 0.008)


def views(board: Target, seen: np.ndarray, away_m: float = 0.6, n: int = 6) -> list[BoardView]:
    corners = board.corners()
    poses = [pose((5.0 * i - 10.0, 8.0, 20.0 * i), (0.0, 0.0, away_m)) for i in range(n)]
    return [BoardView(seen, projected(CAMERA, corners[seen], T), T) for T in poses]


def test_rows_of_a_charuco_board_that_are_never_seen() -> None:
    assert never_seen(BOARD, CAMERA, views(BOARD, np.arange(36))) == ""
    words = "the lowest 2 rows of corners (if they are not there, write squares: [7, 5])"
    assert never_seen(BOARD, CAMERA, views(BOARD, np.arange(24))) == words
    left = np.arange(36)[np.arange(36) % 6 > 0]
    words = "the left 1 column of corners (if they are not there, write squares: [6, 7])"
    assert never_seen(BOARD, CAMERA, views(BOARD, left)) == words


def test_tags_that_are_never_seen() -> None:
    assert never_seen(TAGS, CAMERA, views(TAGS, np.arange(24))) == ""
    assert never_seen(TAGS, CAMERA, views(TAGS, np.arange(20))) == "tag 5"


def test_outside_the_images_or_in_few_of_them_nothing_is_missing() -> None:
    assert never_seen(BOARD, CAMERA, views(BOARD, np.arange(24), n=4)) == ""
    assert never_seen(BOARD, CAMERA, views(BOARD, np.arange(24), away_m=0.18)) == ""
    assert never_seen(TAGS, CAMERA, views(TAGS, np.arange(20), away_m=0.1)) == ""
