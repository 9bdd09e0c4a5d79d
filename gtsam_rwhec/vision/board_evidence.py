"""Whether corners are those of a checkerboard: each square, the outermost too, must be there, dark or light as printed.

A board one square off fits a homography as well as the right one. Its outermost squares lie on the paper's margin or
beyond, and do not alternate. A light falls on both of two neighbours, so that shade leaves the contrast
(light - dark) / (light + dark) between them (Michelson's) much as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.images import Gray
from gtsam_rwhec.vision.rejection import Rejection

#: A corner is off its place in the plane by at most this (pixels), or by `MOST_OFF` of the distance between lines.
MOST_OFF_PX = 0.5
MOST_OFF = 0.02
#: At least this share of the corners must be at their places; those that are not do not count. Of each row and column
#: more than half must be: a row that is not on the board is nowhere at its places.
LEAST_KEPT = 0.8
#: Two neighbouring squares have at least this share of the median contrast of all neighbours.
LEAST_CONTRAST = 0.3
#: Two neighbouring squares differ by at least this, in gray values.
LEAST_GRAY = 4.0
#: A row of squares goes on beyond the board if its squares have this share of the median contrast.
GOES_ON = 0.6
#: The gray value of a square is the median of PER_SIDE^2 samples in this part of it, about its middle.
MIDDLE, PER_SIDE = 0.5, 5


@dataclass(frozen=True, eq=False)
class FoundBoard:
    """Corners (n, 2) of a board, or centres of its circles; their indices (n,) in its rows from the top, and why they
    are not used.
    """

    corners_px: Array
    indices: np.ndarray
    rejection: Rejection | None


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the image says about a grid of corners.

    Attributes
    ----------
    rejection : Rejection or None
        Why the corners are not the board's; None if they are.
    kept : (rows, columns) array of bool
        Which corners are at their places in the plane; a shadow's edge or dirt moves a few.
    first_is_dark : bool
        Whether the first corner's outer square is dark.
    """

    rejection: Rejection | None
    kept: np.ndarray
    first_is_dark: bool = True


def evidence(gray: Gray, grid: Array, camera: Camera | None) -> Evidence:
    """Test a board's inner corners (rows, columns, 2), pixels; without a camera, as one of no distortion."""
    rows, columns = grid.shape[:2]
    plane = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(float)
    seen = grid.reshape(-1, 2)
    focal = 1.0 if camera is None else 0.5 * float(camera.K[0, 0] + camera.K[1, 1])
    flat = seen if camera is None else camera.undistort(seen) * focal
    most_px = max(MOST_OFF_PX, MOST_OFF * smallest_step(grid))
    none_left_out = np.ones((rows, columns), dtype=bool)
    H: Array = np.eye(3)
    off: Array = np.full(len(seen), np.inf)
    for method in (0, cv2.LMEDS):  # least squares of all; where some are off, the median's homography finds which
        fitted = _homography(plane, flat, method)
        if fitted is None:
            return Evidence(Rejection.NOT_A_GRID, none_left_out)
        H, off = fitted, np.linalg.norm(_pixels(plane, fitted, focal, camera) - seen, axis=1)
        if (off <= most_px).all():
            break
    kept = (off <= most_px).reshape(rows, columns)
    if not (kept.mean() >= LEAST_KEPT and all((kept.mean(axis=axis) > 0.5).all() for axis in (0, 1))):
        return Evidence(Rejection.NOT_A_GRID, none_left_out)
    values = _values(gray, H, focal, camera, rows, columns)
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
    # Beyond the board, where all of a row or column of squares alternates on and against the outermost squares.
    beyond = ((across[k, 1:-1], down[k, 1:-1]) for k in (0, -1))
    beside = ((down[1:-1, k], across[1:-1, k]) for k in (0, -1))
    if any((np.concatenate(pair) >= GOES_ON * usual).all() for pair in (*beyond, *beside)):
        return Evidence(Rejection.OTHER_SIZE, kept)
    return Evidence(None, kept, first_is_dark)


def _homography(plane: Array, flat: Array, method: int) -> Array | None:
    """The homography (3, 3) from the board to pixels without distortion; None where there is none."""
    H = cv2.findHomography(plane, flat, method)[0] if np.isfinite(flat).all() else None
    return None if H is None or not np.isfinite(H).all() else np.asarray(H, dtype=float)


def smallest_step(grid: Array) -> float:
    """The smallest distance between neighbouring lines of a grid of corners (rows, columns, 2), pixels."""
    right, down = np.diff(grid, axis=1)[:-1], np.diff(grid, axis=0)[:, :-1]
    area = np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0])
    longest = np.maximum(np.linalg.norm(right, axis=-1), np.linalg.norm(down, axis=-1))
    return float((area / np.maximum(longest, 1e-9)).min())


def _pixels(plane: Array, H: Array, focal: float, camera: Camera | None) -> Array:
    """Pixels (..., 2) of places (..., 2) on the board, in squares from the first corner."""
    flat: Array = np.asarray(cv2.perspectiveTransform(plane.reshape(-1, 1, 2), H), dtype=float).reshape(plane.shape)
    return flat if camera is None else camera.pixels(flat / focal)


def _values(gray: Gray, H: Array, focal: float, camera: Camera | None, rows: int, columns: int) -> Array:
    """Gray values (rows + 3, columns + 3) of the squares and of one more square on each side; nan outside the image."""
    share = 0.5 + MIDDLE * ((np.arange(PER_SIDE) + 0.5) / PER_SIDE - 0.5)
    x = (np.arange(-2, columns + 1)[:, None] + share).ravel()
    y = (np.arange(-2, rows + 1)[:, None] + share).ravel()
    places = _pixels(np.stack(np.meshgrid(x, y), axis=-1), H, focal, camera)
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((places >= 0.0) & (places <= np.array(gray.shape[::-1]) - 1.0)).all(axis=-1))
    column, row = np.moveaxis(np.rint(np.where(inside[..., None], places, 0.0)).astype(int), -1, 0)
    samples = np.where(inside, gray[row, column], np.nan)
    squares = (
        samples.reshape(rows + 3, PER_SIDE, columns + 3, PER_SIDE).swapaxes(1, 2).reshape(rows + 3, columns + 3, -1)
    )
    found: Array = np.median(squares, axis=-1)
    return found


def _contrasts(values: Array, light: np.ndarray, axis: int) -> Array:
    """Michelson's contrasts of squares with their neighbours along an axis; negative if the dark one is lighter."""
    a, b = (np.delete(values, end, axis) for end in (-1, 0))
    sign = np.where(np.delete(light, -1, axis), 1.0, -1.0)
    difference = sign * (a - b)
    contrast: Array = np.where(difference < LEAST_GRAY, -1.0, difference / np.maximum(a + b, 1.0))
    return np.where(np.isnan(difference), np.nan, contrast)
