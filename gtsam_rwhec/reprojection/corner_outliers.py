"""Corners that disagree with all others: a board hidden by half, a misread corner."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.reprojection.model import Model, Point

#: A corner with an error of more deviations is left out: of good ones, whose errors are Rayleigh's, 1 in 10,000.
LIMIT = 4.3
#: In the first round outliers are in the fit: the limit is wider by this factor.
LOOSE = 1.5
#: The median of Rayleigh's distribution of unit deviation.
MEDIAN = 1.1774


def errors_px(model: Model, point: Point) -> list[Array]:
    """Lengths (V, n) of all corners' errors, in pixels, by stack; zero where a corner was not seen."""
    every = replace(model, weights=tuple(stack.known.astype(float) for stack in model.stacks), corner_px=1.0)
    return [
        np.linalg.norm(error.reshape(*stack.known.shape, 2), axis=2)
        for stack, error in zip(model.stacks, every.errors(point), strict=True)
    ]


def weights_of(model: Model, point: Point, corner_px: float, *, first: bool) -> tuple[Array, ...]:
    """1 for corners that count, 0 for outliers and for corners that were not seen, by stack.

    In the first round the corners' deviation is told by the median error, which outliers hardly move.
    """
    errors = errors_px(model, point)
    limit = LIMIT * corner_px
    if first:
        seen = np.concatenate([error[stack.known] for error, stack in zip(errors, model.stacks, strict=True)])
        limit = LOOSE * LIMIT * float(np.median(seen)) / MEDIAN
    return tuple(
        (stack.known & (error <= limit)).astype(float) for error, stack in zip(errors, model.stacks, strict=True)
    )
