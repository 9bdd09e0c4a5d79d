"""Options of the calibration of sensors that know only their own motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.errors import OptionError


@dataclass(frozen=True)
class OdometryOptions:
    """How odometries are calibrated.

    Attributes
    ----------
    window_s : float or None
        Length of the windows over which motions are compared, seconds. None: the length with the most information.
    estimate_time_offsets : bool
        Whether each sensor's clock is compared with the reference's. Leave out only for one clock.
    search_s : float
        Time offsets are searched from -search_s to search_s.
    max_speed_m_per_s : float
        A step faster than this is an error of tracking (DQ paper, Appendix D.1, whose limit of 0.1 m a frame has the
        frame rate in it). The default is above what roads see.
    max_turn_rad_per_s : float
        A step that turns faster than this is an error of tracking. The paper's 11.5 degrees a frame at 30 frames a
        second.
    max_gap_s : float
        Poses of a track are not interpolated over gaps longer than this.
    reject_outliers : bool
        Whether windows are left out in which a sensor contradicts the others.
    """

    window_s: float | None = None
    estimate_time_offsets: bool = True
    search_s: float = 1.0
    max_speed_m_per_s: float = 70.0
    max_turn_rad_per_s: float = float(np.radians(11.5 * 30.0))
    max_gap_s: float = 0.5
    reject_outliers: bool = True

    def __post_init__(self) -> None:
        for name in ("window_s", "search_s", "max_speed_m_per_s", "max_turn_rad_per_s", "max_gap_s"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0.0):
                raise OptionError(f"OdometryOptions: {name} is {value!r}; give a positive number")
