"""Drives of a vehicle whose sensors each know only their own motion, with the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate.simulated_noise import Seed

DriveShape = Literal["3d", "planar", "straight"]

#: Turn rates and speed are sums of this number of sines.
SINES = 6
#: Their frequencies, Hz: a vehicle's steering.
SLOWEST_HZ, FASTEST_HZ = 0.02, 0.25
#: Root mean square of the yaw rate, and of the roll and pitch rates in 3D, rad/s.
YAW_RAD_PER_S, TILT_RAD_PER_S = 0.4, 0.15
#: Mean speed, m/s, and the root mean square of its changes.
SPEED_M_PER_S, SPEED_CHANGE_M_PER_S = 4.0, 1.2
#: Root mean square of the sideways and upward speed in 3D, m/s.
DRIFT_M_PER_S = 0.4
#: Standard deviations of an outlier step's error about and along each axis.
OUTLIER_RAD, OUTLIER_M = 0.2, 1.0


@dataclass(frozen=True)
class SimulatedOdometry:
    """One sensor of a drive."""

    T_vehicle_sensor: Array  #: (4, 4)
    #: rotation_rad_per_sqrt_s, translation_m_per_sqrt_s: standard deviations of the error that each second adds,
    #: about and along each axis. The translation's is in true metres, before the scale.
    rotation_rad_per_sqrt_s: float = 0.002
    translation_m_per_sqrt_s: float = 0.02
    scale: float = 1.0  #: Measured over true length
    clock_offset_s: float = 0.0  #: Its stamp t is the vehicle's t + offset
    outlier_share: float = 0.0  #: This share of its steps is an outlier
    every: int = 1  #: It gives each so-many-th pose of the drive


@dataclass(frozen=True)
class Drive:
    """A simulated drive."""

    stamps_ns: np.ndarray  #: (N,): Of the truth, nanoseconds, on the vehicle's clock
    T_world_vehicle: Array  #: (N, 4, 4): The truth
    #: dict of sensor to (stamps_ns (M,), T_start_sensor (M, 4, 4)): the sensor's odometry on its own clock, from
    #: the identity
    tracks: dict[str, tuple[np.ndarray, Array]] = field(hash=False)
    sensors: dict[str, SimulatedOdometry] = field(hash=False)

    def T(self, first: str, second: str) -> Array:
        """The true pose (4, 4) of sensor ``second`` in the frame of sensor ``first``."""
        pair = np.array([self.sensors[name].T_vehicle_sensor for name in (first, second)])
        pose: Array = se3.inverse(pair[:1])[0] @ pair[1]
        return pose


def drive(
    sensors: Mapping[str, SimulatedOdometry],
    shape: DriveShape = "3d",
    *,
    seconds: float = 120.0,
    rate_hz: float = 10.0,
    seed: Seed = 0,
) -> Drive:
    """Drive with turns about all axes ("3d"), on a plane with curves ("planar"), or straight ahead ("straight").

    Each step's error is an independent twist in the sensor's frame after the step, as in odometry.

    Raises
    ------
    OptionError
        For an unknown shape, or a time or rate that is not positive.
    """
    if shape not in get_args(DriveShape):
        raise OptionError(f"drive: shape is {shape!r}; choose one of {', '.join(get_args(DriveShape))}")
    if not (seconds > 0.0 and rate_hz > 0.0):
        raise OptionError(f"drive: {seconds!r} s at {rate_hz!r} Hz; both must be positive")
    generator = np.random.default_rng(seed)
    count = round(seconds * rate_hz) + 1
    dt = 1.0 / rate_hz
    middle = (np.arange(count - 1) + 0.5) * dt
    twists = np.zeros((count - 1, 6))
    twists[:, 3] = SPEED_M_PER_S + _wave(middle, SPEED_CHANGE_M_PER_S, generator)
    if shape != "straight":
        twists[:, 2] = _wave(middle, YAW_RAD_PER_S, generator)
    if shape == "3d":
        twists[:, 0] = _wave(middle, TILT_RAD_PER_S, generator)
        twists[:, 1] = _wave(middle, TILT_RAD_PER_S, generator)
        twists[:, 4] = _wave(middle, DRIFT_M_PER_S, generator)
        twists[:, 5] = _wave(middle, DRIFT_M_PER_S, generator)
    steps = se3.expmap(twists * dt)
    T = _chained(steps)
    stamps = np.round(np.arange(count) * dt * 1e9).astype(np.int64)
    tracks = {name: _track(stamps, T, sensor, generator) for name, sensor in sensors.items()}
    return Drive(stamps, T, tracks, dict(sensors))


def _wave(times: Array, size: float, generator: np.random.Generator) -> Array:
    """A smooth random function of time with the given root mean square."""
    frequency = np.exp(generator.uniform(np.log(SLOWEST_HZ), np.log(FASTEST_HZ), SINES))
    phase = generator.uniform(0.0, 2.0 * np.pi, SINES)
    wave: Array = np.sqrt(2.0 / SINES) * size * np.sin(2.0 * np.pi * np.outer(times, frequency) + phase).sum(axis=1)
    return wave


def _chained(steps: Array) -> Array:
    T = np.empty((len(steps) + 1, 4, 4))
    T[0] = np.eye(4)
    for i, step in enumerate(steps):  # a product of matrices in order has no vectorised form in numpy
        T[i + 1] = T[i] @ step
    return T


def _track(
    stamps: np.ndarray, T_world_vehicle: Array, sensor: SimulatedOdometry, generator: np.random.Generator
) -> tuple[np.ndarray, Array]:
    stamps = stamps[:: sensor.every]
    T = T_world_vehicle[:: sensor.every] @ sensor.T_vehicle_sensor
    steps = se3.inverse(T[:-1]) @ T[1:]
    root = np.sqrt(np.diff(stamps) * 1e-9)[:, None]
    sigma = np.repeat([sensor.rotation_rad_per_sqrt_s, sensor.translation_m_per_sqrt_s], 3)
    errors = generator.standard_normal((len(steps), 6)) * sigma * root
    wrong = generator.random(len(steps)) < sensor.outlier_share
    errors += wrong[:, None] * generator.standard_normal((len(steps), 6)) * np.repeat([OUTLIER_RAD, OUTLIER_M], 3)
    steps = steps @ se3.expmap(errors)
    steps[:, :3, 3] *= sensor.scale
    return stamps - round(sensor.clock_offset_s * 1e9), _chained(steps)
