"""Grids of circles: blobs that OpenCV orders into a grid, tested against the board, turned by its larger dot.

A grid with a wrong circle, one circle off, or of another size must not count. So every circle must be there and have
its size (one at a corner larger, if the board has a larger dot), all lie on one plane's grid but for a few that bent
paper or dirt moves and that do not count, and no row may go on beyond the board.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.board_evidence import FoundBoard, smallest_step
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.circle_centres import Circles, Plane, measured_circles
from gtsam_rwhec.vision.images import Gray
from gtsam_rwhec.vision.rejection import Rejection
from gtsam_rwhec.vision.targets import CircleGrid

#: Blobs have at least this area (pixels), and at most twice the share of the image that one of the circles can have.
LEAST_AREA_PX = 12.0
#: Images with a larger side than this are searched at half their size first.
LARGE_PX = 1000
#: A grid is looked for among at most this number of blobs for each circle; among more it would take seconds.
MOST_BLOBS = 4
#: A circle is off its place in the plane by at most this (pixels), or by `MOST_OFF` of the distance between lines.
MOST_OFF_PX, MOST_OFF = 0.5, 0.05
#: Blobs, not yet corrected for perspective, by at most this share of the distance between lines.
MOST_OFF_BLOB = 0.2
#: At least this share of the circles, and more than half of each row and column, must be at their places.
LEAST_KEPT = 0.9
#: A circle's radius is this share of the median at least, and at most one over it. The larger dot is larger than that.
SAME_SIZE = 0.75
#: A circle has at least this share of the median contrast.
LEAST_CONTRAST = 0.3
#: A row of circles goes on beyond the board if its circles have their size and this share of the median contrast.
GOES_ON = 0.5
#: Rounds in which the plane, the circles' sizes and the correction for perspective settle.
ROUNDS = 3


def find_circle_grid(gray: Gray, board: CircleGrid, camera: Camera) -> FoundBoard | None:
    """Find a grid that is whole in the image; None where there is none.

    Without a larger dot a grid looks the same turned (`CircleGrid.ways`), and is read in one of these ways.
    """
    rejected: FoundBoard | None = None
    for grid, diameters in _candidates(gray, board):
        found = _tested(gray, board, grid, diameters, camera)
        if found.rejection is None:
            return found
        rejected = rejected or found
    return rejected


def _candidates(gray: Gray, board: CircleGrid) -> Iterator[tuple[Array, Array]]:
    """Grids of blobs (rows, columns, 2) that OpenCV finds, with the blobs' diameters (rows, columns), pixels."""
    for halved in (True, False) if max(gray.shape) > LARGE_PX else (False,):
        picture = gray
        if halved:
            picture = np.asarray(cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
        for places, diameters in _blobs(picture, board):
            if not board.columns * board.rows <= len(places) <= MOST_BLOBS * board.columns * board.rows:
                continue
            for flags in (cv2.CALIB_CB_SYMMETRIC_GRID, cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING):
                found, centres = cv2.findCirclesGrid(  # type: ignore[call-overload]  # the stubs know no points without a blob detector
                    places.astype(np.float32)[:, None], (board.columns, board.rows), flags=flags, blobDetector=None,
                    parameters=cv2.CirclesGridFinderParameters(),
                )  # fmt: skip
                if not found:
                    continue
                grid = np.reshape(centres, (board.rows, board.columns, 2)).astype(float)
                apart = np.linalg.norm(grid[:, :, None] - places, axis=-1)
                which = np.argmin(apart, axis=-1)
                if len(np.unique(which)) == which.size:
                    grid, sizes = places[which], diameters[which]
                    # Pixel centres are at whole numbers: the first of the halved ones is at 1/2.
                    yield (2.0 * grid + 0.5, 2.0 * sizes) if halved else (grid, sizes)


def _blobs(gray: Gray, board: CircleGrid) -> Iterator[tuple[Array, Array]]:
    """Places (n, 2) and diameters (n,) of the dark blobs, then of the light ones."""
    wanted = cv2.SimpleBlobDetector_Params()  # type: ignore[attr-defined]
    wanted.minThreshold, wanted.maxThreshold, wanted.thresholdStep = 20.0, 240.0, 20.0
    wanted.filterByColor = wanted.filterByCircularity = False
    wanted.minArea, wanted.maxArea = LEAST_AREA_PX, max(2.0 * gray.size / (board.columns * board.rows), 100.0)
    wanted.filterByArea = wanted.filterByConvexity = wanted.filterByInertia = True
    wanted.minConvexity, wanted.minInertiaRatio, wanted.minDistBetweenBlobs = 0.85, 0.05, 3.0
    blobs = cv2.SimpleBlobDetector.create(wanted).detect(gray)
    places = np.array([blob.pt for blob in blobs], dtype=float).reshape(-1, 2)
    diameters = np.array([blob.size for blob in blobs], dtype=float)
    around = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])[:, None]
    at = np.rint(places + around * diameters[:, None]).astype(int)
    column, row = np.moveaxis(np.clip(at, 0, np.array(gray.shape[::-1]) - 1), -1, 0)
    values = gray[row, column].astype(float)
    dark = values[0] < values[1:].mean(axis=0)
    yield places[dark], diameters[dark]
    yield places[~dark], diameters[~dark]


def _tested(gray: Gray, board: CircleGrid, grid: Array, diameters: Array, camera: Camera) -> FoundBoard:
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0.0:  # a mirror image: a board is not seen from behind
        grid, diameters = grid[::-1], diameters[::-1]
    rows, columns = grid.shape[:2]
    steps: Array = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(float)
    blobs = FoundBoard(grid.reshape(-1, 2), np.arange(rows * columns), Rejection.NOT_A_GRID)
    plane = Plane.through(steps, grid, camera)
    if plane is None or (_off(plane, steps, grid) > MOST_OFF_BLOB * smallest_step(grid)).any():
        return blobs
    radii: Array = 0.5 * diameters / plane.scales(steps)
    circles: Circles | None = None
    centres = grid
    for _ in range(ROUNDS):
        circles = measured_circles(gray, plane, steps, centres if circles is None else circles.seen_px, radii)
        if not circles.seen.all():
            return FoundBoard(blobs.corners_px, blobs.indices, Rejection.NOT_WHOLE)
        centres, radii = circles.centres_px, circles.radii
        again = Plane.through(steps, centres, camera)
        if again is None:
            return blobs
        plane = again
    assert circles is not None
    kept = _off(plane, steps, centres) <= max(MOST_OFF_PX, MOST_OFF * smallest_step(centres))
    usual, contrast = float(np.median(radii)), float(np.median(circles.contrasts))
    larger = radii * SAME_SIZE > usual
    rejection: Rejection | None = None
    if not (kept.mean() >= LEAST_KEPT and all((kept.mean(axis=axis) > 0.5).all() for axis in (0, 1))):
        rejection, kept = Rejection.NOT_A_GRID, np.ones_like(kept)
    elif (
        (radii < SAME_SIZE * usual).any()
        or (circles.contrasts * np.sign(contrast) < LEAST_CONTRAST * abs(contrast)).any()
        or int(larger.sum()) != (1 if board.larger_dot else 0)
    ):
        rejection = Rejection.CIRCLES
    elif _goes_on(gray, plane, rows, columns, usual, contrast):
        rejection = Rejection.OTHER_SIZE
    turn = _turn(larger, board)
    if turn is None:
        turn, rejection = 0, rejection or Rejection.CIRCLES
    kept = np.rot90(kept, turn)
    return FoundBoard(np.rot90(centres, turn)[kept], np.flatnonzero(kept), rejection)


def _off(plane: Plane, steps: Array, centres: Array) -> Array:
    """How far (rows, columns) centres are from their places in the plane, pixels."""
    return np.asarray(np.linalg.norm(plane.pixels(steps) - centres, axis=-1))


def _turn(larger: np.ndarray, board: CircleGrid) -> int | None:
    """How many quarters of a turn bring the larger circle to its corner; None if none does."""
    if not board.larger_dot:
        return 0
    row, column = (-1 if side in board.corner else 0 for side in ("lower", "right"))
    turns = range(4) if board.rows == board.columns else (0, 2)
    return next((turn for turn in turns if np.rot90(larger, turn)[row, column]), None)


def _goes_on(gray: Gray, plane: Plane, rows: int, columns: int, radius: float, contrast: float) -> bool:
    """Whether a whole row or column of circles lies beyond the board, on any of its sides."""
    across, down = np.arange(columns, dtype=float), np.arange(rows, dtype=float)
    beyond = [np.stack([across, np.full(columns, y)], axis=-1) for y in (-1.0, float(rows))]
    beyond += [np.stack([np.full(rows, x), down], axis=-1) for x in (-1.0, float(columns))]
    for places in beyond:
        circles = measured_circles(gray, plane, places, plane.pixels(places), np.full(len(places), radius))
        ratio = circles.radii / radius
        alike = (circles.contrasts / contrast >= GOES_ON) & (ratio > SAME_SIZE) & (ratio < 1.0 / SAME_SIZE**2)
        if (circles.seen & alike).sum() >= len(places) - 1:  # one of them may be a larger dot
            return True
    return False
