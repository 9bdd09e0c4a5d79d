"""The unknowns of a calibration of odometries: their numbers, and one state of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.window_motions import WindowMotions

#: Columns of each sensor in the derivatives: pose (6), logarithm of the scale, time offset.
COLUMNS = 8
SCALE, OFFSET = 6, 7
#: The ground's: tilts of its normal about two axes (rad), the reference's height (m).
GROUND = 3


@dataclass(frozen=True)
class Layout:
    """Which of a sensor's eight columns are unknowns, and where the ground's three are.

    Attributes
    ----------
    open : (m, 8) booleans
    has_ground : bool
    """

    open: np.ndarray
    has_ground: bool

    @staticmethod
    def of(scaled: np.ndarray, *, clocks: bool, has_ground: bool) -> Layout:
        """Sensor 0 is the one in whose frame the poses are; ``scaled`` (m,) says whose scale is unknown."""
        is_open = np.ones((len(scaled), COLUMNS), dtype=bool)
        is_open[:, SCALE], is_open[:, OFFSET] = scaled, clocks
        is_open[0] = False
        return Layout(is_open, has_ground)

    @cached_property
    def size(self) -> int:
        """How many unknowns there are."""
        return int(self.open.sum()) + GROUND * self.has_ground

    @cached_property
    def at(self) -> np.ndarray:
        """(m, 8) the number of each column, or ``size`` where it is none."""
        numbers = np.full(self.open.shape, self.size)
        numbers[self.open] = np.arange(int(self.open.sum()))
        return numbers

    @cached_property
    def ground(self) -> np.ndarray:
        """The numbers of the ground's unknowns."""
        return np.arange(self.size - GROUND, self.size) if self.has_ground else np.arange(0)

    @cached_property
    def poses(self) -> np.ndarray:
        """(m - 1, 6) the numbers of the poses' tangents."""
        numbers: np.ndarray = self.at[1:, :6]
        return numbers

    def spread(self, step: Array) -> Array:
        """A step (size,) by sensor and column, (m, 8)."""
        by_column: Array = np.append(step, 0.0)[self.at]
        return by_column


@dataclass(frozen=True)
class State:
    """Values of all unknowns.

    Attributes
    ----------
    T : (m, 4, 4) array
        Poses in the frame of sensor 0.
    scale : (m,) array
        Measured over true length.
    offset : (m,) array
        What is to be added to the time offsets with which the windows were made, seconds.
    motion : (n, 4, 4) array
        The motion of sensor 0 over each window.
    tilt : (2,) array
        Of the ground's normal, rad.
    height : float
        Of sensor 0 above the ground, metres.
    """

    T: Array
    scale: Array
    offset: Array
    motion: Array
    tilt: Array
    height: float

    @staticmethod
    def at(T: Array, scale: Array, windows: WindowMotions, height: float = 0.0) -> State:
        """At poses and scales; the motions are those of the first sensor that has each window."""
        m = len(T)
        motion = np.tile(np.eye(4), (len(windows), 1, 1))
        known = np.zeros(len(windows), dtype=bool)
        for k in np.argsort(scale != 1.0, kind="stable"):
            new = windows.used[k] & ~known
            M = windows.M[k, new].copy()
            M[:, :3, 3] /= scale[k]
            motion[new] = T[k] @ M @ se3.inverse(T[k][None])
            known |= new
        return State(T, scale, np.zeros(m), motion, np.zeros(2), height)

    def moved(self, layout: Layout, step: Array, of_motion: Array) -> State:
        """After a step of the unknowns (size,) and of the motions (n, 6)."""
        by_sensor = layout.spread(step)
        ground = step[layout.ground]
        return replace(
            self,
            T=self.T @ se3.expmap(by_sensor[:, :6]),
            scale=self.scale * np.exp(by_sensor[:, SCALE]),
            offset=self.offset + by_sensor[:, OFFSET],
            motion=self.motion @ se3.expmap(of_motion),
            tilt=self.tilt + ground[:2] if layout.has_ground else self.tilt,
            height=self.height + float(ground[2]) if layout.has_ground else self.height,
        )
