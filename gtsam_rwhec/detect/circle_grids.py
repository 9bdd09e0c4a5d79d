"""Grids of circles: lattices of ellipses, tested against the board, turned by its larger dot.

A grid with a wrong circle, one circle off, or of another size must not count. So every circle must be there and have
its size (one at a corner larger, if the board has a larger dot), all lie on one plane's grid but for a few that bent
paper or dirt moves and that do not count, and no row may go on beyond the board.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import cv2
import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import CircleGrid
from gtsam_rwhec.detect.board_evidence import BoardPlane, FoundBoard, smallest_step
from gtsam_rwhec.detect.circle_centres import Circles, measured_circles
from gtsam_rwhec.detect.circle_lattice import Ellipses, ellipses, grids
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.geometry.poses import Array

#: At most this number of grids in an image are tested.
MOST_TESTED = 12
#: Images with a larger side than this are searched at half their size first.
LARGE_PX = 1000
#: Images are blurred with this standard deviation (pixels) before blobs are looked for: noise has no ellipses then.
STEADY_PX = 0.8
#: Sides of the squares against whose means blobs are dark or light, pixels: most circles are found with the first. The
#: smaller one is for circles near the edge of a board before another background.
AROUND_PX = (31, 101, 15, 251)
NONE = Ellipses(np.zeros((0, 2)), np.zeros((0, 2, 2)))
#: A circle is off its place in the plane by at most this (pixels), or by `MOST_OFF` of the distance between lines.
MOST_OFF_PX, MOST_OFF = 0.5, 0.05
#: Circles do not count where the light around them is off a plane by more than this share of it, and by more than this
#: multiple of the median.
UNEVEN, UNEVEN_OF_MEDIAN = 0.02, 2.5
#: A few circles that are off by more than this (pixels), and by more than this multiple of the median, do not count.
FAR_OFF_PX, FAR_OFF = 0.1, 5.0
#: Blobs, not yet corrected for perspective, by at most this share of the distance between lines.
MOST_OFF_BLOB = 0.2
#: At least this share of the circles, and more than half of each row and column, must be at their places.
LEAST_KEPT = 0.9
#: A circle's radius is this share of the median at least, and at most one over it. The larger dot is larger than that.
SAME_SIZE = 0.75
#: A circle has at least this share of the median contrast.
LEAST_CONTRAST = 0.3
#: The light around circles, off a plane, is at most this share of their contrast (at the median; they have 0.01 to
#: 0.05). Around the squares of a checkerboard it is 0.2 and more.
CLEAR = 0.1
#: A row of circles goes on beyond the board if its circles have their size and this share of the median contrast, and
#: the light around them is off a plane by at most this share of it: the edge of a board is no row of circles.
GOES_ON, GOES_ON_CLEAR = 0.5, 0.3
#: Rounds in which the plane, the circles' sizes and the correction for perspective settle.
ROUNDS = 3


def find_circle_grid(gray: Gray, board: CircleGrid, camera: Camera) -> FoundBoard | None:
    """Find a grid that is whole in the image; None where there is none.

    Without a larger dot a grid looks the same turned (`CircleGrid.ways`), and is read in one of these ways.
    """
    rejected: FoundBoard | None = None
    for grid, radii_px in islice(_candidates(gray, board), MOST_TESTED):
        found = _tested(gray, board, grid, radii_px, camera)
        if found.rejection in (None, Rejection.OTHER_SIZE):
            return found
        rejected = rejected or found
    return rejected


def _candidates(gray: Gray, board: CircleGrid) -> Iterator[tuple[Array, Array]]:
    """Grids of blobs (rows, columns, 2), with the blobs' radii (rows, columns), pixels; nan where one is missing."""
    for halved in (True, False) if max(gray.shape) > LARGE_PX else (False,):
        picture = gray
        if halved:
            picture = np.asarray(cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
        picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), STEADY_PX), np.uint8)
        dark, light = NONE, NONE
        large = max(picture.shape) > LARGE_PX  # its large circles were found, or not, at half its size
        for around in AROUND_PX[:1] if large else AROUND_PX:
            dark = dark.with_more(ellipses(picture, around, light=False))
            light = light.with_more(ellipses(picture, around, light=True))
            for blobs in (dark, light):
                for grid, radii in grids(blobs, board):
                    # Pixel centres are at whole numbers: the first of the halved ones is at 1/2.
                    yield (2.0 * grid + 0.5, 2.0 * radii) if halved else (grid, radii)


def _tested(gray: Gray, board: CircleGrid, grid: Array, radii_px: Array, camera: Camera) -> FoundBoard:
    steps, there = board.steps(), np.isfinite(radii_px)
    plane = BoardPlane.through(steps[there], grid[there], camera)
    if plane is None:
        return FoundBoard(grid[there], np.flatnonzero(there), Rejection.NOT_A_GRID)
    predicted = plane.pixels(steps)
    off = np.linalg.norm(predicted - grid, axis=-1)
    grid = np.where(there[..., None], grid, predicted)
    blobs = FoundBoard(grid.reshape(-1, 2), np.arange(there.size), Rejection.NOT_A_GRID)
    if not np.isfinite(grid).all() or (off[there] > MOST_OFF_BLOB * smallest_step(grid)).any():
        return blobs
    radii: Array = radii_px / plane.scales(steps)
    radii = np.where(there, radii, np.median(radii[there]))
    circles: Circles | None = None
    centres = grid
    for _ in range(ROUNDS):
        circles = measured_circles(gray, plane, steps, centres if circles is None else circles.seen_px, radii)
        if not circles.seen.all():
            return FoundBoard(blobs.corners_px, blobs.indices, Rejection.NOT_WHOLE)
        centres, radii = circles.centres_px, circles.radii
        again = BoardPlane.through(steps, centres, camera)
        if again is None:
            return blobs
        plane = again
    assert circles is not None
    off = _off(plane, steps, centres)
    most_off = max(MOST_OFF_PX, MOST_OFF * smallest_step(centres))
    evenly = circles.uneven <= max(UNEVEN, UNEVEN_OF_MEDIAN * float(np.median(circles.uneven)))
    near = off <= min(most_off, max(FAR_OFF_PX, FAR_OFF * float(np.median(off))))
    kept = (near if near.mean() >= LEAST_KEPT else off <= most_off) & evenly  # a bent board has more that are off
    usual, contrast = float(np.median(radii)), float(np.median(circles.contrasts))
    larger = radii * SAME_SIZE > usual
    rejection: Rejection | None = None
    at_place = off <= most_off
    is_grid = at_place.mean() >= LEAST_KEPT and all((at_place.mean(axis=axis) > 0.5).all() for axis in (0, 1))
    if not is_grid or kept.mean() < 0.5:
        rejection, kept = Rejection.NOT_A_GRID, np.ones_like(kept)
    elif (
        (radii < SAME_SIZE * usual).any()
        or (circles.contrasts * np.sign(contrast) < LEAST_CONTRAST * abs(contrast)).any()
        or np.median(circles.uneven) > CLEAR * abs(contrast)
        or int(larger.sum()) != (1 if board.larger_dot else 0)
    ):
        rejection = Rejection.CIRCLES
    elif _goes_on(gray, plane, board, usual, contrast):
        rejection = Rejection.OTHER_SIZE
    turn = _turn(larger, board)
    if turn is None:
        turn, rejection = 0, rejection or Rejection.CIRCLES
    kept = np.rot90(kept, turn)
    return FoundBoard(np.rot90(centres, turn)[kept], np.flatnonzero(kept), rejection)


def _off(plane: BoardPlane, steps: Array, centres: Array) -> Array:
    """How far (rows, columns) centres are from their places in the plane, pixels."""
    return np.asarray(np.linalg.norm(plane.pixels(steps) - centres, axis=-1))


def _turn(larger: np.ndarray, board: CircleGrid) -> int | None:
    """How many quarters of a turn bring the larger circle to its corner; None if none does."""
    if not board.larger_dot:
        return 0
    row, column = (-1 if side in board.corner else 0 for side in ("lower", "right"))
    turns = range(4) if board.rows == board.columns else (0, 2)
    return next((turn for turn in turns if np.rot90(larger, turn)[row, column]), None)


def _goes_on(gray: Gray, plane: BoardPlane, board: CircleGrid, radius: float, contrast: float) -> bool:
    """Whether a whole row or column of circles lies beyond the board, on any of its sides."""
    columns, rows = np.arange(board.columns, dtype=float), np.arange(board.rows, dtype=float)
    if board.asymmetric:
        right = 2.0 * board.columns
        beyond = [
            np.stack([2.0 * columns + y % 2, np.full(len(columns), y)], axis=-1) for y in (-1.0, float(board.rows))
        ]
        beyond += [np.stack([np.full(len(y), x), y], axis=-1) for x, y in ((-1.0, rows[1::2]), (right, rows[::2]))]
    else:
        beyond = [np.stack([columns, np.full(len(columns), y)], axis=-1) for y in (-1.0, float(board.rows))]
        beyond += [np.stack([np.full(len(rows), x), rows], axis=-1) for x in (-1.0, float(board.columns))]
    for places in beyond:
        circles = measured_circles(gray, plane, places, plane.pixels(places), np.full(len(places), radius))
        ratio = circles.radii / radius
        alike = (circles.contrasts / contrast >= GOES_ON) & (ratio > SAME_SIZE) & (ratio < 1.0 / SAME_SIZE**2)
        alike &= circles.uneven <= GOES_ON_CLEAR * np.abs(circles.contrasts)
        if (circles.seen & alike).sum() >= len(places) - (len(places) > 2):  # one of them may be a larger dot
            return True
    return False
