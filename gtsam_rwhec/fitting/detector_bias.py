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

from gtsam_rwhec.fitting.common_errors import CommonErrors
from gtsam_rwhec.fitting.corner_model import Model
from gtsam_rwhec.fitting.corner_noise import Noise, Reduced
from gtsam_rwhec.fitting.corner_patterns import PATTERNS
from gtsam_rwhec.fitting.corners_refined import CornersRefined
from gtsam_rwhec.geometry.poses import Array


def covariance_of_bias(refined: CornersRefined) -> Array:
    """The covariance (d, d) of the answer's unknowns from a bias of the detector."""
    model, noise = refined.graph.model, refined.noise
    reduced = Reduced.of(model, refined.point)
    H, h = reduced.information(noise), gradients_of_bias(model, reduced, noise)
    size = np.sqrt(np.diagonal(H))
    moved = np.linalg.solve(H / size[:, None] / size, h.T / size[:, None]) / size[:, None]
    return moved @ moved.T


def gradients_of_bias(model: Model, reduced: Reduced, noise: Noise) -> Array:
    """h (patterns, d) of one standard deviation of each pattern, of all targets together, in place of the residuals."""
    every, found = reduced.patterns, []
    px = [s.each(np.array([model.bias_px[target] for target in s.targets])) for s in model.stacks]
    for k in range(len(PATTERNS)):
        sums, of_bias = reduced.sums.copy(), []
        sums.squares[:, -1], sums.of_A[..., -1] = 0.0, 0.0
        for each, of in zip(every.stacks, px, strict=True):
            of_unknowns = each.stack.sums(of[:, None] * each.of_unknowns[:, k])
            np.add.at(sums.squares[:, -1], each.columns, of_unknowns)
            np.add.at(sums.of_A[..., -1], each.stack.instant, of[:, None] * each.of_A[:, k])
            of_bias.append(replace(each, of_residual=of[:, None] * each.P[..., k]))
        biased = replace(reduced, sums=sums, patterns=CommonErrors(tuple(of_bias)))
        found.append(biased.without_carriers(noise).h)
    return np.array(found)
