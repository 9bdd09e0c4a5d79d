"""Boards as they are drawn: the paper and its dark parts as polygons in the target's frame, in true metres."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from pydantic import Field

from gtsam_rwhec.evidence.record import EvidenceRecord, Rows
from gtsam_rwhec.fitting.reprojection_record import WARPS, BoardShape
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.dictionaries import dictionary, modules
from gtsam_rwhec.vision.tag_boards import Bundle, TagGrid
from gtsam_rwhec.vision.target_checks import grid, square
from gtsam_rwhec.vision.targets import AprilGrid, Charuco, Checkerboard, CircleGrid, Tag, Target

#: The modules of tags are drawn where a board has at most this many tags, and a rig at most this many targets.
WITH_MODULES = 12
#: A board is drawn with at most this many dark parts; of more, they are spread evenly over it.
MOST_PARTS = 500
#: A circle is drawn with this many corners, and with this share of the spacing as radius: files do not state it.
CIRCLE, RADIUS = 8, 0.25
#: The paper is behind its dark parts by this share of its size, for browsers that could not tell which is in front.
BEHIND = 0.004


class DrawnBoard(EvidenceRecord):
    """A target as it is drawn."""

    words: str = Field(description="what it is, and its size as found")
    paper: Rows = Field(description="the corners of the paper in the target's frame, m; empty where it is not known")
    dark: tuple[Rows, ...] = Field(description="the dark parts, each a convex polygon, m")


def drawn_board(
    target: Target, scale: float = 1.0, shape: BoardShape | None = None, *, is_one_of_many: bool = False
) -> DrawnBoard:
    """A target as it is drawn.

    Parameters
    ----------
    target : Target
        As the rig file states it.
    scale : float
        Its stated size over the true one.
    shape : BoardShape, optional
        Its warp, where it was estimated.
    is_one_of_many : bool
        The modules of its tags are left out.
    """
    has_modules = not is_one_of_many and len(target.ids) <= WITH_MODULES
    paper, dark = _parts(target, has_modules)
    if len(dark) > MOST_PARTS:
        dark = [dark[i] for i in np.linspace(0, len(dark) - 1, MOST_PARTS).round().astype(int).tolist()]
    reach = float(np.linalg.norm(target.corners(), axis=1).max())
    warp = _warp(shape)
    if isinstance(target, Bundle):
        warp = np.zeros(2)  # its tags are in no common plane
    bent = [_bent(polygon / scale, reach / scale, warp) for polygon in dark]
    if len(paper):
        low = min((float(polygon[:, 2].min()) for polygon in bent), default=0.0)
        paper = paper / scale + [0.0, 0.0, low - BEHIND * reach]
    length = target.length_m / scale
    return DrawnBoard(
        words=f"{_kind(target)}, {_length_word(target)} {1e3 * length:.2f} mm", paper=_rows(paper), dark=_all(bent)
    )


def drawn_points(points: Array, scale: float = 1.0) -> DrawnBoard:
    """A board of which only the corners (n, 3) are known: four are a tag, more are drawn as dots."""
    points = points / scale
    if len(points) == 4:
        return DrawnBoard(words="a target with four corners", paper=(), dark=_all(_ring(points, 8)))
    size = float(np.ptp(points, axis=0).max())
    dots = [point + 0.5 * RADIUS * size / np.sqrt(len(points)) * _circle() for point in points]
    return DrawnBoard(words=f"a target with {len(points)} corners", paper=(), dark=_all(dots[:MOST_PARTS]))


def _parts(target: Target, has_modules: bool) -> tuple[Array, list[Array]]:
    """The paper (4, 3) or (0, 3), and the dark polygons, as stated."""
    if isinstance(target, Tag):
        paper = square(target.size_m * (1.0 + 2.0 / modules(target.family)))
        return paper, _tag(target, target.corners(), 0, has_modules)
    if isinstance(target, Bundle | TagGrid | AprilGrid):
        corners = target.corners().reshape(-1, 4, 3)
        dark = [part for i, tag in enumerate(corners) for part in _tag(target, tag, i, has_modules)]
        return np.zeros((0, 3)) if isinstance(target, Bundle) else _around(target.corners(), 0.15), dark
    if isinstance(target, CircleGrid):
        centres, radius = target.corners(), RADIUS * target.spacing_m * (1.5 if target.asymmetric else 1.0)
        return _around(centres, target.spacing_m / np.ptp(centres, axis=0).max()), [
            centre + radius * _circle() for centre in centres
        ]
    is_charuco = isinstance(target, Charuco)
    columns, rows = (target.columns, target.rows) if is_charuco else (target.columns + 1, target.rows + 1)
    middles = grid(columns, rows, target.square_m)
    is_dark = np.add(*np.divmod(np.arange(columns * rows), columns)) % 2 == 0
    paper = 0.5 * target.square_m * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) * [columns, rows, 1]
    parts = [middle + square(target.square_m) for middle in middles[is_dark]]
    if isinstance(target, Charuco):
        markers = [middle + square(target.marker_m) for middle in middles[~is_dark]]
        parts += [part for marker in markers for part in _ring(marker, modules(target.family))]
    return paper, parts


def _tag(target: Tag | Bundle | TagGrid | AprilGrid, corners: Array, index: int, has_modules: bool) -> list[Array]:
    """The dark parts of a tag whose corners (4, 3) are top left, top right, bottom right, bottom left as printed."""
    if not has_modules:
        return [corners] if len(target.ids) > 1 else _ring(corners, modules(target.family))
    across = modules(target.family)
    picture = cv2.aruco.generateImageMarker(dictionary(target.family), target.ids[index], across)
    # Runs of dark modules: where a row begins and ends to be dark.
    edges = np.diff(np.pad((picture == 0).astype(int), ((0, 0), (1, 1))), axis=1)
    row, first = np.nonzero(edges == 1)
    _, end = np.nonzero(edges == -1)
    runs = np.stack([first, row, end, row + 1], axis=1) / across
    return [_part_of(corners, *run) for run in runs.tolist()]


def _part_of(corners: Array, left: float, top: float, right: float, bottom: float) -> Array:
    """The corners (4, 3) of a part of a square with these corners; shares from its top left corner."""
    x, y = corners[1] - corners[0], corners[3] - corners[0]
    shares = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    part: Array = corners[0] + shares @ np.stack([x, y])
    return part


def _ring(corners: Array, across: int) -> list[Array]:
    """The black border of a tag, one module wide."""
    w = 1.0 / across
    parts = ((0.0, 0.0, 1.0, w), (0.0, 1.0 - w, 1.0, 1.0), (0.0, w, w, 1.0 - w), (1.0 - w, w, 1.0, 1.0 - w))
    return [_part_of(corners, *part) for part in parts]


def _around(points: Array, share: float) -> Array:
    """The corners (4, 3) of a sheet around points in its plane, larger by a share of its size on each side."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = share * float((high - low).max())
    (a, b), (c, d) = (low - margin)[:2], (high + margin)[:2]
    return np.array([[a, d, 0.0], [c, d, 0.0], [c, b, 0.0], [a, b, 0.0]])


def _circle() -> Array:
    turn = np.linspace(0.0, 2.0 * np.pi, CIRCLE, endpoint=False)
    return np.stack([np.cos(turn), np.sin(turn), np.zeros(CIRCLE)], axis=1)


def _warp(shape: BoardShape | None) -> Array:
    """Heights (2,) of the edge over the middle along x and y, metres."""
    found = {} if shape is None else dict(zip(shape.names, shape.values, strict=True))
    return np.array([found.get(WARPS[axis], 0.0) for axis in "xy"])


def _bent(points: Array, reach: float, warp: Array) -> Array:
    """Points of a flat board (n, 3) on the warped one, by the formula of `reprojection.corner_views.shaped`."""
    bent: Array = points + np.outer((points[:, :2] / reach) ** 2 @ warp, [0.0, 0.0, 1.0])
    return bent


def _kind(target: Target) -> str:
    words = {
        Tag: "tag", Charuco: "ChArUco board", AprilGrid: "AprilGrid", TagGrid: "grid of tags", Bundle: "bundle of tags",
        Checkerboard: "checkerboard", CircleGrid: "grid of circles",
    }  # fmt: skip
    return words[type(target)]


def _length_word(target: Target) -> str:
    if isinstance(target, Charuco | Checkerboard):
        return "square"
    return "spacing" if isinstance(target, CircleGrid) else "side"


def _rows(points: Array) -> Rows:
    return tuple((x, y, z) for x, y, z in (np.round(points, 6) + 0.0).tolist())


def _all(polygons: Sequence[Array]) -> tuple[Rows, ...]:
    return tuple(map(_rows, polygons))
