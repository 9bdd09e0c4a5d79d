"""A cell before the next measurement: its frames, cameras and boards, the noise, and the information so far."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.fitting.fit_options import CarrierNoise, Stated
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair


@dataclass(frozen=True, eq=False)
class Kit:
    """What stands there, whatever was measured."""

    cameras: dict[str, Camera]
    boards: dict[str, Array]  #: (n, 3): corners in the target's frame, metres
    carriers: tuple[str, str]  #: Names of the carriers of the sensors, and of the targets
    stated: dict[str, Stated]  #: Where the intrinsics come from
    carrier_noise: CarrierNoise
    corner_px: float


@dataclass(frozen=True, eq=False)
class View:
    """Where a sensor without intrinsics saw its targets: distances (m), and the widest angle from their mean (rad)."""

    axis: Array
    distances: tuple[float, float]
    angle: float


@dataclass(frozen=True, eq=False)
class Cell:
    """All that a plan needs. ``slots`` has the unknowns' places among ``dimension`` numbers, by their names."""

    X: dict[str, Array]
    Y: dict[str, Array]
    scale: dict[str, float]  #: By target: measured length / true length
    kit: Kit
    slots: dict[str, slice]
    dimension: int
    noise: dict[Pair, Array]  #: (2,): B's noise, rad and m; with a camera the factor of what the corners give
    carrier_noise: CarrierNoise | None
    known: Array  #: (d, d): information of the measurements so far, and of stated intrinsics
    rough: Array  #: (d,): information of the guesses, which any measurement beats
    floor: Array  #: (d, d): covariance that no measurement lowers
    degrees_of_freedom: float
    measured: Array  #: (N, 4, 4): A of the measurements so far
    views: dict[str, View]
    is_rough: bool  #: Whether a pose that counts is neither measured nor guessed: planned poses are as rough
    share: float = 1.0  #: A measurement counts for this share of its information, as those there are did

    @property
    def pairs(self) -> tuple[Pair, ...]:
        """All targets by all sensors that may see them."""
        every = (Pair(target, sensor) for target in self.X for sensor in self.Y)
        return tuple(pair for pair in every if self.has_corners(pair) or pair in self.noise)

    @property
    def covariance(self) -> Array:
        """(d, d): Of all unknowns now, with the guesses."""
        return np.linalg.inv(self.known + np.diag(self.rough)) + self.floor

    def has_corners(self, pair: Pair) -> bool:
        """Whether the corners of the target, and the sensor's camera, are known."""
        return pair.sensor in self.kit.cameras and pair.target in self.kit.boards

    def noise_of(self, pair: Pair) -> Array:
        """B's noise (2,): of a pair that was not measured the median of those with corners."""
        alike = [size for other, size in self.noise.items() if self.has_corners(other)]
        if pair in self.noise or not alike:
            return self.noise.get(pair, np.ones(2))
        return np.asarray(np.median(np.array(alike), axis=0))


def in_front(camera: Camera, board: Array) -> Array:
    """T_sensor_target of a board that faces the camera and fills half of its image."""
    distance = 2.0 * nearest_m(camera, board)
    return se3.pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, distance]))


def nearest_m(camera: Camera, board: Array) -> float:
    """The distance at which a board that faces the camera fills its image."""
    return float(camera.focal_px * np.linalg.norm(board, axis=1).max() / (0.5 * min(camera.width, camera.height)))
