"""Directions in which all corners of an image may be off together, pixels.

Blur, light and a detector's windows move the corners of one image alike: along the image's axes, along the target's,
away from its middle, and towards its far side where it is tilted.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gtsam_rwhec.fitting.corner_model import Model, Point
from gtsam_rwhec.fitting.corner_residuals import Linear, Stack
from gtsam_rwhec.geometry.poses import Array

#: A pattern (V, n, 2) of a stack: its pixels, and directions (V, n, 2) along the target's x, its y, and away.
Pattern = Callable[[Array, Array, Array, Array], Array]
PATTERNS: dict[str, Pattern] = {
    "along the image's x": lambda pixels, x, y, away: np.broadcast_to([1.0, 0.0], pixels.shape),
    "along the image's y": lambda pixels, x, y, away: np.broadcast_to([0.0, 1.0], pixels.shape),
    "from the target's middle": lambda pixels, x, y, away: _from_middle(pixels),
    "away from the camera": lambda pixels, x, y, away: away,
    "along the target's x": lambda pixels, x, y, away: x,
    "along the target's y": lambda pixels, x, y, away: y,
}
#: So many of them, the first, are what an image's corners share by chance: in one image the target's axes span what the
#: image's do.
OF_AN_IMAGE = 4


def patterns(
    model: Model, stack: Stack, point: Point, number: int = len(PATTERNS), *, rows: Linear | None = None
) -> Array:
    """One pixel of each of the first patterns (V, 2n, k), of the corners that were seen; ``rows`` if they are known."""
    directions = _directions(rows or model.linearised(stack, point))
    first = list(PATTERNS.values())[:number]
    every = [np.where(stack.known[..., None], pattern(stack.pixels, *directions), 0.0) for pattern in first]
    V, n = stack.known.shape
    return np.stack(every, axis=-1).reshape(V, 2 * n, number)


def _directions(rows: Linear) -> tuple[Array, Array, Array]:
    """Unit vectors (V, n, 2) in the image along the target's x, its y, and to where the target is farther away."""
    by_place = rows.by_corners  # by a corner's place in the target's frame, (V, n, 2, 3)
    slope = rows.B[:, None, 2:3, :2].transpose(0, 1, 3, 2)  # of the depth by the target's x and y
    along = by_place[..., 0], by_place[..., 1], (by_place[..., :2] @ slope)[..., 0]
    x, y, away = (each / np.maximum(np.linalg.norm(each, axis=-1, keepdims=True), 1e-12) for each in along)
    tilt = np.linalg.norm(slope, axis=2)  # the sine of the tilt: what faces the camera has no far side
    return x, y, away * tilt


def _from_middle(pixels: Array) -> Array:
    """Away from the mean of an image's corners, 1 at the farthest."""
    seen = np.abs(pixels).sum(axis=-1, keepdims=True) > 0.0
    middle = (pixels * seen).sum(axis=1, keepdims=True) / np.maximum(seen.sum(axis=1, keepdims=True), 1)
    off = np.where(seen, pixels - middle, 0.0)
    far = np.linalg.norm(off, axis=-1).max(axis=1)[:, None, None]
    return np.asarray(off / np.maximum(far, 1e-12))
