"""Grids of circles: lattices of ellipses, tested against the board, turned by its larger dot; and their centres.

A lattice (`circle_lattices`) with a wrong circle, one circle off, or of another size must not count: every circle must
be there and have its size, and all but a few lie on one plane's grid. The image of a circle's centre is not the centre
of its image (Heikkila 2000, section 3.1): by how much the projected outline's centroid is off the projected centre is
subtracted from the measured centroid.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import CircleGrid
from gtsam_rwhec.detect.board_evidence import BoardPlane, FoundBoard, smallest_step
from gtsam_rwhec.detect.circle_lattices import blobs_in, grids
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.geometry.poses import Array

#: A circle's outline is a polygon of this many points: its centroid is exact for an ellipse.
OUTLINE = 32
#: The background is seen beyond this share of the way from a circle's edge to half way to its neighbour's.
RING = 0.5
#: The part of a circle's radius inside which its contrast is measured.
MIDDLE = 0.6
#: Light changes within a circle by 0.3 % a pixel, and noise is 2 % of it: the squared quotient (pixels squared).
STEADY = 44.0
#: Light falls to this share of its value in the middle of a circle at most.
LEAST_LIT = 0.2
#: A window with a larger half side than this (pixels) is sampled at every second pixel, or third, and so on.
LARGEST_WINDOW_PX = 32
#: Pixels further away than this are nowhere near an image.
FAR_PX = 1e5


@dataclass(frozen=True, eq=False)
class Circles:
    """Circles (...) as they are in an image."""

    seen_px: Array  #: (..., 2): centroids of the gray values, pixels
    centres_px: Array  #: (..., 2): images of the circles' centres, pixels
    radii: Array  #: (...): in steps of the grid, from the areas
    contrasts: Array  #: (...): (background - circle) / the lighter of the two; negative if that is the circle
    #: (...): by how much the light on the background around a circle is off a plane: root mean square, as a share of
    #: it. Where a shadow's edge crosses a circle, its centroid is off.
    uneven: Array
    seen: np.ndarray  #: (...): whether a circle is whole in the image and its numbers are finite


def measured_circles(gray: Gray, plane: BoardPlane, steps: Array, about_px: Array, radii: Array) -> Circles:
    """Measure circles at places (..., 2) of the grid, near pixels about_px (..., 2), with about these radii (...).

    Around each, a plane is fitted to the gray values between it and its neighbours: light that changes across a circle
    would move its centroid.
    """
    shape = np.shape(radii)
    steps, about, r = steps.reshape(-1, 2), about_px.reshape(-1, 2), np.clip(radii.ravel(), 0.02, 0.9)
    edge = r + 0.5 * _gaps(steps, r)
    J = plane.jacobians(steps)
    with np.errstate(invalid="ignore"):
        usable = np.asarray((np.abs(about) < FAR_PX).all(axis=1) & (np.abs(J) < FAR_PX).all(axis=(1, 2)))
        usable &= np.abs(np.linalg.det(np.where(usable[:, None, None], J, np.eye(2)))) > 1e-9
    J, about = np.where(usable[:, None, None], J, np.eye(2)), np.where(usable[:, None], about, 0.0)
    reach = edge * np.linalg.norm(J, ord=2, axis=(1, 2))
    moved, whole = np.zeros((len(r), 2)), np.zeros(len(r), bool)
    total, contrast, uneven = np.zeros((3, len(r)))
    small = reach <= 1.3 * np.median(reach)
    for group in (small, ~small):  # the larger dot's window is not everyone's
        if group.any():
            seen_here = _shaded(gray, about[group], J[group], r[group], edge[group], float(reach[group].max()))
            moved[group], total[group], contrast[group], uneven[group], whole[group] = seen_here
    area, astray = _outlines(plane, steps, r)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = r * np.sqrt(np.maximum(total / contrast, 0.0) / area)
        # A centroid outside its circle is not one: the shade around it has both signs.
        seen = whole & usable & (np.linalg.norm(moved, axis=1) < reach) & np.isfinite(found) & np.isfinite(astray[:, 0])
    centroid = about + moved
    return Circles(
        centroid.reshape(*shape, 2), (centroid - astray).reshape(*shape, 2), found.reshape(shape),
        contrast.reshape(shape), uneven.reshape(shape), seen.reshape(shape),
    )  # fmt: skip


def _shaded(
    gray: Gray, about: Array, J: Array, r: Array, edge: Array, reach_px: float
) -> tuple[Array, Array, Array, Array, np.ndarray]:
    """Centroids (n, 2) from `about`, sums (n,) of shade, contrasts (n,), and whether circles are whole in the image.

    A pixel's shade is (background - gray) / light. How the light falls is seen on the lighter of circle and background:
    a dark background's values, by which noise would be divided, say little.
    """
    stride = int(np.ceil((reach_px + 1.0) / LARGEST_WINDOW_PX))
    half = int(np.ceil((reach_px + 1.0) / stride))
    offset = stride * np.stack(np.meshgrid(*2 * [np.arange(-half, half + 1)]), axis=-1).reshape(-1, 2)
    at = np.rint(about).astype(int)[:, None] + offset
    limit = np.array(gray.shape[::-1]) - 1
    inside = ((at >= 0) & (at <= limit)).all(axis=-1)
    column, row = np.moveaxis(np.clip(at, 0, limit), -1, 0)
    values = gray[row, column].astype(float)
    there = at - about[:, None]
    away = np.linalg.norm(there @ np.linalg.inv(J).swapaxes(1, 2), axis=-1)  # in steps of the grid
    near = (away <= edge[:, None]) & inside
    ring = near & (away >= (r + RING * (edge - r))[:, None])
    whole = (inside | (away > r[:, None])).all(axis=1) & (ring.sum(axis=1) >= 6)
    core = (away <= MIDDLE * r[:, None]) & inside
    basis = np.concatenate([np.ones((*there.shape[:2], 1)), there], axis=2)
    of_ground, of_circle = _light(values, basis, ring, 1e-9), _light(values, basis, core, STEADY)
    ground = (basis @ of_ground[..., None])[..., 0]
    lighter = np.where(of_circle[:, :1] > of_ground[:, :1], of_circle, of_ground)
    lit = np.maximum((basis @ lighter[..., None])[..., 0], np.maximum(LEAST_LIT * lighter[:, :1], 1.0))
    shade = np.where(near, (ground - values) / lit, 0.0)
    contrast = (shade * core).sum(axis=1) / np.maximum(core.sum(axis=1), 1)
    total = shade.sum(axis=1)
    squared = (((ground - values) / lit) ** 2 * ring).sum(axis=1)
    uneven = np.sqrt(squared / np.maximum(ring.sum(axis=1), 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = np.nan_to_num((shade[..., None] * there).sum(axis=1) / total[:, None], nan=np.inf)
    return moved, stride**2 * total, contrast, uneven, whole


def _light(values: Array, basis: Array, where: np.ndarray, steady: float) -> Array:
    """The planes (n, 3) that fit gray values (n, p) best in some of the pixels; basis (n, p, 3) has 1, du, dv."""
    weighed = (basis * where[..., None]).swapaxes(1, 2)
    normal = weighed @ basis + np.diag([1e-9, steady, steady])
    return np.linalg.solve(normal, weighed @ values[..., None])[..., 0]


def _gaps(steps: Array, radii: Array) -> Array:
    """From each circle's edge to the nearest one's (n,), in steps; at least a twentieth.

    At most as far as in a symmetric grid: half a step from the outer circles' centres a board may end.
    """
    apart = np.linalg.norm(steps[:, None] - steps, axis=-1) - radii[:, None] - radii
    np.fill_diagonal(apart, np.inf)
    return np.asarray(np.clip(apart.min(axis=1), 0.05, np.maximum(1.0 - 2.0 * radii, 0.2)))


def _outlines(plane: BoardPlane, steps: Array, radii: Array) -> tuple[Array, Array]:
    """Areas (n,) of the circles' images, px^2, and how far (n, 2) their centroids are off the projected centres."""
    angle = 2.0 * np.pi * np.arange(OUTLINE) / OUTLINE
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    centre = plane.pixels(steps)
    here = plane.pixels(steps[:, None] + radii[:, None, None] * unit) - centre[:, None]
    there = np.roll(here, -1, axis=1)
    cross = here[..., 0] * there[..., 1] - here[..., 1] * there[..., 0]
    signed = 0.5 * cross.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        astray: Array = ((here + there) * cross[..., None]).sum(axis=1) / (6.0 * signed[:, None])
    # A polygon of n corners inscribed in an ellipse has this share of its area.
    share = np.sin(2.0 * np.pi / OUTLINE) * OUTLINE / (2.0 * np.pi)
    return np.abs(signed) / share, astray


#: At most this number of grids in an image are tested.
MOST_TESTED = 12
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
    for blobs, halved in blobs_in(gray):
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
