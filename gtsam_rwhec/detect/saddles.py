"""Where an image may show a checkerboard: points that look like two dark squares meeting, in groups.

A checkerboard's inner corner is a saddle of the gray values, and on a ring around it dark and light alternate twice.
Few images without a checkerboard have a dozen such points close together, so that most of them need no detector.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.geometry.poses import Array

#: Gray values are blurred by this standard deviation (pixels of the level) before they are differentiated.
SIGMA_PX = 1.0
#: A saddle's curvature along its two axes (gray values a pixel^2) is at least this. Noise of 4 of 255 stays below.
LEAST_CURVATURE = 1.5
#: The ring around a saddle has this radius (pixels of the level) and this number of samples, a multiple of 4.
RING_PX, RING = 3.0, 16
#: Opposite samples of a ring may differ by at most this share of what quarters differ by.
UNLIKE = 0.6
#: A level has at most this number of saddles, the strongest.
MOST = 600
#: Two saddles are of one group if they are closer than this many times the distance to their third nearest neighbour.
NEAR = 1.8
#: A group may be a board if it has at least this share of the board's corners.
SHARE = 0.6
#: Images are halved this often before saddles are looked for: sharp corners first, blurred ones in what is smaller.
LEVELS = (1, 2)
#: At most this number of groups of saddles are looked at.
MOST_GROUPS = 3


@dataclass(frozen=True, eq=False)
class Saddles:
    """n saddles of an image, the strongest first."""

    places: Array  #: (n, 2): pixels, right to some tenths
    edges: Array  #: (n, 2, 2): unit vectors along the two edges that cross
    light: Array  #: (n, 2): A unit vector towards a light side


def scaled_down(gray: Gray, level: int) -> Gray:
    """An image that is halved `level` times, or while there is something to halve."""
    small = np.asarray(gray)
    for _ in range(level):
        if min(small.shape) < 2:
            break
        small = np.asarray(cv2.resize(small, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return small


def groups_of(places: Array, corners: int) -> list[np.ndarray]:
    """The members of groups of saddles (n, 2) that may show a board of this number of corners, the likeliest first.

    A group of about as many saddles as the board has corners is likelier than a larger one, which may be any clutter.
    """
    large = [members for members in _groups(places) if len(members) >= SHARE * corners]
    return sorted(large, key=lambda members: abs(float(np.log(len(members) / corners))))[:MOST_GROUPS]


def saddles(gray: Gray) -> Saddles:
    """An image's saddles with rings that alternate."""
    edge = int(np.ceil(RING_PX)) + 1
    if min(gray.shape) <= 2 * edge:
        return Saddles(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 2)))
    smooth = cv2.GaussianBlur(gray, (0, 0), SIGMA_PX).astype(np.float32)
    xx = cv2.filter2D(smooth, -1, np.array([[1.0, -2.0, 1.0]], np.float32))
    yy = cv2.filter2D(smooth, -1, np.array([[1.0], [-2.0], [1.0]], np.float32))
    xy = cv2.filter2D(smooth, -1, 0.25 * np.array([[1.0, 0.0, -1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 1.0]], np.float32))
    strength = xy * xy - xx * yy
    peak = (strength >= LEAST_CURVATURE**2) & (strength >= cv2.dilate(strength, np.ones((5, 5), np.uint8)))
    rows, columns = np.nonzero(peak[edge:-edge, edge:-edge])
    rows, columns = rows + edge, columns + edge
    order = np.argsort(-strength[rows, columns], kind="stable")[: 4 * MOST]
    rows, columns = rows[order], columns[order]
    angle = 2.0 * np.pi * np.arange(RING) / RING
    dx, dy = (np.rint(RING_PX * turned(angle)).astype(int) for turned in (np.cos, np.sin))
    ring = smooth[rows[:, None] + dy, columns[:, None] + dx]
    ring -= ring.mean(axis=1, keepdims=True)
    changes = (np.sign(ring) != np.sign(np.roll(ring, 1, axis=1))).sum(axis=1)
    opposite = np.abs(ring - np.roll(ring, RING // 2, axis=1)).mean(axis=1)
    quarter = np.abs(ring - np.roll(ring, RING // 4, axis=1)).mean(axis=1)
    good = np.flatnonzero((changes == 4) & (opposite < UNLIKE * quarter))[:MOST]
    rows, columns = rows[good], columns[good]
    hessian = np.array([[xx[rows, columns], xy[rows, columns]], [xy[rows, columns], yy[rows, columns]]], dtype=float)
    hessian = np.moveaxis(hessian, -1, 0)
    right, down = (
        smooth[rows, columns + 1] - smooth[rows, columns - 1],
        smooth[rows + 1, columns] - smooth[rows - 1, columns],
    )
    flat_at = -np.linalg.solve(hessian, 0.5 * np.stack([right, down], axis=-1).astype(float)[..., None])[..., 0]
    curvature, axes = np.linalg.eigh(hessian)  # the larger one last: gray values rise along it
    open_by = np.arctan2(np.sqrt(np.maximum(curvature[:, 1], 0.0)), np.sqrt(np.maximum(-curvature[:, 0], 1e-12)))
    light = axes[:, :, 1]
    middle = np.arctan2(light[:, 1], light[:, 0])
    turned_by = middle[:, None] + np.stack([open_by, -open_by], axis=-1)
    return Saddles(
        np.stack([columns, rows], axis=1) + np.clip(flat_at, -1.0, 1.0),
        np.stack([np.cos(turned_by), np.sin(turned_by)], axis=-1),
        light,
    )


def _groups(places: Array) -> list[np.ndarray]:
    """Indices of the members of each group of places (n, 2) that are as near to each other as their neighbours are."""
    if len(places) < 4:
        return []
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    third = np.sort(apart, axis=1)[:, 3]
    linked = apart <= NEAR * np.minimum(third[:, None], third)
    group = np.arange(len(places))
    while True:  # each takes the smallest number of its neighbours, until nothing changes
        smallest = np.where(linked, group, len(places)).min(axis=1)
        smallest = smallest[smallest]
        if np.array_equal(smallest, group):
            return [np.flatnonzero(group == number) for number in np.unique(group)]
        group = smallest
