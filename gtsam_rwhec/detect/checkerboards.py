"""Checkerboards: lattices of saddles, tested square by square, their corners measured by a model of the edges.

Of 346 rendered boards (whole, squares of 12 pixels and more, blur to 1.5 pixels, shade) lattices of saddles give 342
that pass the test (`board_evidence`), and none wrong; OpenCV's classic detector reads 288 and its sector-based one
296, each with boards read one square off or turned. Corners have 0.017 pixels by the model of the edges
(`saddle_fits`), and 0.057 by ``cornerSubPix``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.detect.board_corners import refined_corners
from gtsam_rwhec.detect.board_evidence import LEAST_KEPT, Evidence, FoundBoard, evidence, plane_through, smallest_step
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.detect.saddle_fits import fitted_corners
from gtsam_rwhec.detect.saddle_lattices import boards_in, lattices
from gtsam_rwhec.detect.saddles import LEVELS, groups_of, saddles, scaled_down
from gtsam_rwhec.geometry.poses import Array

#: The half window at a corner is this share of the distance between neighbouring lines of corners, at most 9 pixels.
#: The second is tried where corners are not on a grid.
OF_SQUARE = (0.4, 0.25)
#: Before they are measured, corners are off their places in a plane by at most this (pixels), or by this share of the
#: distance between lines: a shadow's edge moves them.
ROUGHLY_PX, ROUGHLY = 1.0, 0.06
#: Corners that are not sharp do not count if at least this share is.
LEAST_SHARP = 0.5


def find_checkerboard(gray: Gray, board: Checkerboard, camera: Camera | None = None) -> FoundBoard | None:
    """Find a board that is whole in the image; None where there is none.

    The top is where the first corner's outer square is black; a board of two even or two odd numbers of corners looks
    the same turned by half a turn, and is read in one of these ways. Two such boards in one image are told by no sign:
    neither counts. Nor can one image tell a board from its image in a mirror: its pattern is the same, turned, but for
    two odd numbers of corners that differ (and then it is that of a board printed with its colours exchanged).
    """
    rejected: FoundBoard | None = None
    found: FoundBoard | None = None
    for level in LEVELS:
        for grid, goes_on in _in_order(gray, board, level):
            if found is not None and not _is_apart(grid, found.corners_px):
                continue
            tested = _tested(gray, grid, camera)
            if tested.rejection is None and goes_on:
                tested = replace(tested, rejection=Rejection.OTHER_SIZE)
            if tested.rejection is None:
                if found is not None:
                    return replace(found, rejection=Rejection.SEEN_TWICE)
                found = tested
            elif rejected is None or tested.rejection is Rejection.OTHER_SIZE:
                rejected = tested
    return found or rejected


def _is_apart(grid: Array, corners_px: Array) -> bool:
    """Whether a grid's middle (rows, columns, 2) is outside the hull of other corners (n, 2)."""
    hull = cv2.convexHull(corners_px.astype(np.float32))
    middle = grid.reshape(-1, 2).mean(axis=0)
    return cv2.pointPolygonTest(hull, (float(middle[0]), float(middle[1])), False) < 0.0


def _in_order(gray: Gray, board: Checkerboard, level: int) -> Iterator[tuple[Array, bool]]:
    """Grids of corners (rows, columns, 2) that lattices of saddles give, and whether these go on beyond them."""
    corners = board.columns * board.rows
    seen = saddles(scaled_down(gray, level))
    for members in groups_of(seen.places, corners):
        for lattice in lattices(seen, members, corners):
            for grid, goes_on in boards_in(lattice, seen.places, board.rows, board.columns):
                # Pixel centres are at whole numbers: the first of the halved ones is at 1/2.
                yield grid * 2**level + 0.5 * (2**level - 1), goes_on


def _tested(gray: Gray, grid: Array, camera: Camera | None) -> FoundBoard:
    if not ((grid >= 0.0) & (grid <= np.array(gray.shape[::-1]) - 1.0)).all():
        return FoundBoard(grid.reshape(-1, 2), np.arange(grid.size // 2), Rejection.NOT_WHOLE)
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0.0:  # a mirror image: a board is not seen from behind
        grid = grid[::-1]
    tried: list[tuple[Array, Evidence]] = []
    for share in OF_SQUARE:  # a smaller window where something else is in the larger one, as a shadow's edge
        step = smallest_step(grid)
        rough = refined_corners(gray, grid.reshape(-1, 2), int(np.clip(share * step, 2, 9))).reshape(grid.shape)
        tried.append(_measured(gray, rough, max(ROUGHLY_PX, ROUGHLY * step), camera))
        if tried[-1][1].rejection is not Rejection.NOT_A_GRID:
            break
    refined, seen = tried[-1]
    kept = seen.kept
    if not seen.first_is_dark:
        refined, kept = _other_colour(refined), _other_colour(kept)
    return FoundBoard(refined[kept], np.flatnonzero(kept), seen.rejection)


def _measured(gray: Gray, rough: Array, most_px: float, camera: Camera | None) -> tuple[Array, Evidence]:
    """Corners (rows, columns, 2) measured where the plane of most of the rough ones says, and what they show."""
    rows, columns = rough.shape[:2]
    everyone = np.ones((rows, columns), dtype=bool)
    found = plane_through(rough, camera, most_px, everyone)
    if found is None or (found[1] <= most_px).mean() < LEAST_KEPT:
        return rough, Evidence(Rejection.NOT_A_GRID, everyone)
    fitted = fitted_corners(gray, found[0].pixels, rows, columns)
    seen = evidence(gray, fitted.corners_px, camera, fitted.good)
    sharp = seen.kept & fitted.sharp
    return fitted.corners_px, replace(seen, kept=sharp) if sharp.mean() >= LEAST_SHARP else seen


def _other_colour(grid: np.ndarray) -> np.ndarray:
    """A grid (rows, columns, ...) turned so that its first corner is at a square of the other colour, if a turn can."""
    rows, columns = grid.shape[:2]
    if (rows + columns) % 2 == 1:
        return grid[::-1, ::-1]
    if rows == columns and rows % 2 == 1:
        return np.rot90(grid)
    return grid
