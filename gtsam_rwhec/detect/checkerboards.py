"""Checkerboards: lattices of saddles, tested square by square, their corners measured by a model of the edges.

Of 346 rendered boards (whole, squares of 12 pixels and more, blur to 1.5 pixels, shade) lattices of saddles give 342
that pass the test (`board_evidence`), and none wrong; OpenCV's classic detector reads 288 and its sector-based one 296,
each with boards read one square off or turned. The error of corners is 0.017 pixels by the model of the edges, and
0.057 by ``cornerSubPix``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.special import ndtr

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.detect.board_evidence import LEAST_KEPT, Evidence, FoundBoard, evidence, plane_through, smallest_step
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.detect.saddle_lattices import LEVELS, boards_in, groups_of, lattices, saddles, scaled_down
from gtsam_rwhec.geometry.poses import Array

#: Rough corners, before they are measured, may be off their places in a plane by this (pixels), or by this share of the
#: distance between lines: a shadow's edge moves them.
ROUGHLY_PX, ROUGHLY = 1.0, 0.06
#: If at least this share of the corners is sharp, the others are not used.
LEAST_SHARP = 0.5


def find_checkerboard(gray: Gray, board: Checkerboard, camera: Camera | None = None) -> FoundBoard | None:
    """Find a board that is whole in the image; None where there is none.

    The top is where the first corner's outer square is black. A board whose two numbers of corners are both even or
    both odd looks the same after half a turn; it is read in one of these two ways. If one image has two such boards,
    neither is used, because nothing distinguishes them. A mirrored board cannot be recognised in one image: its pattern
    is that of the board, turned. (If both numbers are odd and differ, it is that of a board with its colours
    exchanged.)
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
    """Grids of corners (rows, columns, 2) from lattices of saddles, and whether a lattice goes on beyond its grid."""
    corners = board.columns * board.rows
    seen = saddles(scaled_down(gray, level))
    for members in groups_of(seen.places, corners):
        for lattice in lattices(seen, members, corners):
            for grid, goes_on in boards_in(lattice, seen.places, board.rows, board.columns):
                # Pixel centres are integers: the first pixel of an image halved once has its centre at 1/2 of the full
                # image.
                yield grid * 2**level + 0.5 * (2**level - 1), goes_on


def _tested(gray: Gray, grid: Array, camera: Camera | None) -> FoundBoard:
    if not ((grid >= 0.0) & (grid <= np.array(gray.shape[::-1]) - 1.0)).all():
        return FoundBoard(grid.reshape(-1, 2), np.arange(grid.size // 2), Rejection.NOT_WHOLE)
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0.0:  # a mirror image: a board is not seen from behind
        grid = grid[::-1]
    refined, seen = _measured(gray, grid, camera)
    kept = seen.kept
    if not seen.first_is_dark:
        refined, kept = _other_colour(refined), _other_colour(kept)
    return FoundBoard(refined[kept], np.flatnonzero(kept), seen.rejection)


def _measured(gray: Gray, rough: Array, camera: Camera | None) -> tuple[Array, Evidence]:
    """Corners (rows, columns, 2), measured where the plane through most rough corners predicts them, and their
    evidence.
    """
    rows, columns = rough.shape[:2]
    everyone = np.ones((rows, columns), dtype=bool)
    most_px = max(ROUGHLY_PX, ROUGHLY * smallest_step(rough))
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


#: An edge is used up to this share of a square from the corner, but not within `BLURS` blurs of the next edge.
REACH, BLURS = 0.75, 2.5
#: An edge is used at least over this share of a square, and at most over this many pixels.
LEAST_REACH, REACH_PX = 0.4, 12
#: Blur in the first round, and its limits, pixels.
BLUR_PX, LEAST_BLUR_PX, MOST_BLUR_PX = 1.0, 0.3, 4.0
#: At most this number of pixels around a corner is used.
MOST_PIXELS = 400
#: Gauss-Newton rounds: first in windows where corners are expected, then in windows where they were found.
ROUNDS = (2, 3)
#: A step changes a place by at most this share of a square.
MOST_STEP = 0.1
#: A corner is found at most this share of a square from where it was expected.
MOST_MOVED = 0.3
#: A residual of this share of half the contrast, or of this many times the residuals' mean size, weighs a quarter.
OUTLYING, OUTLYING_MEANS = 0.08, 3.0
#: Residuals' root mean square over half the contrast is at most this.
MOST_LEFT = 0.5
#: For a sharp corner this value is at most `LEFT`, or at most `LEFT_MEDIANS` times the board's median: noise is in all
#: windows, a shadow's edge only in a few.
LEFT, LEFT_MEDIANS = 0.1, 2.0


@dataclass(frozen=True, eq=False)
class FittedCorners:
    """Corners of a board."""

    corners_px: Array  #: (rows, columns, 2): pixels
    good: np.ndarray  #: (rows, columns): whether there is a corner, near where it was expected
    #: (rows, columns): whether the model fits all of the window; good corners that are not sharp may be off by 0.1
    #: pixels and more
    sharp: np.ndarray
    blur_px: Array  #: (rows, columns): standard deviation of the blur, pixels


def fitted_corners(gray: Gray, on_image: Callable[[Array], Array], rows: int, columns: int) -> FittedCorners:
    """Fit two blurred edges that cross to the gray values around each corner of a board.

    An edge is used over three quarters of a square on each side, along the curves that the plane and the lens give it.
    The model's light changes linearly, separately for paper and ink. Pixels that do not fit, as at a shadow's edge,
    weigh little; a corner where many do not fit is not sharp.

    ``on_image`` takes places (..., 2) on the board, in squares to the right and down from the first corner, to pixels
    (..., 2) that are right to one or two pixels.
    """
    first = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(float)
    at, sigma = first, None
    good = np.ones(len(at), dtype=bool)
    for rounds in ROUNDS:
        fit = _started(gray, on_image, at, sigma)
        for _ in range(rounds):
            fit.step()
        place = fit.place()
        good &= (np.abs(at + place - first) < MOST_MOVED).all(axis=1) & fit.inside.any(axis=1)
        at, sigma = np.where(good[:, None], at + place, first), fit.sigma
    usual = float(np.median(fit.left))
    good &= fit.left <= MOST_LEFT
    sharp = good & (fit.left <= max(LEFT, LEFT_MEDIANS * usual))
    shape = (rows, columns)
    blur = np.sqrt(np.prod(fit.sigma / fit.slope, axis=1))
    return FittedCorners(
        on_image(at).reshape(*shape, 2), good.reshape(shape), sharp.reshape(shape), blur.reshape(shape)
    )


def _started(gray: Gray, on_image: Callable[[Array], Array], at: Array, sigma: Array | None) -> _Fit:
    """The fit in windows around places (n, 2) on the board. Where light is not linear, the corner must be in the
    middle.
    """
    centre, J, bend = _expansion(on_image, at)
    inverse = np.linalg.inv(J)  # of squares by pixels
    slope = np.linalg.norm(inverse, axis=2)  # (n, 2): squares a pixel across the edges
    half = int(np.clip(np.ceil(REACH * np.abs(J).sum(axis=2).max()), 3, REACH_PX))
    offset = np.stack(np.meshgrid(*2 * [np.arange(-half, half + 1)]), axis=-1).reshape(-1, 2)
    pixel = np.rint(centre).astype(int)[:, None] + offset
    limit = np.array(gray.shape[::-1]) - 1
    inside = ((pixel >= 0) & (pixel <= limit)).all(axis=-1)
    column, row = np.moveaxis(np.clip(pixel, 0, limit), -1, 0)
    away = pixel - centre[:, None]
    flat = away @ inverse.swapaxes(1, 2)
    products = np.stack([0.5 * flat[..., 0] ** 2, flat[..., 0] * flat[..., 1], 0.5 * flat[..., 1] ** 2], axis=-1)
    curved = products @ bend[:, [0, 0, 1], [0, 1, 1]]
    flat = (away - curved) @ inverse.swapaxes(1, 2)  # (n, p, 2): squares from the place
    inside &= (np.abs(flat) <= REACH).all(axis=2)
    # Pixels nearest to an edge have the most information.
    near = np.where(inside, (np.abs(flat) / slope[:, None]).min(axis=2), np.inf)
    most = int(np.clip(inside.sum(axis=1).max(), 1, MOST_PIXELS))
    chosen = np.argpartition(near, most - 1, axis=1)[:, :most]
    values, u, v, inside = (
        np.take_along_axis(of, chosen, axis=1) for of in (gray[row, column], flat[..., 0], flat[..., 1], inside)
    )
    return _Fit(values, u, v, inside, slope, BLUR_PX * slope if sigma is None else sigma)


class _Fit:
    """gray = l0 + l1 u + l2 v + (l3 + l4 u + l5 v) s(u - a - b v) s(v - c - d u), with s the blurred sign."""

    def __init__(self, values: Array, u: Array, v: Array, inside: np.ndarray, slope: Array, sigma: Array) -> None:
        n, p = values.shape
        self.values, self.inside = values.astype(np.float32), inside
        self.flat = np.stack([u, v], axis=1).astype(np.float32)  # (n, 2, p)
        self.slope = slope
        self.sigma = sigma
        self.edges = np.zeros((n, 2, 2))  # (a, b), (c, d)
        self.left = np.full(n, np.inf)
        self.residual, self.outlying = np.zeros((n, p), np.float32), np.ones(n)
        #: Derivatives of the gray values (n, 12, p): by l0 to l5, a, c, b, d and both blurs.
        self.basis = np.ones((n, 12, p), np.float32)
        self.basis[:, 1:3] = self.flat

    def step(self) -> None:
        """One round: light and ink by least squares, then a step of edges and blur."""
        basis, other = self.basis, self.flat[:, ::-1]
        sigma = self.sigma[..., None].astype(np.float32)
        a, b = (self.edges[..., i, None].astype(np.float32) for i in range(2))
        across = (self.flat - a - b * other) / sigma  # (n, 2, p)
        sign = 2.0 * ndtr(across) - 1.0
        np.multiply(basis[:, :3], sign.prod(axis=1, keepdims=True), out=basis[:, 3:6])
        reach = np.clip(np.minimum(REACH, 1.0 - BLURS * self.sigma), LEAST_REACH, REACH)[..., None]
        used = self.inside & (np.abs(self.flat) <= reach).all(axis=1)
        # Pixels that did not fit in the previous round weigh little.
        weight = (used / (1.0 + (self.residual / self.outlying[:, None]) ** 2) ** 2).astype(np.float32)
        linear = basis[:, :6]
        weighed = linear * weight[:, None]
        solved = _solved(weighed @ linear.swapaxes(1, 2), weighed @ self.values[..., None])[..., 0]
        residual = self.values - (solved[:, None].astype(np.float32) @ linear)[:, 0]
        contrast = np.abs(solved[:, 3])
        steep = np.exp(-0.5 * across**2) * (np.float32(-np.sqrt(2.0 / np.pi)) / sigma)
        steep *= (solved[:, None, 3:].astype(np.float32) @ basis[:, :3]) * sign[:, ::-1]
        basis[:, 6:8] = steep
        np.multiply(steep, other, out=basis[:, 8:10])
        np.multiply(steep, across, out=basis[:, 10:12])
        weighed = basis * weight[:, None]
        change = _solved(weighed @ basis.swapaxes(1, 2), weighed @ residual[..., None])[:, 6:, 0]
        self.edges += np.clip(change[:, :4].reshape(-1, 2, 2).swapaxes(1, 2), -MOST_STEP, MOST_STEP)
        limited = np.clip(change[:, 4:], -0.5 * self.sigma, 0.5 * self.sigma)
        self.sigma = np.clip(self.sigma + limited, LEAST_BLUR_PX * self.slope, MOST_BLUR_PX * self.slope)
        count = np.maximum(used.sum(axis=1), 1)
        self.left = np.sqrt((used * residual**2).sum(axis=1) / count) / np.maximum(contrast, 1e-9)
        usual = (used * np.abs(residual)).sum(axis=1) / count
        self.residual, self.outlying = residual, np.maximum(OUTLYING * contrast, OUTLYING_MEANS * usual) + 1e-9

    def place(self) -> Array:
        """(n, 2) where the edges cross, squares."""
        (a, b), (c, d) = self.edges.transpose(1, 2, 0)
        return np.asarray(np.stack([a + b * c, c + d * a], axis=-1) / (1.0 - b * d)[:, None], dtype=float)


def _solved(normal: Array, right: Array) -> Array:
    """Solutions (n, k, 1); the diagonal grows by a share of 1e-6, for windows that do not determine an unknown."""
    diagonal = np.einsum("nii->ni", normal)
    ridge = (1e-6 * diagonal + 1e-6)[..., None] * np.eye(normal.shape[-1])
    return np.asarray(np.linalg.solve(normal + ridge, right.astype(float)), dtype=float)


def _expansion(on_image: Callable[[Array], Array], at: Array) -> tuple[Array, Array, Array]:
    """Pixels (n, 2) at places, first derivatives J (n, 2, 2), second derivatives (n, 2, 2, 2) with axes (by i, by j,
    pixel).
    """
    h = 0.25
    e = h * np.eye(2)
    centre = on_image(at)
    plus, minus = (np.stack([on_image(at + sign * e[i]) for i in range(2)], axis=1) for sign in (1.0, -1.0))
    J = ((plus - minus) / (2.0 * h)).swapaxes(1, 2)
    bend = np.zeros((len(at), 2, 2, 2))
    bend[:, [0, 1], [0, 1]] = (plus + minus - 2.0 * centre[:, None]) / h**2
    both = (on_image(at + e[0] + e[1]) + on_image(at - e[0] - e[1]) - on_image(at + e[0] - e[1])) - on_image(
        at - e[0] + e[1]
    )
    bend[:, 0, 1] = bend[:, 1, 0] = both / (4.0 * h**2)
    return centre, J, bend
