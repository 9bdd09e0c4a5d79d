"""A sensor's odometry: its poses over time in a frame of its own, and how its errors grow."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gtsam_rwhec.errors import CountError, StampError
from gtsam_rwhec.geometry.poses import Array


@dataclass(frozen=True)
class OdometryNoise:
    """Errors that add up along the way: each step's error is independent of the others."""

    #: Standard deviation of the rotation's error about each axis after one second, radians
    rotation_rad_per_sqrt_s: float
    #: Standard deviation of the translation's error along each axis after one second, metres
    translation_m_per_sqrt_s: float


@dataclass(frozen=True)
class OdometryTrack:
    """The motion that one sensor measured.

    Raises
    ------
    CountError
        The numbers of stamps and poses differ.
    StampError
        The stamps do not ascend.
    """

    sensor: str  #: The sensor's name
    stamps_ns: np.ndarray  #: (N,): times of the poses, ascending, nanoseconds
    #: (N, 4, 4): the sensor's poses in the frame in which its odometry began, metres (times its unknown scale, where
    #: ``has_unknown_scale``)
    T_start_sensor: Array
    noise: OdometryNoise | None = None  #: None: it is estimated
    has_unknown_scale: bool = field(default=False)  #: Visual odometry of one camera: lengths are true up to one factor

    def __post_init__(self) -> None:
        stamps, poses = np.asarray(self.stamps_ns), np.asarray(self.T_start_sensor)
        if poses.shape != (len(stamps), 4, 4):
            raise CountError(
                f"the track of {self.sensor} has {len(stamps)} stamps and poses of shape {poses.shape}; "
                "give one 4 x 4 pose for each stamp"
            )
        backwards = np.flatnonzero(np.diff(stamps) <= 0)
        if len(backwards):
            row = int(backwards[0]) + 1
            raise StampError(
                f"the track of {self.sensor} goes back in time at row {row}: {int(stamps[row])} ns after "
                f"{int(stamps[row - 1])} ns; sort the rows, and keep one pose for each stamp"
            )
