"""What a bias that all of a detector's corners share would do to the answer: no covariance is below that.

More images make independent errors small, and a bias not. Rendered boards (`benchmarks/rendered_boards.py`) show biases
of 0.001 to 0.011 pixels: along the image's axes, along the target's, away from the target's middle, and away from the
camera where the target is tilted. Each of these patterns b moves the answer, to first order, by

    d theta = -H^-1 h(b),    H, h with the carriers' errors eliminated,

and adds its square to the covariance. A hundredth of a pixel is enough to move a centre by half a pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gtsam_rwhec.fitting.corner_model import Model, Point
from gtsam_rwhec.fitting.corner_noise import Noise, Reduced
from gtsam_rwhec.fitting.corner_residuals import Stack
from gtsam_rwhec.fitting.corners_refined import CornersRefined
from gtsam_rwhec.geometry.poses import Array

#: Standard deviation of each pattern, pixels, for every kind of target: the largest pattern of rendered checkerboards
#: and ChArUco boards has 0.001 to 0.002, that of tags and circles 0.003 to 0.011.
BIAS_PX = 0.004

#: A pattern (V, n, 2) of a stack: its pixels and unit directions (V, n, 2) along the target's x, its y, and away.
Pattern = Callable[[Array, Array, Array, Array], Array]
PATTERNS: dict[str, Pattern] = {
    "along the image's x": lambda pixels, x, y, away: np.broadcast_to([1.0, 0.0], pixels.shape),
    "along the image's y": lambda pixels, x, y, away: np.broadcast_to([0.0, 1.0], pixels.shape),
    "along the target's x": lambda pixels, x, y, away: x,
    "along the target's y": lambda pixels, x, y, away: y,
    "from the target's middle": lambda pixels, x, y, away: _from_middle(pixels),
    "away from the camera": lambda pixels, x, y, away: away,
}


def covariance_of_bias(refined: CornersRefined) -> Array:
    """The covariance (d, d) of the answer's unknowns from a bias of the detector."""
    model, point, noise = refined.graph.model, refined.point, refined.noise
    H = Reduced.of(model, point).information(noise)
    size = np.sqrt(np.diagonal(H))
    gradients = gradients_of_bias(model, point, noise)
    moved = np.linalg.solve(H / size[:, None] / size, gradients.T / size[:, None]) / size[:, None]
    result: Array = BIAS_PX**2 * moved @ moved.T
    return result


def gradients_of_bias(model: Model, point: Point, noise: Noise) -> Array:
    """h (patterns, d) of one pixel of each pattern."""
    directions = [_directions(model, stack, point) for stack in model.stacks]
    whole = Reduced.of(model, point).without_carriers(noise).h
    found = []
    for pattern in PATTERNS.values():
        stacks = tuple(
            replace(stack, pixels=stack.pixels - np.where(stack.known[..., None], pattern(stack.pixels, *of), 0.0))
            for stack, of in zip(model.stacks, directions, strict=True)
        )
        found.append(Reduced.of(replace(model, stacks=stacks), point).without_carriers(noise).h - whole)
    return np.array(found)


def _directions(model: Model, stack: Stack, point: Point) -> tuple[Array, Array, Array]:
    """Unit vectors (V, n, 2) in the image along the target's x, its y, and to where the target is farther away."""
    rows = model.linearised(stack, point)
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
