"""Corners of boards, the points where two dark squares meet: blur and gamma do not move them.

The tags that were read give the board's pose. It predicts the places of all corners, also beside tags that could not be
read, and each corner is searched there. A corner counts if its four quadrants are dark and light as printed, and if it
is at its place in the board's plane. At a point p of an edge the gradient g is perpendicular to the edge, so g . (q -
p) = 0 for the corner q (Förstner and Gülch 1987; OpenCV's cornerSubPix). Here the points are those of two strips along
the edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import AprilGrid, Charuco
from gtsam_rwhec.detect.board_evidence import BoardPlane
from gtsam_rwhec.detect.board_layout import BoardTags, largest_off, tag_places
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.geometry.poses import Array

#: Strips reach at most this far along and across the edges, pixels.
MOST_ALONG, MOST_ACROSS = 7.0, 7.0
#: Strips reach at least this far along and across the edges, pixels.
LEAST_ALONG, LEAST_ACROSS = 2.5, 1.2
#: The iteration ends when a step is below this (pixels), or after this number of rounds.
SETTLED_PX, ROUNDS = 2e-3, 15
#: If the weaker direction has less than this share of the gradients, there is only one edge, and no corner.
LEAST_SHARE = 0.08


def crossings_of_edges(gray: Gray, corners_px: Array, directions: Array, along_px: Array, across_px: Array) -> Array:
    """Places (n, 2) of the corners, pixels; nan where two edges were not found.

    Up to a pixel they are at `corners_px` (n, 2); `directions` (n, 2, 2) are unit vectors along the two edges in the
    image. `along_px` and `across_px` (n, 2) are the free length along each edge and the free width across it, where
    nothing else is printed.
    """
    along = np.clip(along_px, LEAST_ALONG, MOST_ALONG)[:, None].astype(np.float32)
    across = np.clip(across_px, LEAST_ACROSS, MOST_ACROSS)[:, None].astype(np.float32)
    half = int(np.ceil(along.max(initial=LEAST_ALONG))) + 1
    low = np.maximum(np.floor(corners_px.min(axis=0)).astype(int) - half - 3, 0)
    high = np.minimum(np.ceil(corners_px.max(axis=0)).astype(int) + half + 4, gray.shape[::-1])
    part = np.ascontiguousarray(gray[low[1] : high[1], low[0] : high[0]])
    if min(part.shape) < 3:
        return np.full_like(corners_px, np.nan)
    slopes = np.stack([cv2.Sobel(part, cv2.CV_32F, *order, ksize=3) for order in ((1, 0), (0, 1))], axis=-1)
    window = np.stack(np.meshgrid(*2 * [np.arange(-half, half + 1)]), axis=-1).reshape(-1, 2)
    directions = directions.astype(np.float32)
    normals = np.stack([-directions[..., 1], directions[..., 0]], axis=-1)
    start = corners_px - low
    q = start.copy()
    limit = np.array(part.shape[::-1]) - 1
    moving = np.arange(len(q))
    for _ in range(ROUNDS):
        here = np.nan_to_num(q[moving])
        pixels = np.rint(here).astype(int)[:, None] + window
        at = np.clip(pixels, 0, limit)
        off = (pixels - here[:, None]).astype(np.float32)
        a = np.abs(off @ directions[moving].transpose(0, 2, 1))
        b = np.abs(off @ normals[moving].transpose(0, 2, 1))
        weight = np.clip(along[moving] - a + 0.5, 0.0, 1.0) * np.clip(across[moving] - b + 0.5, 0.0, 1.0)
        weight = weight.max(axis=2) * (pixels == at).all(axis=2)
        g = slopes[at[..., 1], at[..., 0]]
        wg = weight[..., None] * g
        M = (wg.transpose(0, 2, 1) @ g).astype(float)
        v = (wg.transpose(0, 2, 1) @ (g * off).sum(axis=2)[..., None])[..., 0].astype(float)
        det = M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] ** 2
        trace = M[:, 0, 0] + M[:, 1, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            x = (M[:, 1, 1] * v[:, 0] - M[:, 0, 1] * v[:, 1]) / det
            y = (M[:, 0, 0] * v[:, 1] - M[:, 0, 1] * v[:, 0]) / det
            # The smaller eigenvalue is about det / trace.
            step = np.where((det > LEAST_SHARE * trace**2 / 4.0)[:, None], np.stack([x, y], axis=1), np.nan)
        q[moving] += np.clip(step, -1.5, 1.5)
        with np.errstate(invalid="ignore"):
            moving = moving[np.abs(step).max(axis=1) > SETTLED_PX]
        if not len(moving):
            break
    return np.asarray(q + low)


#: Blur and the gradient's window widen each printed edge by this many pixels.
GRADIENT_PX = 2.0
#: Corners nearer to the image's border than this are not measured, pixels.
MARGIN_PX = 3.0
#: Corners are searched up to this far from known ones, in squares or in tags with their gap.
NEAR = 1.6
#: A corner found further from its predicted place than this share of the distance to the next printed edge, and than
#: this many pixels, is another corner.
MOST_MOVED, LEAST_MOVED_PX = 0.7, 1.0
#: A corner further than this (pixels) from the place that the other corners predict is not used,
ASTRAY_PX = 1.5
#: nor one that is further than this many standard deviations of the others, and than this (pixels).
ASTRAY_SIGMA, ASTRAY_LEAST_PX = 5.0, 0.25
#: The dark and the light quadrants at a corner differ by at least this share of the median over corners, and by this.
LEAST_CONTRAST, LEAST_GRAY = 0.25, 6.0


@dataclass(frozen=True, eq=False)
class _Corners:
    """Corners of a board in its plane, metres: (n, 2), and what is printed around each.

    `dark` and `light` (n, 2, 2) are offsets to points in the dark and in the light quadrants. `along` and `across` are
    the distances along and across the corner's edges within which nothing else is printed.
    """

    places: Array
    dark: Array
    light: Array
    along: float
    across: float


def _of_charuco(board: Charuco, is_legacy: bool) -> _Corners:
    gap = 0.5 * (board.square_m - board.marker_m)
    row, column = np.divmod(np.arange((board.columns - 1) * (board.rows - 1)), board.columns - 1)
    first_is_dark = ((row + column) % 2 == 0) ^ (is_legacy and board.rows % 2 == 0)
    falling, rising = np.array([[-1.0, 1.0], [1.0, -1.0]]), np.array([[1.0, 1.0], [-1.0, -1.0]])
    dark = np.where(first_is_dark[:, None, None], falling, rising)
    light = np.where(first_is_dark[:, None, None], rising, falling)
    return _Corners(board.corners()[:, :2], 0.25 * board.square_m * dark, 0.55 * gap * light, 0.6 * board.square_m, gap)


def _of_aprilgrid(board: AprilGrid) -> _Corners:
    gap, border = board.spacing * board.tag_m, 0.2 * board.tag_m
    outwards = np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])  # of a tag's four corners
    inside, outside = -0.5 * border * outwards, 0.5 * gap * outwards
    dark = np.stack([inside, outside], axis=1)
    light = np.stack([np.stack([a[:, 0], b[:, 1]], axis=1) for a, b in ((inside, outside), (outside, inside))], axis=1)
    count = board.columns * board.rows
    places = board.corners()[:, :2]
    return _Corners(places, np.tile(dark, (count, 1, 1)), np.tile(light, (count, 1, 1)), 0.65 * gap, min(gap, border))


def board_corners(gray: Gray, board: Charuco | AprilGrid, tags: BoardTags, camera: Camera) -> tuple[np.ndarray, Array]:
    """Indices (n,) and places (n, 2) of a board's corners that are seen; at least two of its tags are needed."""
    nothing = np.zeros(0, dtype=int), np.zeros((0, 2))
    if len(tags.ids) < 2:
        return nothing
    corners = _of_charuco(board, tags.is_legacy) if isinstance(board, Charuco) else _of_aprilgrid(board)
    number = {i: k for k, i in enumerate(board.ids)}
    tag_plane = tag_places(board, tags.is_legacy)[[number[int(i)] for i in tags.ids], :, :2].reshape(-1, 2)
    tags_px = tags.corners_px.reshape(-1, 2)
    known, seen = tag_plane, tags_px
    numbers, found = nothing
    looked_for = np.zeros(len(corners.places), dtype=bool)
    # The pattern repeats itself, so the search must not jump: the known part grows by one square or tag at a time.
    pitch = board.square_m if isinstance(board, Charuco) else board.tag_m * (1.0 + board.spacing)
    while True:
        places = _plane(camera, known, seen)
        if places is None:
            return nothing
        near = np.abs(corners.places[:, None] - known).max(axis=2).min(axis=1) < NEAR * pitch
        new = np.flatnonzero(near & ~looked_for)
        if not len(new):
            break
        looked_for[new] = True
        more, more_px = _found(gray, corners, places, new)
        numbers, found = np.append(numbers, more), np.concatenate([found, more_px])
        kept = on_one_plane(camera, board.corners()[numbers], found)
        numbers, found = numbers[kept], found[kept]
        if len(numbers) < 4:
            return nothing
        known, seen = corners.places[numbers], found
        if not _span_a_plane(known):
            known, seen = np.concatenate([known, tag_plane]), np.concatenate([seen, tags_px])
    order = np.argsort(numbers)
    numbers, found = numbers[order], found[order]
    places = _plane(camera, known, seen)
    if places is None or not _are_there(places, tag_plane, tags_px):
        return nothing
    return numbers, found


def _plane(camera: Camera, known: Array, seen: Array) -> BoardPlane | None:
    """The plane of points (n, 2) that were seen at pixels (n, 2), by those that have a ray."""
    has_ray = camera.has_ray(seen)
    return BoardPlane.through(known[has_ray], seen[has_ray], camera)


def _span_a_plane(points: Array) -> bool:
    """Whether points (n, 2) are clearly not all on one line."""
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extent[1] > 0.1 * extent[0])


def _are_there(places: BoardPlane, tag_plane: Array, tags_px: Array) -> bool:
    """Whether the tags' corners (4 m, 2) are where the board's corners predict them."""
    off = np.linalg.norm(places.seen(tag_plane) - tags_px, axis=1).reshape(-1, 4).max(axis=1)
    return bool(np.median(off / largest_off(tags_px.reshape(-1, 4, 2))) <= 1.0)


def _found(gray: Gray, corners: _Corners, places: BoardPlane, which: np.ndarray) -> tuple[np.ndarray, Array]:
    """Indices and places of the corners of `which` that look as printed."""
    at = corners.places[which]
    predicted = places.seen(at)
    nudge = 1e-3 * corners.along
    # Pixels (n, 2, 2) of a step along the board's x and y.
    steps = np.stack([places.seen(at + nudge * axis) - predicted for axis in np.eye(2)], axis=1) / nudge
    length = np.linalg.norm(steps, axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        directions = steps / length[..., None]
        # Distance from an edge to the next parallel edges, pixels.
        apart = np.abs(steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 0, 1] * steps[:, 1, 0])[:, None] / length
    edge = np.array(gray.shape[::-1]) - 1.0 - MARGIN_PX
    with np.errstate(invalid="ignore"):
        inside = ((predicted >= MARGIN_PX) & (predicted <= edge)).all(axis=1) & np.isfinite(apart).all(axis=1)
    which, predicted = which[inside], predicted[inside]
    if not len(which):
        return which, predicted
    along, across = corners.along * length[inside], corners.across * apart[inside]
    refined = crossings_of_edges(gray, predicted, directions[inside], along - GRADIENT_PX, across - GRADIENT_PX)
    moved = np.linalg.norm(refined - predicted, axis=1)
    with np.errstate(invalid="ignore"):
        good = moved < np.maximum(MOST_MOVED * across.min(axis=1), LEAST_MOVED_PX)
    refined = np.where(good[:, None], refined, predicted)
    off = refined - predicted
    dark, light = (
        _gray_at(gray, places.seen(corners.places[which, None] + offsets[which]) + off[:, None])
        for offsets in (corners.dark, corners.light)
    )
    contrast = light.min(axis=1) - dark.max(axis=1)
    usual = float(np.median(contrast[good])) if good.any() else 0.0
    good &= contrast >= max(LEAST_CONTRAST * usual, LEAST_GRAY)
    return which[good], refined[good]


def _gray_at(gray: Gray, pixels: Array) -> Array:
    """Gray values (...) at the nearest pixels of (..., 2)."""
    column, row = np.moveaxis(np.rint(np.nan_to_num(pixels)).astype(int), -1, 0)
    height, width = gray.shape
    return np.asarray(gray[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)], dtype=float)


def on_one_plane(camera: Camera, corners_m: Array, corners_px: Array) -> np.ndarray:
    """Say which (n,) of a board's corners (n, 3), seen at (n, 2), agree with most corners. Under six corners all do."""
    everyone = np.ones(len(corners_m), dtype=bool)
    x = camera.undistort(corners_px)
    if len(corners_m) < 6 or not np.isfinite(x).all():
        return everyone
    focal = camera.focal_px
    plane, flat = corners_m[:, :2], x * focal
    H, agrees = cv2.findHomography(plane, flat, cv2.RANSAC, ASTRAY_PX)
    if H is None:
        return everyone
    kept = agrees.ravel().astype(bool)
    for _ in range(3):
        if kept.sum() < 6:
            break
        H, _ = cv2.findHomography(plane[kept], flat[kept], 0)
        if H is None:
            break
        off = np.linalg.norm(cv2.perspectiveTransform(plane[:, None], H)[:, 0] - flat, axis=1)
        # The median length of an error along two axes is 1.18 standard deviations of one.
        sigma = float(np.median(off[kept])) / 1.18
        kept = off <= np.clip(ASTRAY_SIGMA * sigma, ASTRAY_LEAST_PX, ASTRAY_PX)
    return kept
