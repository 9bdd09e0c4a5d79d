"""Columns and rows of boards of tags, and the share of a step that a tag takes, from where the tags are in images.

A layout puts the middles of the tags on a grid; in an image they are a homography of it. A wrong number of columns puts
them elsewhere, by steps.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from gtsam_rwhec.detect.tags import SeenTag
from gtsam_rwhec.geometry.poses import Array

#: A ChArUco board is counted by squares, the others by tags.
Kind = Literal["charuco", "aprilgrid", "tag_grid"]
#: An image counts with at least this number of the board's tags: four middles fit any homography.
LEAST_TAGS = 6
#: A board needs at least this number of images.
LEAST_IMAGES = 2
#: Middles are off their places by at most this share of a tag's side, and those of other layouts by this factor more.
MOST_OFF, WORSE = 0.12, 3.0
#: A board has at most this number of columns and rows, and this many times as many of one as of the other.
MOST, LONGEST = 40, 5.0


@dataclass(frozen=True)
class Layout:
    """A board's layout.

    Attributes
    ----------
    kind : str
    columns, rows : int
        As the rig file counts them: squares of a ChArUco board, else tags.
    share : float
        A tag's side over the step from one to the next; of a ChArUco board over a square's side.
    off : float
        Root mean square distance of the tags' middles from their places, over a tag's side, median over images.
    images : int
        The images that were compared.
    """

    kind: Kind
    columns: int
    rows: int
    share: float
    off: float
    images: int


def layout_of(kinds: Iterable[Kind], ids: Sequence[int], views: Iterable[Sequence[SeenTag]]) -> Layout | None:
    """The layout of the tags with ids from ``ids[0]`` to ``ids[-1]``; None where the images do not tell.

    Parameters
    ----------
    kinds
        What the board may be.
    ids : sequence of int
        In increasing order.
    views : iterable of sequences of SeenTag
        The tags of the board's family in each image.
    """
    first, count = ids[0], ids[-1] - ids[0] + 1
    wanted = set(ids)
    seen = [[tag for tag in tags if tag.id in wanted] for tags in views]
    seen = [tags for tags in seen if len({tag.id for tag in tags}) == len(tags) >= LEAST_TAGS]
    if len(seen) < LEAST_IMAGES:
        return None
    tried = []
    for kind in kinds:
        for columns, rows in _sizes(kind, count):
            places = _places(kind, columns, rows)
            fits = [_fit(places[[tag.id - first for tag in tags]], tags) for tags in seen]
            off = float(np.median([fit[0] for fit in fits]))
            share = float(np.median([fit[1] for fit in fits]))
            tried.append(Layout(kind, columns, rows, share, off, len(seen)))
    tried.sort(key=lambda layout: layout.off)
    if not tried or tried[0].off > MOST_OFF or not 0.05 < tried[0].share < 1.0:
        return None
    # One square more or less, without a marker, leaves the markers where they are: the smaller board is taken.
    best, *others = tried
    same = [other for other in others if other.kind == best.kind and abs(other.off - best.off) < 1e-9]
    if any(other.off < WORSE * best.off for other in others if other not in same):
        return None
    return min([best, *same], key=lambda layout: layout.columns * layout.rows)


def _sizes(kind: Kind, count: int) -> list[tuple[int, int]]:
    """Columns and rows of boards with this number of tags."""
    sizes = [(c, r) for c in range(2, MOST + 1) for r in range(2, MOST + 1) if max(c, r) <= LONGEST * min(c, r)]
    return [(c, r) for c, r in sizes if (c * r // 2 if kind == "charuco" else c * r) == count]


def _places(kind: Kind, columns: int, rows: int) -> Array:
    """The tags' middles (n, 2) in steps, x to the right and y up as printed."""
    cells = np.meshgrid(np.arange(columns), np.arange(rows))
    x, y = cells[0].ravel(), cells[1].ravel()
    if kind == "charuco":  # markers are in the white squares, and the upper left one is black
        white = (x + y) % 2 == 1
        x, y = x[white], y[white]
    places: Array = np.stack([x, y if kind == "aprilgrid" else -y], axis=1).astype(float)
    return places


def _fit(places: Array, tags: Sequence[SeenTag]) -> tuple[float, float]:
    """How far middles are off, over a tag's side, and a tag's side in steps; infinite where the tags are turned."""
    middles = np.array([tag.middle_px for tag in tags], dtype=float)
    sides = np.array([tag.side_px for tag in tags])
    H = cv2.findHomography(places, middles, 0)[0]
    if H is None or not np.isfinite(H).all() or abs(np.linalg.det(H)) < 1e-12:
        return np.inf, np.nan
    there = cv2.perspectiveTransform(places[:, None], H)[:, 0]
    off = float(np.sqrt((((there - middles) / sides[:, None]) ** 2).sum(axis=1).mean()))
    corners = np.array([tag.corners_px for tag in tags], dtype=float)
    flat = cv2.perspectiveTransform(corners.reshape(-1, 1, 2), np.linalg.inv(H)).reshape(-1, 4, 2)
    right, up = flat[:, 1] - flat[:, 0], flat[:, 0] - flat[:, 3]  # corners from the top left, clockwise
    upright = (right[:, 0] > np.abs(right[:, 1])) & (up[:, 1] > np.abs(up[:, 0]))
    if not upright.mean() > 0.8:
        return np.inf, np.nan
    return off, float(np.median(np.linalg.norm(np.concatenate([right, up]), axis=1)))
