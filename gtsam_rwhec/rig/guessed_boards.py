"""Boards without tags: finds the number of their corners or circles from some images.

A detector needs the board's size. Lattices of saddle points or blobs give candidates. The normal detection then looks
for each candidate in all images; it tests every square and circle, and that the pattern does not continue beyond the
board. The candidate detected in the most images, at least two, is the board.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import CORNERS, Checkerboard, CircleGrid
from gtsam_rwhec.cameras.unknown_intrinsics import estimated_intrinsics
from gtsam_rwhec.detect.board_evidence import FoundBoard
from gtsam_rwhec.detect.checkerboards import find_checkerboard
from gtsam_rwhec.detect.circle_grids import find_circle_grid
from gtsam_rwhec.detect.circle_lattices import MOST_BLOBS, Ellipses, blobs_in, grown_lattices
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.detect.saddle_lattices import lattice_sizes
from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.rig.sections import Intrinsics

#: The smallest and the largest board that is looked for, in corners or circles a side.
SMALLEST, LARGEST = 3, 30
#: A board must pass in at least this number of images.
LEAST_IMAGES = 2
#: At most this number of candidates of each kind, the most frequent, are looked for in all images. If there are this
#: many images, at least `LEAST_IMAGES` of them must propose a candidate.
MOST_CANDIDATES, ENOUGH_IMAGES = 3, 6
#: The columns and rows that cells (n, 2) of a lattice fill; None where they are no board.
Shape = Callable[[Array], tuple[int, int] | None]


@dataclass(frozen=True, eq=False)
class BoardSeen:
    """A board that was found in the images."""

    board: Checkerboard | CircleGrid  #: The board, with 1 m for its unknown length
    images: tuple[int, ...]  #: The images in which it was found
    corners_px: tuple[Array, ...]  #: tuple of (n, 2): The board's corners or centres in each image
    indices: tuple[np.ndarray, ...]  #: tuple of (n,): Their rows in ``board.corners()``.

    @property
    def counts(self) -> tuple[int, int]:
        """The number of corners or circles, [across, down]."""
        return self.board.columns, self.board.rows


def boards_seen(images: Sequence[Gray]) -> list[BoardSeen]:
    """The checkerboard and the grid of circles in a camera's images: at most one of each."""
    found = []
    kinds: tuple[tuple[Callable[[Gray], Iterator[tuple[int, int]]], Callable[..., BoardSeen]], ...] = (
        (partial(_circle_grids, shape=rectangle), partial(_with_circles, asymmetric=False)),
        (partial(_circle_grids, shape=shifted_rows), partial(_with_circles, asymmetric=True)),
        (_checkerboards, _with_checkerboard),
    )
    taken: set[int] = set()  # images with a grid of circles: no checkerboard is looked for in them
    for candidates, look in kinds:
        counted = Counter(size for i, gray in enumerate(images) if i not in taken for size in set(candidates(gray)))
        best: BoardSeen | None = None
        least = LEAST_IMAGES if len(images) >= ENOUGH_IMAGES else 1
        for size in [size for size, times in counted.most_common(MOST_CANDIDATES) if times >= least]:
            seen = look(images, *size)
            if len(seen.images) >= LEAST_IMAGES and (best is None or len(seen.images) > len(best.images)):
                best = seen
        if best is not None:
            found.append(best)
            taken |= set(best.images)
    return found


def _checkerboards(gray: Gray) -> Iterator[tuple[int, int]]:
    """Numbers of inner corners that an image's checkerboard may have, the larger first."""
    for size in lattice_sizes(gray):
        if min(size) >= SMALLEST and max(size) <= LARGEST:
            yield _larger_first(*size)


def _circle_grids(gray: Gray, shape: Shape) -> Iterator[tuple[int, int]]:
    """Numbers of circles that a grid may have: in a row, and rows; the larger first where rows are not shifted."""
    for blobs, _ in blobs_in(gray):
        size = lattice_size(blobs, shape) if len(blobs.places) <= MOST_BLOBS else None
        if size is not None and min(size) >= SMALLEST and max(size) <= LARGEST:
            yield size if shape is shifted_rows else _larger_first(*size)


def _larger_first(first: int, second: int) -> tuple[int, int]:
    return max(first, second), min(first, second)


def _with_checkerboard(images: Sequence[Gray], columns: int, rows: int) -> BoardSeen:
    board = Checkerboard("board", columns, rows, 1.0)
    return _passing(images, board, lambda gray: find_checkerboard(gray, board))


def _with_circles(images: Sequence[Gray], columns: int, rows: int, *, asymmetric: bool) -> BoardSeen:
    """The grid as it is in most images: without a larger dot, or with one."""
    dots = (False,) if asymmetric else (False, CORNERS[0])
    boards = [CircleGrid("grid", columns, rows, 1.0, larger_dot=dot, asymmetric=asymmetric) for dot in dots]
    tried = [_passing(images, board, partial(_circles_in, board)) for board in boards]
    return max(tried, key=lambda seen: len(seen.images))


def _circles_in(board: CircleGrid, gray: Gray) -> FoundBoard | None:
    # No usual robot camera distorts a small grid much, so a pinhole camera is enough for this test.
    height, width = gray.shape
    return find_circle_grid(gray, board, usual_lens((width, height)).camera)


def _passing(
    images: Sequence[Gray], board: Checkerboard | CircleGrid, find: Callable[[Gray], FoundBoard | None]
) -> BoardSeen:
    good = []
    for i, gray in enumerate(images):
        try:
            seen = find(gray)
        except cv2.error:  # one image's failure costs one image, as in detection
            continue
        if seen is not None and seen.rejection is None:
            good.append((i, seen))
    return BoardSeen(
        board, tuple(i for i, _ in good), tuple(s.corners_px for _, s in good), tuple(s.indices for _, s in good)
    )


def lattice_size(blobs: Ellipses, shape: Shape) -> tuple[int, int] | None:
    """Columns and rows of the largest lattice among the blobs that has the shape; None where there is none."""
    sizes = (shape(cells) for _, cells in grown_lattices(blobs))
    return max((size for size in sizes if size is not None), key=lambda size: size[0] * size[1], default=None)


def rectangle(cells: Array) -> tuple[int, int] | None:
    """The sides of a rectangle that these cells (n, 2) fill."""
    columns, rows = (int(side) for side in np.ptp(cells, axis=0) + 1)
    return (columns, rows) if columns * rows == len(cells) else None


def shifted_rows(cells: Array) -> tuple[int, int] | None:
    """Points in a row, and rows, if every other row of these cells (n, 2) is shifted by half a step.

    Neighbours are then in different rows: a row goes along one diagonal of the cells or the other.
    """
    diagonals = cells[:, 0] - cells[:, 1], cells[:, 0] + cells[:, 1]
    for along, across in (diagonals, diagonals[::-1]):
        x, row = along - along.min(), across - across.min()
        there = set(zip(row.tolist(), x.tolist(), strict=True))
        columns, rows = int((row == 0).sum()), int(row.max()) + 1
        for shift in (0, 1):
            if there == {(r, 2 * k + (r + shift) % 2) for r in range(rows) for k in range(columns)}:
                return columns, rows
    return None


#: The comment beside intrinsics that were found: the user states whether the camera was calibrated.
STATED = "stated: calibration if this camera was calibrated, with this lens and focus"
#: A board's views determine a focal length with at least this number of images.
LEAST_VIEWS = 6
#: The focal lengths of lenses on robots, divided by the images' width.
SHORTEST, LONGEST = 0.25, 6.0
#: A fitted camera with a larger residual (pixels) is rejected.
LARGEST_RMS_PX = 1.5
#: An unknown focal length, divided by the width, is assumed to be this: about 60 degrees across.
USUAL = 0.87


@dataclass(frozen=True)
class GuessedIntrinsics:
    """The rig file's section, the comment beside it (``TODO`` if a person must replace the section), and a camera."""

    section: Intrinsics
    words: str
    camera: Camera


def guessed_intrinsics(size: tuple[int, int], boards: Iterable[BoardSeen]) -> GuessedIntrinsics:
    """Intrinsics for images of this size (width, height) that saw some boards.

    If a board determines them, the rig file says that they are to be estimated: the calibration uses more images than
    this function, and estimates the lens together with the poses.
    """
    width, height = size
    for seen in boards:
        if len(seen.images) < LEAST_VIEWS:
            continue
        corners = seen.board.corners()
        try:
            fitted = estimated_intrinsics([corners[indices] for indices in seen.indices], seen.corners_px, size)
        except CameraError:
            continue
        (fx, fy), (cx, cy) = np.diagonal(fitted.camera.K)[:2], fitted.camera.K[:2, 2]
        is_lens = all(SHORTEST * width < f < LONGEST * width for f in (fx, fy)) and 0 < cx < width and 0 < cy < height
        if is_lens and fitted.rms_px < LARGEST_RMS_PX:
            return GuessedIntrinsics(
                Intrinsics(estimate="any"),
                f"no file has them: the images say them ({fitted.views} views of the board: f = {0.5 * (fx + fy):.0f} "
                f"px, to {rounded(fitted.rms_px, 2)} px). If the camera was calibrated, a file is better",
                fitted.camera,
            )
    return usual_lens(size)


def usual_lens(size: tuple[int, int]) -> GuessedIntrinsics:
    """Intrinsics of a lens that sees about 60 degrees across, for images of this size (width, height)."""
    width, height = size
    K = (round(USUAL * width, 1), round(USUAL * width, 1), 0.5 * (width - 1), 0.5 * (height - 1))
    section = Intrinsics(K=K, size=size)
    return GuessedIntrinsics(
        section,
        "TODO no file has them, and this is a usual lens: calibrate the camera, intrinsics: FILE, or take images of a "
        "board, intrinsics: estimate",
        section.camera_of_numbers("a first guess"),
    )
