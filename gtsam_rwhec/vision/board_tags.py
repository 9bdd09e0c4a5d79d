"""The tags of one board in one image: those that are where the board says; or why the board is not the stated one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TypeAlias

import cv2
import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.dictionaries import dictionary
from gtsam_rwhec.vision.layout_cures import layout_that_fits
from gtsam_rwhec.vision.tag_agreement import agreeing, agreeing_in_space, largest_off, plane_coordinates, spans_a_plane
from gtsam_rwhec.vision.tag_boards import Bundle, TagGrid
from gtsam_rwhec.vision.targets import AprilGrid, Charuco

#: Boards whose corners come from several tags.
TagBoard: TypeAlias = Charuco | AprilGrid | TagGrid | Bundle
#: At most this share of a board's tags, or one of three and more, may be elsewhere: they do not count. Where more are,
#: the board is another.
MOST_ELSEWHERE = 0.25


@dataclass(frozen=True, eq=False)
class BoardTags:
    """Tags of a board in an image.

    Attributes
    ----------
    ids : (m,) integers
    corners_px : (m, 4, 2) array
        In the order of the board's own corners, right to about a pixel.
    contradicted : bool
        The tags are not where the board says: none may be used.
    note : str
        What the rig file would have to say instead, as far as it is known.
    is_legacy : bool
        Whether a ChArUco board has the pattern of OpenCV before 4.6.
    """

    ids: np.ndarray
    corners_px: Array
    contradicted: bool = False
    note: str = ""
    is_legacy: bool = False


@cache
def charuco_board(board: Charuco, is_legacy: bool = False) -> cv2.aruco.CharucoBoard:
    """OpenCV's board. Boards with an even number of rows were printed with another phase before OpenCV 4.6."""
    made = cv2.aruco.CharucoBoard(
        (board.columns, board.rows),
        board.square_m,
        board.marker_m,
        dictionary(board.family),
        np.array(board.ids, dtype=np.int32),
    )
    made.setLegacyPattern(is_legacy)
    return made


@cache
def tag_places(board: TagBoard, is_legacy: bool = False) -> Array:
    """Corners (n, 4, 3) of a board's tags in its frame, in the order of its ids, metres."""
    if isinstance(board, Charuco):
        # OpenCV's origin is the outer corner at the top left, y is down.
        places = np.array(charuco_board(board, is_legacy).getObjPoints(), dtype=float).reshape(-1, 4, 3)
        outer = 0.5 * board.square_m * np.array([-board.columns, board.rows, 0.0])
        return np.asarray(places * [1.0, -1.0, 0.0] + outer)
    return board.corners().reshape(-1, 4, 3)


def tags_of_board(board: TagBoard, ids: np.ndarray, corners_px: Array, camera: Camera) -> BoardTags:
    """Test tags (m,) of a board, seen at (m, 4, 2); the returned ones agree, unless the board is contradicted."""
    x = camera.undistort(corners_px)
    focal = camera.focal_px
    number = {i: k for k, i in enumerate(board.ids)}
    of_board = np.array([number[int(i)] for i in ids], dtype=int)
    is_legacy = False
    if isinstance(board, AprilGrid):
        turn = _quarter_turns(tag_places(board)[of_board], x * focal)
        corners_px, x = np.roll(corners_px, turn, axis=1), np.roll(x, turn, axis=1)
    agrees = _agrees(board, of_board, x, focal, False)
    if isinstance(board, Charuco) and board.rows % 2 == 0 and not agrees.all():
        as_before = _agrees(board, of_board, x, focal, True)
        if as_before.sum() > agrees.sum():
            agrees, is_legacy = as_before, True
    if not agrees.all():
        # Tags of one row agree in another layout too.
        elsewhere = len(agrees) - int(agrees.sum())
        note = "" if isinstance(board, Bundle) else layout_that_fits(board, ids, x * focal)
        few = not (isinstance(board, Bundle) or spans_a_plane(tag_places(board, is_legacy)[of_board[agrees], :, :2]))
        if note or few or agrees.sum() < 2 or elsewhere > max(1.0, MOST_ELSEWHERE * len(agrees)):
            return BoardTags(ids, corners_px, True, note)
    once = np.array([np.sum(ids[agrees] == i) == 1 for i in ids], dtype=bool)
    kept = agrees & once
    return BoardTags(ids[kept], corners_px[kept], is_legacy=is_legacy)


def _agrees(board: TagBoard, of_board: np.ndarray, x: Array, focal: float, is_legacy: bool) -> np.ndarray:
    places = tag_places(board, is_legacy)[of_board]
    if isinstance(board, Bundle) and len(places) > 1 and plane_coordinates(places) is None:
        return agreeing_in_space(places, x, largest_off(x * focal) / focal)
    return agreeing(places, x * focal)


def _quarter_turns(places: Array, flat: Array) -> int:
    """By how many corners the tags of a grid are turned in their places: generators print them differently."""
    if not np.isfinite(flat).all():
        return 0
    errors = []
    for turn in range(4):
        turned = np.roll(flat, turn, axis=1)
        H, _ = cv2.findHomography(places[..., :2].reshape(-1, 2), turned.reshape(-1, 2), 0)
        if H is None:
            return 0
        predicted = cv2.perspectiveTransform(places[..., :2].reshape(-1, 1, 2), H).reshape(flat.shape)
        errors.append(float(np.median(np.linalg.norm(predicted - turned, axis=2).max(axis=1))))
    return int(np.argmin(errors))
