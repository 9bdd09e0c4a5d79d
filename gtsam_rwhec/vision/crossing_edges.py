"""Corners where two dark squares meet, from the two edges that cross there, and from nothing beside them.

At a point of an edge the gray value's gradient g is across the edge, so that g . (q - p) = 0 for the corner q (Förstner
and Gülch 1987; OpenCV's cornerSubPix). OpenCV sums over a square window: with markers nearby it must be so small that
blur and noise leave nothing in it. Here the sum is over two strips, along the two edges, which are narrow where
something else is printed nearby, and long.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.images import Gray

#: Strips reach at most this far along and across the edges, pixels.
MOST_ALONG, MOST_ACROSS = 7.0, 7.0
#: They reach at least this far.
LEAST_ALONG, LEAST_ACROSS = 2.5, 1.2
#: Rounds end with the last step below this (pixels), or after this number.
SETTLED_PX, ROUNDS = 2e-3, 15
#: A corner with less of its gradients along the weaker direction than this share has one edge only.
LEAST_SHARE = 0.08


@dataclass(frozen=True, eq=False)
class Strips:
    """Where the edges of n corners are, up to a pixel.

    Attributes
    ----------
    corners_px : (n, 2) array
    directions : (n, 2, 2) array
        Unit vectors along the two edges in the image.
    along_px, across_px : (n, 2) arrays
        How far along and across each edge there is nothing else, pixels.
    """

    corners_px: Array
    directions: Array
    along_px: Array
    across_px: Array


def crossings_of_edges(gray: Gray, strips: Strips) -> Array:
    """Places (n, 2) of the corners, pixels; nan where there are not two edges."""
    along = np.clip(strips.along_px, LEAST_ALONG, MOST_ALONG)[:, None].astype(np.float32)
    across = np.clip(strips.across_px, LEAST_ACROSS, MOST_ACROSS)[:, None].astype(np.float32)
    half = int(np.ceil(along.max(initial=LEAST_ALONG))) + 1
    low = np.maximum(np.floor(strips.corners_px.min(axis=0)).astype(int) - half - 3, 0)
    high = np.minimum(np.ceil(strips.corners_px.max(axis=0)).astype(int) + half + 4, gray.shape[::-1])
    part = np.ascontiguousarray(gray[low[1] : high[1], low[0] : high[0]])
    if min(part.shape) < 3:
        return np.full_like(strips.corners_px, np.nan)
    slopes = np.stack([cv2.Sobel(part, cv2.CV_32F, *order, ksize=3) for order in ((1, 0), (0, 1))], axis=-1)
    window = np.stack(np.meshgrid(*2 * [np.arange(-half, half + 1)]), axis=-1).reshape(-1, 2)
    directions = strips.directions.astype(np.float32)
    normals = np.stack([-directions[..., 1], directions[..., 0]], axis=-1)
    start = strips.corners_px - low
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
