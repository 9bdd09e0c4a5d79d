"""What a bias that all of a detector's corners share would do to the answer: no covariance is below that.

More images make independent errors small, and a bias not. Rendered boards (`benchmarks/rendered_boards.py`) show biases
of 0.001 to 0.002 pixels on boards of squares, and of 0.003 to 0.011 on tags and circles (``bias_px`` of the targets),
along the image's axes, along the target's, away from the target's middle, and away from the camera where the target is
tilted. Each of these patterns b moves the answer, to first order, by

    d theta = -H^-1 h(b),    H, h with the carriers' errors eliminated,

and adds its square to the covariance. A hundredth of a pixel is enough to move a centre by half a pixel.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gtsam_rwhec.fitting.corner_model import Model, Point
from gtsam_rwhec.fitting.corner_noise import Noise, Reduced
from gtsam_rwhec.fitting.corner_patterns import PATTERNS, patterns
from gtsam_rwhec.fitting.corners_refined import CornersRefined
from gtsam_rwhec.geometry.poses import Array


def covariance_of_bias(refined: CornersRefined) -> Array:
    """The covariance (d, d) of the answer's unknowns from a bias of the detector."""
    model, point, noise = refined.graph.model, refined.point, refined.noise
    H = Reduced.of(model, point).information(noise)
    size = np.sqrt(np.diagonal(H))
    gradients = gradients_of_bias(model, point, noise)
    moved = np.linalg.solve(H / size[:, None] / size, gradients.T / size[:, None]) / size[:, None]
    result: Array = moved @ moved.T
    return result


def gradients_of_bias(model: Model, point: Point, noise: Noise) -> Array:
    """h (patterns, d) of one standard deviation of each pattern, of all targets together."""
    whole = Reduced.of(model, point).without_carriers(noise).h
    every = [model.bias_px[stack.target] * patterns(model, stack, point) for stack in model.stacks]
    found = []
    for k in range(len(PATTERNS)):
        stacks = tuple(
            replace(stack, pixels=stack.pixels - pattern[..., k].reshape(stack.pixels.shape))
            for stack, pattern in zip(model.stacks, every, strict=True)
        )
        found.append(Reduced.of(replace(model, stacks=stacks), point).without_carriers(noise).h - whole)
    return np.array(found)
