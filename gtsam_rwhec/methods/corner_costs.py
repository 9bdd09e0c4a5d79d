"""What methods on corners share: observations as stacks, the plain reprojection cost, where a descent ended."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.fitting.corner_residuals import SHAPE, Linear, Stack, linearised, pixel_errors, stacks_of
from gtsam_rwhec.fitting.observations import Observations
from gtsam_rwhec.fitting.stated_intrinsics import parameters_of
from gtsam_rwhec.geometry.poses import Array

#: Boards are as stated.
FLAT = np.zeros(SHAPE)


@dataclass(frozen=True, eq=False)
class Corners:
    """Observations as stacks, with the carriers' poses A (I, 4, 4) of all instants.

    Frames are numbered: targets first, then sensors; `frames` (n, 4, 4) below are their poses X and Y in that order.
    """

    targets: tuple[str, ...]
    sensors: tuple[str, ...]
    stacks: tuple[Stack, ...]
    A: Array
    corner_px: float

    @staticmethod
    def of(observations: Observations) -> Corners:
        """The corners of observations."""
        stacks, A = stacks_of(observations)
        return Corners(observations.targets, observations.sensors, stacks, A, observations.corner_px)

    @property
    def number(self) -> int:
        """How many corners were seen."""
        return sum(int(stack.known.sum()) for stack in self.stacks)

    def frames_of(self, stack: Stack) -> tuple[int, int]:
        """The numbers of a stack's target and sensor."""
        return self.targets.index(stack.target), len(self.targets) + self.sensors.index(stack.sensor)

    def rows(self, stack: Stack, frames: Array) -> Linear:
        """Errors of a stack in pixels, with derivatives, by the measured A; infinite behind the camera."""
        i, j = self.frames_of(stack)
        return linearised(stack, frames[i], frames[j], self.A, parameters_of(stack.camera), FLAT)

    def cost(self, frames: Array) -> float:
        """Half the sum of squared reprojection errors over corner_px^2, by the measured A; infinite behind a camera."""
        total = 0.0
        for stack in self.stacks:
            i, j = self.frames_of(stack)
            error = pixel_errors(stack, frames[i], frames[j], self.A, parameters_of(stack.camera), FLAT)
            total += 0.5 * float((error**2).sum()) / self.corner_px**2
        return total


@dataclass(frozen=True, eq=False)
class Minimum:
    """Where a method's descent ended: the frames (n, 4, 4), its own cost there, its steps, and whether it converged."""

    frames: Array
    cost: float
    iterations: int
    converged: bool
