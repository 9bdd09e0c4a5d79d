"""Whether corners are those of a checkerboard: each square, the outermost too, must be there, dark or light as printed.

A board that is detected one square off fits a homography as well as the right one. But its outermost squares lie on the
paper's margin or beyond, and do not alternate. Two neighbouring squares have nearly the same light, so that shade
hardly changes their contrast (light - dark) / (light + dark) (Michelson's).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.geometry.poses import Array

#: A corner is off its place in the plane by at most this (pixels), or by `MOST_OFF` of the distance between lines.
MOST_OFF_PX = 0.5
MOST_OFF = 0.02
#: At least this share of the corners must be at their places, and more than half of each row and column: of a row that
#: is not on the board no corner is at its place. The other corners are not used.
LEAST_KEPT = 0.8
#: Two neighbouring squares have at least this share of the median contrast of all neighbours.
LEAST_CONTRAST = 0.3
#: Two neighbouring squares differ by at least this, in gray values.
LEAST_GRAY = 4.0
#: The pattern goes on beyond the board if the next row of squares has this share of the median contrast.
GOES_ON = 0.6
#: The gray value of a square is the median of PER_SIDE^2 samples in this part of it, about its middle.
MIDDLE, PER_SIDE = 0.5, 5


@dataclass(frozen=True, eq=False)
class FoundBoard:
    """Corners (n, 2) of a board, or centres of its circles, their indices (n,) row by row from the top, and why they
    are not used.
    """

    corners_px: Array
    indices: np.ndarray
    rejection: Rejection | None


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the image says about a grid of corners."""

    rejection: Rejection | None  #: Why the corners are not the board's; None if they are
    #: (rows, columns): which corners are at their places in the plane; a shadow's edge or dirt moves a few
    kept: np.ndarray
    first_is_dark: bool = True  #: Whether the first corner's outer square is dark


@dataclass(frozen=True, eq=False)
class BoardPlane:
    """A board before a camera: H (3, 3) takes places on it to pixels without distortion."""

    H: Array
    focal: float
    camera: Camera | None

    @staticmethod
    def through(steps: Array, pixels: Array, camera: Camera | None, method: int = 0) -> BoardPlane | None:
        """The plane that fits pixels (..., 2) of places (..., 2), by `method` of OpenCV; None where no plane fits."""
        focal = 1.0 if camera is None else camera.focal_px
        flat = pixels.reshape(-1, 2) if camera is None else camera.undistort(pixels.reshape(-1, 2)) * focal
        H = None
        if len(flat) >= 4 and np.isfinite(flat).all():
            H = cv2.findHomography(steps.reshape(-1, 2), flat, method)[0]
        if H is None or not np.isfinite(H).all():
            return None
        return BoardPlane(np.asarray(H, dtype=float), focal, camera)

    def pixels(self, steps: Array) -> Array:
        """Pixels (..., 2) of places (..., 2), as in `through`: steps right and down from the first, or metres."""
        flat = self._flat(steps)
        return flat if self.camera is None else self.camera.pixels(flat / self.focal)

    def seen(self, steps: Array) -> Array:
        """As `pixels`; nan where the camera does not see a place, since its distortion folds back."""
        assert self.camera is not None
        x = self._flat(steps) / self.focal
        within = np.linalg.norm(x, axis=-1, keepdims=True) < self.camera.ring
        return self.camera.pixels(np.where(within, x, np.nan))

    def _flat(self, steps: Array) -> Array:
        flat = cv2.perspectiveTransform(np.asarray(steps, dtype=float).reshape(-1, 1, 2), self.H)
        return np.asarray(flat, dtype=float).reshape(np.shape(steps))

    def jacobians(self, steps: Array) -> Array:
        """Derivatives (..., 2, 2) of pixels by steps, by central differences over a fifth of a step."""
        columns = [(self.pixels(steps + d) - self.pixels(steps - d)) / 0.2 for d in 0.1 * np.eye(2)]
        return np.stack(columns, axis=-1)

    def scales(self, steps: Array) -> Array:
        """Length (...) of a step in pixels: the geometric mean over directions."""
        return np.asarray(np.sqrt(np.abs(np.linalg.det(self.jacobians(steps)))))


def plane_through(
    grid: Array, camera: Camera | None, most_px: float, good: np.ndarray
) -> tuple[BoardPlane, Array] | None:
    """The plane of those corners (rows, columns, 2) that are `good`, and how far (rows, columns) each is off, pixels.

    It is fitted by least squares; if then a corner is off by more than `most_px`, by the least median of squares.
    """
    rows, columns = grid.shape[:2]
    squares: Array = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(float)
    found: tuple[BoardPlane, Array] | None = None
    for method in (0, cv2.LMEDS):
        plane = BoardPlane.through(squares[good], grid[good], camera, method)
        if plane is None:
            return None
        found = plane, np.asarray(np.linalg.norm(plane.pixels(squares) - grid, axis=-1))
        if (found[1][good] <= most_px).all():
            break
    return found


def evidence(gray: Gray, grid: Array, camera: Camera | None, good: np.ndarray | None = None) -> Evidence:
    """Test a board's inner corners (rows, columns, 2), pixels; without a camera, no distortion is assumed.

    `good` (rows, columns) says which corners were measured; the others are not used.
    """
    rows, columns = grid.shape[:2]
    counted = np.ones((rows, columns), dtype=bool) if good is None else good
    most_px = max(MOST_OFF_PX, MOST_OFF * smallest_step(grid))
    fitted = plane_through(grid, camera, most_px, counted)
    if fitted is None:
        return Evidence(Rejection.NOT_A_GRID, np.ones((rows, columns), dtype=bool))
    plane, off = fitted
    kept = counted & (off <= most_px)
    if not (kept.mean() >= LEAST_KEPT and all((kept.mean(axis=axis) > 0.5).all() for axis in (0, 1))):
        return Evidence(Rejection.NOT_A_GRID, np.ones((rows, columns), dtype=bool))
    values = _values(gray, plane, rows, columns)
    white = np.indices(values.shape).sum(axis=0) % 2 == 1
    inner = np.s_[2:-2, 2:-2]
    first_is_dark = bool(values[inner][white[inner]].mean() > values[inner][~white[inner]].mean())
    light = white if first_is_dark else ~white
    across, down = (_contrasts(values, light, axis) for axis in (1, 0))
    on_board = np.concatenate([across[1:-1, 1:-1].ravel(), down[1:-1, 1:-1].ravel()])
    if np.isnan(on_board).any():
        return Evidence(Rejection.NOT_WHOLE, kept)
    usual = float(np.median(on_board))
    if not (on_board >= LEAST_CONTRAST * usual).all() or usual <= 0.0:
        return Evidence(Rejection.SQUARES, kept)
    # The pattern goes on where a whole row or column beyond the board alternates in itself and with the outermost
    # squares.
    beyond = ((across[k, 1:-1], down[k, 1:-1]) for k in (0, -1))
    beside = ((down[1:-1, k], across[1:-1, k]) for k in (0, -1))
    if any((np.concatenate(pair) >= GOES_ON * usual).all() for pair in (*beyond, *beside)):
        return Evidence(Rejection.OTHER_SIZE, kept)
    return Evidence(None, kept, first_is_dark)


def smallest_step(grid: Array) -> float:
    """The smallest distance between neighbouring lines of a grid of corners (rows, columns, 2), pixels."""
    right, down = np.diff(grid, axis=1)[:-1], np.diff(grid, axis=0)[:, :-1]
    area = np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0])
    longest = np.maximum(np.linalg.norm(right, axis=-1), np.linalg.norm(down, axis=-1))
    return float((area / np.maximum(longest, 1e-9)).min())


def _values(gray: Gray, plane: BoardPlane, rows: int, columns: int) -> Array:
    """Gray values (rows + 3, columns + 3) of the squares and of one more square on each side; nan outside the image."""
    share = 0.5 + MIDDLE * ((np.arange(PER_SIDE) + 0.5) / PER_SIDE - 0.5)
    x = (np.arange(-2, columns + 1)[:, None] + share).ravel()
    y = (np.arange(-2, rows + 1)[:, None] + share).ravel()
    places = plane.pixels(np.stack(np.meshgrid(x, y), axis=-1))
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((places >= 0.0) & (places <= np.array(gray.shape[::-1]) - 1.0)).all(axis=-1))
    column, row = np.moveaxis(np.rint(np.where(inside[..., None], places, 0.0)).astype(int), -1, 0)
    samples = np.where(inside, gray[row, column], np.nan)
    squares = (
        samples.reshape(rows + 3, PER_SIDE, columns + 3, PER_SIDE).swapaxes(1, 2).reshape(rows + 3, columns + 3, -1)
    )
    return np.median(squares, axis=-1)


def _contrasts(values: Array, light: np.ndarray, axis: int) -> Array:
    """Michelson's contrasts of squares with their neighbours along an axis; negative if the dark one is lighter."""
    a, b = (np.delete(values, end, axis) for end in (-1, 0))
    sign = np.where(np.delete(light, -1, axis), 1.0, -1.0)
    difference = sign * (a - b)
    contrast: Array = np.where(difference < LEAST_GRAY, -1.0, difference / np.maximum(a + b, 1.0))
    return np.where(np.isnan(difference), np.nan, contrast)
