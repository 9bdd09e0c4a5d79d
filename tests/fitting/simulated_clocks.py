"""Cells whose carriers move while images are taken, and whose cameras' clocks are off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from rwhec_factors import se3
from simulated_cells import Cell

from gtsam_rwhec.fitting.corner_residuals import stacks_of

#: Speeds of the carriers about and along each axis: rad/s, m/s.
SPEED = np.repeat([0.4, 0.2], 3)


def moving(
    given: Cell, seed: int, offsets_s: Mapping[str, float], speed: NDArray[np.float64] = SPEED, *, alike: bool = False
) -> Cell:
    """The cell with A as it was `offsets_s` before each image of a sensor, and with the velocity that it had there.

    Velocities are drawn for each instant, or once for all.
    """
    stacks, A = stacks_of(given.observations)
    twist = np.random.default_rng(seed).normal(size=(1 if alike else len(A), 6)) * speed
    views = {}
    for stack in stacks:
        view = given.observations.views[stack.targets[0], stack.sensor]
        of_view = np.broadcast_to(twist, (len(A), 6))[stack.instant]
        before = view.A @ se3.expmap(-offsets_s.get(stack.sensor, 0.0) * of_view)
        views[stack.targets[0], stack.sensor] = replace(view, A=before, twist=of_view)
    return replace(given, observations=replace(given.observations, views=views))
