"""Pictures of printed targets at any resolution, drawn neither by the library nor by OpenCV's drawing of boards."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import cv2
import numpy as np
import numpy.typing as npt

from gtsam_rwhec.cameras.targets import AprilGrid, Bundle, Charuco, Checkerboard, CircleGrid, Tag, TagGrid
from gtsam_rwhec.detect.tags import dictionary

Array = npt.NDArray[np.float64]
Picture = npt.NDArray[np.float32]

#: Modules between tag and edge of a marker, and of Kalibr's AprilGrid.
BORDER, APRILGRID_BORDER = 1, 2
#: A circle's radius, and the larger one's, as shares of the spacing.
RADIUS, LARGER = 0.25, 0.4


@dataclass(frozen=True, eq=False)
class Print:
    """A printed pattern, 0 (ink) to 1 (paper), with the target's origin in its middle; metres of a picture's pixel."""

    picture: Picture
    pixel_m: float


def tag_modules(family: str, number: int, border: int) -> Array:
    """(n, n) of 0 and 1: a tag with its black border."""
    side = int(dictionary(family).markerSize) + 2 * border
    return cv2.aruco.generateImageMarker(dictionary(family), number, side, borderBits=border) / 255.0


def drawn(modules: Array, unit_m: float, per_unit: int, margin: float) -> Print:
    """Modules (rows, columns) of `unit_m` each, of `per_unit` pixels, with a white margin of so many modules."""
    around = ceil(margin * per_unit)
    picture = np.pad(np.kron(modules, np.ones((per_unit, per_unit))), around, constant_values=1.0)
    return Print(picture.astype(np.float32), unit_m / per_unit)


def checkerboard(board: Checkerboard, per_unit: int, margin: float) -> Print:
    """The unit is a square."""
    row, column = np.indices((board.rows + 1, board.columns + 1))
    return drawn((row + column) % 2.0, board.square_m, per_unit, margin)


def single_tag(tag: Tag, per_unit: int, margin: float) -> Print:
    """The unit is a module."""
    modules = tag_modules(tag.family, tag.id, BORDER)
    return drawn(modules, tag.size_m / len(modules), per_unit, margin)


def aprilgrid(grid: AprilGrid, per_unit: int, margin: float) -> Print:
    """The unit is a module of a tag; small black squares are between the tags' corners (Kalibr)."""
    tags = [tag_modules(grid.family, number, APRILGRID_BORDER) for number in grid.ids]
    side = len(tags[0])
    gap = round(grid.spacing * side)
    assert abs(gap - grid.spacing * side) < 1e-9, "give a spacing of whole modules"
    pitch = side + gap
    modules = np.ones((grid.rows * pitch + gap, grid.columns * pitch + gap))
    for k, tag in enumerate(tags):
        row, column = grid.rows - 1 - k // grid.columns, k % grid.columns
        modules[gap + row * pitch :, gap + column * pitch :][:side, :side] = tag
    for row in range(grid.rows + 1):
        for column in range(grid.columns + 1):
            modules[row * pitch :, column * pitch :][:gap, :gap] = 0.0
    return drawn(modules, grid.tag_m / side, per_unit, margin)


def tag_grid(grid: TagGrid, per_unit: int, margin: float) -> Print:
    """The unit is a module of a tag; there is nothing in the gaps."""
    side = int(dictionary(grid.family).markerSize) + 2 * BORDER
    gap = round(grid.gap_m / grid.tag_m * side)
    assert abs(gap - grid.gap_m / grid.tag_m * side) < 1e-9, "give a gap of whole modules"
    modules = np.ones((grid.rows * (side + gap) - gap, grid.columns * (side + gap) - gap))
    for k, number in enumerate(grid.ids):
        row, column = divmod(k, grid.columns)
        tag = tag_modules(grid.family, number, BORDER)
        modules[row * (side + gap) :, column * (side + gap) :][:side, :side] = tag
    return drawn(modules, grid.tag_m / side, per_unit, margin)


def flat_bundle(bundle: Bundle, per_unit: int, margin: float) -> Print:
    """Tags of one size on a sheet about the bundle's origin; the unit is a module."""
    side = int(dictionary(bundle.family).markerSize) + 2 * BORDER
    unit = bundle.tags[0].size_m / side
    corners = np.rint(np.stack([tag.corners()[0, :2] for tag in bundle.tags]) / unit).astype(int)
    half = int(np.abs(np.stack([tag.corners()[:, :2] for tag in bundle.tags])).max() / unit + 0.5)
    modules = np.ones((2 * half, 2 * half))
    for tag, (x, y) in zip(bundle.tags, corners, strict=True):
        modules[half - y :, half + x :][:side, :side] = tag_modules(bundle.family, tag.id, BORDER)
    return drawn(modules, unit, per_unit, margin)


def charuco_unit(board: Charuco) -> tuple[int, int]:
    """Modules of a square and of a marker, whole numbers; as many are on each side of a marker."""
    of_marker = int(dictionary(board.family).markerSize) + 2 * BORDER
    of_square = round(of_marker * board.square_m / board.marker_m)
    assert abs(of_square - of_marker * board.square_m / board.marker_m) < 1e-9, "give squares of whole modules"
    assert (of_square - of_marker) % 2 == 0, "give margins of whole modules"
    return of_square, of_marker


def charuco(board: Charuco, per_unit: int, margin: float) -> Print:
    """The unit is a module of a marker; the square at the top left is black (OpenCV since 4.6)."""
    of_square, of_marker = charuco_unit(board)
    row, column = np.indices((board.rows, board.columns))
    modules = np.kron((row + column) % 2.0, np.ones((of_square, of_square)))
    gap = (of_square - of_marker) // 2
    for number, (i, j) in zip(board.ids, np.argwhere((row + column) % 2 == 1), strict=True):
        marker = tag_modules(board.family, number, BORDER)
        modules[i * of_square + gap :, j * of_square + gap :][:of_marker, :of_marker] = marker
    return drawn(modules, board.square_m / of_square, per_unit, margin)


def circle_grid(grid: CircleGrid, per_unit: int, margin: float, *, light: bool = False) -> Print:
    """The unit is the spacing; half a unit is around the outer circles' centres before the margin begins.

    Light circles are on a dark board, margin and all.
    """
    places = grid.steps()
    radii = np.full((grid.rows, grid.columns), RADIUS)
    if grid.larger_dot:
        radii[-1 if "lower" in grid.corner else 0, -1 if "right" in grid.corner else 0] = LARGER
    across, down = (places.reshape(-1, 2).max(axis=0).astype(int) + 1).tolist()
    picture = np.ones((down * per_unit, across * per_unit))
    y, x = np.indices((per_unit, per_unit)) - 0.5 * (per_unit - 1)
    for (column, row), radius in zip(places.reshape(-1, 2).astype(int).tolist(), radii.ravel().tolist(), strict=True):
        cell = np.clip(np.hypot(x, y) - per_unit * radius + 0.5, 0.0, 1.0)
        picture[row * per_unit :, column * per_unit :][:per_unit, :per_unit] = cell
    picture = np.pad(picture, ceil(margin * per_unit), constant_values=1.0)
    return Print((1.0 - picture if light else picture).astype(np.float32), grid.spacing_m / per_unit)
