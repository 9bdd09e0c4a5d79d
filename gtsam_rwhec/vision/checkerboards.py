"""Checkerboards: found by OpenCV's two detectors where saddles show that one may be, tested, and measured.

OpenCV's classic detector with its fast check is asked first, its sector-based one (Duda and Frese 2018) where the
classic one sees nothing or what it sees fails the test (`board_evidence`). On the 39 images of a workcell the first
reads all 34 boards at a tenth of the second's time; the second reads more where blur or shade is strong.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.board_evidence import evidence, smallest_step
from gtsam_rwhec.vision.boards import refined_corners
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.images import Gray
from gtsam_rwhec.vision.rejection import Rejection
from gtsam_rwhec.vision.saddles import regions
from gtsam_rwhec.vision.targets import Checkerboard

#: The half window at a corner is this share of the distance between neighbouring lines of corners, at most 9 pixels.
OF_SQUARE = 0.4
#: Images are halved this often before saddles are looked for: sharp corners first, blurred ones in what is smaller.
LEVELS = (1, 2)
#: At most this number of regions of an image are searched.
MOST_REGIONS = 3

#: Asks for corners (rows, columns, 2) in a region, or None.
_Finder: TypeAlias = Callable[[Gray, Checkerboard], "Array | None"]


@dataclass(frozen=True, eq=False)
class FoundCheckerboard:
    """Corners of a checkerboard (columns rows, 2), left to right from the top, and why they are not used, if so."""

    corners_px: Array
    rejection: Rejection | None


def find_checkerboard(gray: Gray, board: Checkerboard, camera: Camera | None = None) -> FoundCheckerboard | None:
    """Find a board that is whole in the image; None where there is none.

    The top is where the first corner's outer square is black; a board of two even or two odd numbers of corners looks
    the same turned by half a turn, and is read in one of these ways.
    """
    rejected: FoundCheckerboard | None = None
    for grid in _candidates(gray, board):
        found = _tested(gray, grid, camera)
        if found.rejection is None:
            return found
        rejected = rejected or found
    return rejected


def _candidates(gray: Gray, board: Checkerboard) -> Iterator[Array]:
    """Grids of corners (rows, columns, 2) that OpenCV finds, in the order in which they are asked for."""
    for level in LEVELS:
        for region in regions(gray, board.columns * board.rows, level)[:MOST_REGIONS]:
            part = np.ascontiguousarray(gray[region])
            corner = np.array([region[1].start, region[0].start], dtype=float)
            for finder in (_classic, _sector_based):
                grid = finder(part, board)
                if grid is not None:
                    yield grid + corner


def _classic(gray: Gray, board: Checkerboard) -> Array | None:
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(gray, (board.columns, board.rows), flags=flags)
    return np.reshape(corners, (board.rows, board.columns, 2)).astype(float) if found else None


def _sector_based(gray: Gray, board: Checkerboard) -> Array | None:
    found, corners = cv2.findChessboardCornersSB(gray, (board.columns, board.rows), flags=0)
    return np.reshape(corners, (board.rows, board.columns, 2)).astype(float) if found else None


def _tested(gray: Gray, grid: Array, camera: Camera | None) -> FoundCheckerboard:
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0.0:  # a mirror image: a board is not seen from behind
        grid = grid[::-1]
    half = int(np.clip(OF_SQUARE * smallest_step(grid), 2, 9))
    grid = refined_corners(gray, grid.reshape(-1, 2), half).reshape(grid.shape)
    seen = evidence(gray, grid, camera)
    if not seen.first_is_dark:
        grid = _other_colour(grid)
    return FoundCheckerboard(grid.reshape(-1, 2), seen.rejection)


def _other_colour(grid: Array) -> Array:
    """The grid turned so that its first corner is at a square of the other colour, where a turn does so."""
    rows, columns = grid.shape[:2]
    if (rows + columns) % 2 == 1:
        return grid[::-1, ::-1]
    if rows == columns and rows % 2 == 1:
        return np.rot90(grid)
    return grid
