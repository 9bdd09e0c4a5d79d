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
from itertools import permutations

import cv2
import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import CORNERS, Checkerboard, CircleGrid
from gtsam_rwhec.cameras.unknown_intrinsics import estimated_intrinsics
from gtsam_rwhec.detect.checkerboards import find_checkerboard
from gtsam_rwhec.detect.circle_grids import find_circle_grid
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.detect.saddle_lattices import lattice_sizes
from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.rig.sections import Intrinsics

#: The smallest board that is looked for, in corners or circles a side, and the largest.
SMALLEST, LARGEST = 3, 30
#: A board must pass in at least this number of images.
LEAST_IMAGES = 2
#: At most this number of candidates of each kind, the most frequent, are looked for in all images. If there are this
#: many images, at least `LEAST_IMAGES` of them must propose a candidate.
MOST_CANDIDATES, ENOUGH_IMAGES = 3, 6
#: Circles have at least this area, pixels.
LEAST_AREA_PX = 20.0


@dataclass(frozen=True, eq=False)
class BoardSeen:
    """A board that was found in the images."""

    board: Checkerboard | CircleGrid  #: With 1 m for the length that is not known
    images: tuple[int, ...]  #: The images in which it was found
    corners_px: tuple[Array, ...]  #: tuple of (n, 2): Its corners or centres in each of them
    indices: tuple[np.ndarray, ...]  #: tuple of (n,): Their rows in ``board.corners()``.

    @property
    def counts(self) -> tuple[int, int]:
        """The number of corners or circles, [across, down]."""
        return self.board.columns, self.board.rows


def boards_seen(images: Sequence[Gray]) -> list[BoardSeen]:
    """The checkerboard and the grid of circles in a camera's images: at most one of each."""
    found = []
    kinds: tuple[tuple[Callable[[Gray], Iterator[tuple[int, int]]], Callable[..., BoardSeen]], ...] = (
        (partial(_circle_grids, size_of=lattice_size), partial(_with_circles, asymmetric=False)),
        (partial(_circle_grids, size_of=asymmetric_size), partial(_with_circles, asymmetric=True)),
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


def _circle_grids(gray: Gray, size_of: Callable[[Array, Array], tuple[int, int] | None]) -> Iterator[tuple[int, int]]:
    """Numbers of circles that a grid may have: in a row, and rows; the larger first where rows are not shifted."""
    wanted = cv2.SimpleBlobDetector_Params()  # type: ignore[attr-defined]
    wanted.minThreshold, wanted.maxThreshold, wanted.thresholdStep = 20.0, 240.0, 20.0
    wanted.filterByCircularity, wanted.filterByArea, wanted.filterByColor = False, True, True
    wanted.minArea, wanted.maxArea = LEAST_AREA_PX, gray.size / SMALLEST**2
    wanted.minConvexity, wanted.minInertiaRatio, wanted.minDistBetweenBlobs = 0.85, 0.05, 3.0
    for colour in (0, 255):
        wanted.blobColor = colour
        blobs = cv2.SimpleBlobDetector.create(wanted).detect(gray)
        places = np.array([blob.pt for blob in blobs], dtype=float).reshape(-1, 2)
        size = size_of(places, np.array([blob.size for blob in blobs], dtype=float))
        if size is not None and min(size) >= SMALLEST and max(size) <= LARGEST:
            yield size if size_of is asymmetric_size else _larger_first(*size)


def _larger_first(first: int, second: int) -> tuple[int, int]:
    return max(first, second), min(first, second)


def _with_checkerboard(images: Sequence[Gray], columns: int, rows: int) -> BoardSeen:
    board = Checkerboard("board", columns, rows, 1.0)
    good = []
    for i, gray in enumerate(images):
        try:
            seen = find_checkerboard(gray, board)
        except cv2.error:  # one image's failure costs one image, as in detection
            continue
        if seen is not None and seen.rejection is None:
            good.append((i, seen))
    return BoardSeen(
        board, tuple(i for i, _ in good), tuple(s.corners_px for _, s in good), tuple(s.indices for _, s in good)
    )


def _with_circles(images: Sequence[Gray], columns: int, rows: int, *, asymmetric: bool) -> BoardSeen:
    """The grid as it is in most images: without a larger dot, or with one."""
    best: BoardSeen | None = None
    for dot in (False,) if asymmetric else (False, True):
        corner = CORNERS[0] if dot else False
        board = CircleGrid("grid", columns, rows, 1.0, larger_dot=corner, asymmetric=asymmetric)
        good = []
        for i, gray in enumerate(images):
            height, width = gray.shape
            # No usual robot camera distorts a small grid much, so a pinhole camera is enough for this test.
            camera = Camera.of(width, height, "pinhole", _any_K(width, height), (), "a first guess")
            seen = find_circle_grid(gray, board, camera)
            if seen is not None and seen.rejection is None:
                good.append((i, seen))
        tried = BoardSeen(
            board, tuple(i for i, _ in good), tuple(s.corners_px for _, s in good), tuple(s.indices for _, s in good)
        )
        if best is None or len(tried.images) > len(best.images):
            best = tried
    assert best is not None
    return best


def _any_K(width: int, height: int) -> Array:
    """Intrinsics of a lens that sees about 60 degrees across."""
    return np.array([[0.9 * width, 0.0, 0.5 * width], [0.0, 0.9 * width, 0.5 * height], [0.0, 0.0, 1.0]])


#: A neighbour is off its predicted place by at most this share of the step to it.
NEAR = 0.25
#: The ratio of neighbours' sizes is between this and its inverse: a grid may have larger dots.
ALIKE = 0.4
#: The number of points from which lattices are grown, spread over all points.
STARTS = 12
#: Steps of neighbours, along the lattice.
STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))


def lattice_size(points: Array, sizes: Array) -> tuple[int, int] | None:
    """The numbers of points along the two axes of the largest lattice that is whole; None where there is none.

    Parameters
    ----------
    points : (n, 2) array
    sizes : (n,) array
        Sizes that are about equal for neighbours, such as diameters of blobs.
    """
    return _largest(points, sizes, _rectangle)


def asymmetric_size(points: Array, sizes: Array) -> tuple[int, int] | None:
    """Points in a row, and rows, of the largest whole lattice whose every other row is shifted by half a step."""
    return _largest(points, sizes, _shifted_rows)


def _largest(points: Array, sizes: Array, shape: Callable[[Array], tuple[int, int] | None]) -> tuple[int, int] | None:
    best: tuple[int, int] | None = None
    if len(points) < 4:
        return None
    middle = np.argsort(np.linalg.norm(points - np.median(points, axis=0), axis=1))
    for start in middle[np.unique(np.linspace(0, len(points) - 1, STARTS).astype(int))]:
        cells = _grown(points, sizes, int(start))
        size = None if cells is None else shape(np.array(list(cells)))
        if size is not None and (best is None or size[0] * size[1] > best[0] * best[1]):
            best = size
    return best


def _rectangle(cells: Array) -> tuple[int, int] | None:
    """The sides of a rectangle that these cells (n, 2) fill."""
    columns, rows = (int(side) for side in np.ptp(cells, axis=0) + 1)
    return (columns, rows) if columns * rows == len(cells) else None


def _shifted_rows(cells: Array) -> tuple[int, int] | None:
    """Points in a row, and rows, if every other row of these cells (n, 2) is shifted by half a step.

    All pairs of steps between neighbours are tried as the lattice's two axes: half steps along a row, and rows.
    """
    for first, second in permutations(((1, 1), (1, -1), (2, 0), (0, 2)), 2):
        x, row = (cells @ np.array([first, second])).T
        x, row = x - x.min(), row - row.min()
        starts = np.array([x[row == r].min(initial=99) for r in range(row.max() + 1)])
        counts = np.bincount(row)
        ends = np.array([x[row == r].max(initial=-99) for r in range(row.max() + 1)])
        if (
            (counts == counts[0]).all()
            and (ends - starts == 2 * (counts - 1)).all()
            and len(starts) > 1
            and (np.abs(np.diff(starts)) == 1).all()
            and starts.max() == 1
        ):
            return int(counts[0]), len(counts)
    return None


def _grown(points: Array, sizes: Array, start: int) -> dict[tuple[int, int], int] | None:
    """The lattice that grows from a point: which point is in which cell."""
    away = points - points[start]
    apart = np.linalg.norm(away, axis=1)
    ratio = sizes / sizes[start]
    apart[(ratio < ALIKE) | (ratio > 1.0 / ALIKE)] = np.inf
    apart[start] = np.inf
    nearest = np.argsort(apart)[:8]
    first = away[nearest[0]]
    if not np.isfinite(apart[nearest[0]]):
        return None
    sines = np.abs(first[0] * away[nearest, 1] - first[1] * away[nearest, 0]) / (
        np.linalg.norm(first) * np.maximum(apart[nearest], 1e-9)
    )
    across = nearest[np.isfinite(apart[nearest]) & (sines > 0.3)]
    if not len(across):
        return None
    second = away[across[0]]
    cells = {(0, 0): start}
    steps: dict[tuple[int, int], Array] = {(0, 0): np.array([first, second])}
    taken = {start}
    waiting = [(0, 0)]
    while waiting:
        cell = waiting.pop(0)
        here, basis = cells[cell], steps[cell]
        for i, j in STEPS:
            beside = cell[0] + i, cell[1] + j
            if beside in cells:
                continue
            step = i * basis[0] + j * basis[1]
            off = np.linalg.norm(points - points[here] - step, axis=1)
            which = int(np.argmin(off))
            ratio_there = sizes[which] / sizes[here]
            if which in taken or off[which] > NEAR * np.linalg.norm(step) or not ALIKE < ratio_there < 1.0 / ALIKE:
                continue
            cells[beside], taken = which, taken | {which}
            own = basis.copy()
            own[0 if i else 1] = (points[which] - points[here]) * (i or j)  # perspective bends the steps slowly
            steps[beside] = own
            waiting.append(beside)
    return cells


#: The comment beside intrinsics that were found: the user states whether the camera was calibrated.
STATED = "stated: calibration if this camera was calibrated, with this lens and focus"
#: A board's views determine a focal length with at least this number of images.
LEAST_VIEWS = 6
#: Focal lengths, over the images' width, that lenses on robots have.
SHORTEST, LONGEST = 0.25, 6.0
#: A fitted camera with a larger residual (pixels) is rejected.
LARGEST_RMS_PX = 1.5
#: The focal length over the width where it is unknown: about 60 degrees across.
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
    K = (round(USUAL * width, 1), round(USUAL * width, 1), 0.5 * (width - 1), 0.5 * (height - 1))
    section = Intrinsics(K=K, size=size)
    return GuessedIntrinsics(
        section,
        "TODO no file has them, and this is a usual lens: calibrate the camera, intrinsics: FILE, or take images of a "
        "board, intrinsics: estimate",
        section.camera_of_numbers("a first guess"),
    )
