"""Blobs of an image that look like circles, and the lattices that they make.

The image of a circle shows how its surroundings are foreshortened. Where a circle's image is round again, its four
neighbours are equally far and at right angles, at any tilt: from such a circle a lattice grows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gtsam_rwhec.cameras.targets import CircleGrid
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.geometry.poses import Array

#: Images with a larger side than this are searched at half their size first.
LARGE_PX = 1000
#: Images are blurred with this standard deviation (pixels) before blobs are looked for: noise has no ellipses then.
STEADY_PX = 0.8
#: Sides of the squares against whose means blobs are dark or light, pixels: most circles are found with the first. The
#: smaller one is for circles near the edge of a board before another background.
AROUND_PX = (31, 101, 15, 251)
#: Blobs have at least this area (pixels).
LEAST_AREA_PX = 12.0
#: A blob fills at least this share of its convex hull, and its area is that of its ellipse within this share.
FILLED, LIKE_ELLIPSE = 0.85, 0.15
#: The axes of an ellipse: the shorter one is at least this share of the longer one.
LEAST_ROUND = 0.1
#: A pixel is dark (light) if it differs from the mean of its surroundings by this many gray values.
DIFFERS = 6.0
#: Neighbours on a lattice have areas within this factor; one of them may be a larger dot.
LIKE_AREA = 4.0
#: The four nearest of a circle are its neighbours if distances and right angles fit within these shares of a distance.
SEED_OFF = 0.3
#: A circle is at its place in the lattice within this share of a step from where its neighbours predict it.
GROWN_OFF = 0.3
#: At most this number of circles have the four neighbours from which lattices start: those with the best-fitting ones.
MOST_SEEDS = 60
#: Among more blobs than this no lattice is looked for.
MOST_BLOBS = 1500
#: At most this share of a board's circles may be missing among the blobs, and less than half of each row and column.
MOST_MISSING = 0.25


@dataclass(frozen=True, eq=False)
class Ellipses:
    """Blobs: places (n, 2), pixels, and shapes S (n, 2, 2), pixels squared: the outline is x' S^-1 x = 1."""

    places: Array
    shapes: Array

    def with_more(self, others: Ellipses) -> Ellipses:
        """These, and those of the others that are elsewhere: not within the radii of one of these and of its own."""
        if not (len(self.places) and len(others.places)):
            return self if len(self.places) else others
        apart = np.linalg.norm(others.places[:, None] - self.places, axis=-1)
        new = (apart > np.sqrt(np.minimum(others.areas[:, None], self.areas))).all(axis=1)
        return Ellipses(
            np.concatenate([self.places, others.places[new]]), np.concatenate([self.shapes, others.shapes[new]])
        )

    @property
    def areas(self) -> Array:
        """(n,): over pi, pixels squared."""
        return np.asarray(np.sqrt(np.linalg.det(self.shapes)))


NONE = Ellipses(np.zeros((0, 2)), np.zeros((0, 2, 2)))


def blobs_in(gray: Gray) -> Iterator[tuple[Ellipses, bool]]:
    """Dark blobs, then light ones, more and more of them; and whether they are in pixels of half the image's size."""
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
            yield from ((blobs, halved) for blobs in (dark, light))


def ellipses(gray: Gray, around_px: int, *, light: bool) -> Ellipses:
    """Dark or light blobs that look like ellipses, against the mean of a square of `around_px` pixels."""
    mean = cv2.blur(gray, (around_px, around_px), borderType=cv2.BORDER_REPLICATE)
    differs = cv2.subtract(gray, mean) if light else cv2.subtract(mean, gray)
    contours, tree = cv2.findContours((differs > DIFFERS).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    # Of a circle that is larger than its surroundings only the rim differs: the rim's outer outline counts.
    outer = [contour for contour, node in zip(contours, tree[0] if contours else (), strict=True) if node[3] < 0]
    largest = gray.size / 9.0
    places, shapes = [], []
    for contour in outer:
        if len(contour) < 8:
            continue
        m = cv2.moments(contour)
        area = m["m00"]
        if not LEAST_AREA_PX <= area <= largest:
            continue
        a, b, c = m["mu20"] / area, m["mu11"] / area, m["mu02"] / area
        of_ellipse = 4.0 * np.pi * np.sqrt(max(a * c - b * b, 0.0))
        if abs(area - of_ellipse) > LIKE_ELLIPSE * area or 2.0 * np.sqrt(a * c - b * b) < LEAST_ROUND * (a + c):
            continue
        if area < FILLED * cv2.contourArea(cv2.convexHull(contour)):
            continue
        places.append((m["m10"] / area, m["m01"] / area))
        shapes.append(((4.0 * a, 4.0 * b), (4.0 * b, 4.0 * c)))
    return Ellipses(np.array(places, float).reshape(-1, 2), np.array(shapes, float).reshape(-1, 2, 2))


def grids(blobs: Ellipses, board: CircleGrid) -> Iterator[tuple[Array, Array]]:
    """Places (rows, columns, 2) and mean radii (rows, columns) of grids like the board's among the blobs, pixels.

    They are nan where a circle is missing among the blobs: it may be there all the same. A grid that looks the same
    turned comes in one of its ways only.
    """
    if not (1.0 - MOST_MISSING) * board.columns * board.rows <= len(blobs.places) <= MOST_BLOBS:
        return
    for members, cells in grown_lattices(blobs):
        for which in _placed(members, cells, board):
            there = which >= 0
            yield (
                np.where(there[..., None], blobs.places[which], np.nan),
                np.where(there, np.sqrt(blobs.areas[which]), np.nan),
            )


def grown_lattices(blobs: Ellipses) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Lattices of blobs, those whose seeds fit best first: which blobs (m,), and their cells (m, 2)."""
    taken = np.zeros(len(blobs.places), dtype=bool)
    for seed, first, second in _seeds(blobs):
        if not taken[seed]:
            members, cells = _grown(blobs, seed, first, second)
            taken[members] = True
            yield members, cells


def _seeds(blobs: Ellipses) -> Iterator[tuple[int, Array, Array]]:
    """Blobs with four neighbours on a lattice, those that fit best first, with the two steps to neighbours, pixels."""
    n = len(blobs.places)
    if n < 5:
        return
    # Round again: the image of a circle is where |root x| = 1.
    roots = np.linalg.cholesky(np.linalg.inv(blobs.shapes)).swapaxes(1, 2)
    areas = blobs.areas
    between = blobs.places - blobs.places[:, None]
    near = between @ roots.swapaxes(1, 2)
    distance = np.linalg.norm(near, axis=-1)
    distance[(areas > LIKE_AREA * areas[:, None]) | (LIKE_AREA * areas < areas[:, None]) | np.eye(n, dtype=bool)] = (
        np.inf
    )
    four = np.argpartition(distance, 3, axis=1)[:, :4]
    near = np.take_along_axis(near, four[..., None], axis=1)
    order = np.argsort(np.arctan2(near[..., 1], near[..., 0]), axis=1)  # a right angle after the other
    four, near = np.take_along_axis(four, order, axis=1), np.take_along_axis(near, order[..., None], axis=1)
    v = near / np.take_along_axis(distance, four, axis=1).mean(axis=1)[:, None, None]
    quarter = np.array([[0.0, 1.0], [-1.0, 0.0]])
    with np.errstate(invalid="ignore"):
        off = np.abs(np.concatenate([v[:, :2] + v[:, 2:], v[:, 1:3] - v[:, :2] @ quarter], axis=1)).max(axis=(1, 2))
    for i in np.argsort(off)[:MOST_SEEDS].tolist():
        if off[i] < SEED_OFF:
            a, b, c, d = between[i, four[i]]
            steps = 0.5 * np.array([a - c, b - d])
            if np.linalg.det(steps) > 1.0:
                yield i, steps[0], steps[1]


def _grown(blobs: Ellipses, seed: int, first: Array, second: Array) -> tuple[np.ndarray, np.ndarray]:
    """Blobs (m,) and their cells (m, 2) on the lattice that grows from one of them by two steps, pixels."""
    cell_of = {seed: (0, 0)}
    at = {(0, 0): seed}
    frontier = [(seed, first, second)]
    areas = blobs.areas
    while frontier:
        members = np.array([member for member, _, _ in frontier])
        bases = np.array([[a, b] for _, a, b in frontier])  # (f, 2, 2): rows are steps
        # (f, 4, 2): predicted neighbours, and how far each blob is from them in steps.
        predicted = blobs.places[members][:, None] + np.concatenate([bases, -bases], axis=1)
        inverse = np.linalg.inv(bases)
        off = np.linalg.norm((blobs.places - predicted[:, :, None]) @ inverse[:, None], axis=-1)
        ratio = areas / areas[members][:, None]
        off[np.broadcast_to(((ratio > LIKE_AREA) | (ratio < 1.0 / LIKE_AREA))[:, None], off.shape)] = np.inf
        nearest = np.argmin(off, axis=-1)
        smallest = np.take_along_axis(off, nearest[..., None], axis=-1)[..., 0]
        grown = []
        for k, d in sorted(np.argwhere(smallest < GROWN_OFF).tolist(), key=lambda kd: float(smallest[kd[0], kd[1]])):
            member, new = int(members[k]), int(nearest[k, d])
            sign, axis = (1, d) if d < 2 else (-1, d - 2)
            cell = cell_of[member]
            cell = (cell[0] + sign, cell[1]) if axis == 0 else (cell[0], cell[1] + sign)
            if new in cell_of or cell in at:
                continue
            cell_of[new], at[cell] = cell, new
            steps = bases[k].copy()
            steps[axis] = sign * (blobs.places[new] - blobs.places[member])
            if np.linalg.det(steps) > 1.0:
                grown.append((new, steps[0], steps[1]))
        frontier = grown
    return np.array(list(cell_of)), np.array(list(cell_of.values()))


def _placed(members: np.ndarray, cells: np.ndarray, board: CircleGrid) -> Iterator[np.ndarray]:
    """Which blobs (rows, columns) may be the board's circles, -1 where one is missing; those that miss least first."""
    steps = board.steps().astype(int)
    if board.asymmetric:  # in steps to the lower right and to the lower left
        steps = np.stack([(steps[..., 0] + steps[..., 1]) // 2, (steps[..., 1] - steps[..., 0]) // 2], axis=-1)
    low = cells.min(axis=0)
    extent = cells.max(axis=0) - low + 1
    pad = np.ptp(steps.reshape(-1, 2), axis=0).max() + 1
    table = np.full(extent + 2 * pad, -1)
    table[tuple((cells - low + pad).T)] = members
    found: list[tuple[int, int, np.ndarray]] = []
    count = board.columns * board.rows
    turn = np.array([[0, -1], [1, 0]])
    for quarters in range(4 // replace(board, larger_dot=False).ways):  # the larger dot is looked for later
        turned = steps @ np.linalg.matrix_power(turn, quarters).T
        turned = turned - turned.reshape(-1, 2).min(axis=0)
        span = turned.reshape(-1, 2).max(axis=0) + 1
        # Cells may be missing at the border.
        for x in range(pad - 1, pad + extent[0] - span[0] + 2):
            for y in range(pad - 1, pad + extent[1] - span[1] + 2):
                which = table[turned[..., 0] + x, turned[..., 1] + y]
                there = which >= 0
                missing = count - int(there.sum())
                if missing <= MOST_MISSING * count and all((there.mean(axis=axis) > 0.5).all() for axis in (0, 1)):
                    found.append((missing, len(found), which))
    for _, _, which in sorted(found, key=lambda one: one[:2]):
        yield which
