"""The options of a refinement from corners."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.real_numbers import LARGEST_WHOLE, is_one_of, is_real, is_whole
from gtsam_rwhec.refinement.options import About, CarrierNoise
from gtsam_rwhec.reprojection.intrinsics import Stated

CarrierPoses = Literal["exact", "estimate"]


@dataclass(frozen=True)
class CornerOptions:
    """The options of `refine_corners`.

    Attributes
    ----------
    stated : "exact", "calibration", "nominal" or "unknown", or a dict of them by sensor
        Where the stated intrinsics come from. A calibration's are right to 0.3 % of f and 3 pixels of c, nominal ones
        to 3 % and to 30 pixels or 2 % of the width; the images alone say unknown ones, and exact ones are held. Sensors
        that a dict lacks are nominal. Where the images contradict what is stated, the deviation is widened, and the
        result says so.
    shared : tuple of tuple of str
        Groups of sensors whose intrinsics are the same: those of the group's first sensor are stated.
    size_share : float, or dict of str to float
        Standard deviation of the targets' sizes, a share of 1; 0: they are exactly as stated, as are those of targets
        that a dict lacks.
    warp_m : float
        Standard deviation of the height of a bent board's edge over its middle, metres; 0: boards are flat.
    corners_m : float
        Standard deviation of each corner's place on its board along each axis, metres, such as a printer's 1e-4; 0:
        they are where the board has them. With n corners there are 3n more unknowns: time grows with their square.
    carrier_noise : CarrierNoise, "estimate" or "exact"
        The noise of the carriers' poses A: given (standard deviations), estimated, or none.
    about : "targetcarrier" or "sensorcarrier"
        The carrier whose axes and origin A's noise has, where it is estimated: the one that moves.
    time_offsets : tuple of str
        Sensors whose clock's offset is free: images were taken that long after the times of their A, at which the views
        have the carriers' velocity (`Views.twist`). A prior of 1 s about no offset keeps it finite. Offsets above some
        milliseconds want A taken at the new time, and another refinement. A rolling shutter, whose rows are seen one
        after the other, is not modelled: an offset is that of the mean row.
    outliers : bool
        Leave corners out that disagree with all others.
    max_iterations : int
        Largest number of Levenberg-Marquardt steps of one round.
    """

    stated: Stated | Mapping[str, Stated] = "nominal"
    shared: tuple[tuple[str, ...], ...] = field(default=())
    size_share: float | Mapping[str, float] = 0.0
    warp_m: float = 0.0
    corners_m: float = 0.0
    carrier_noise: CarrierNoise | CarrierPoses = "estimate"
    about: About = "targetcarrier"
    time_offsets: tuple[str, ...] = ()
    outliers: bool = True
    max_iterations: int = 100

    def __post_init__(self) -> None:
        every = self.stated.values() if isinstance(self.stated, Mapping) else (self.stated,)
        for value, words, choices in (*((each, "stated", Stated) for each in every), (self.about, "about", About)):
            if not is_one_of(value, get_args(choices)):
                raise OptionError(
                    f"CornerOptions.{words}={brief(value)} is not one of {', '.join(map(repr, get_args(choices)))}"
                )
        shares = self.size_share.values() if isinstance(self.size_share, Mapping) else (self.size_share,)
        others = (("warp_m", self.warp_m), ("corners_m", self.corners_m))
        for name, deviation in (*(("size_share", each) for each in shares), *others):
            if not (is_real(deviation) and 0.0 <= deviation < np.inf):
                raise OptionError(f"CornerOptions.{name}={brief(deviation)}; give a standard deviation, or 0")
        noise = self.carrier_noise
        if not isinstance(noise, CarrierNoise) and not is_one_of(noise, get_args(CarrierPoses)):
            raise OptionError(
                f"CornerOptions.carrier_noise={brief(noise)}; give CarrierNoise(rotation_rad=..., translation_m=...), "
                "'estimate' or 'exact'"
            )
        if isinstance(noise, CarrierNoise) and noise.covariances is not None:
            raise OptionError("CornerOptions.carrier_noise has covariances; give rotation_rad and translation_m")
        offsets = self.time_offsets
        if not (isinstance(offsets, tuple) and all(isinstance(name, str) for name in offsets)):
            raise OptionError(
                f"CornerOptions.time_offsets={brief(offsets)}; give a tuple of sensors' names, such as ('cam_0',)"
            )
        if not is_whole(self.max_iterations, 1):
            raise OptionError(
                f"CornerOptions.max_iterations={brief(self.max_iterations)}; give a whole number from 1 to "
                f"{LARGEST_WHOLE}"
            )

    def stated_of(self, sensor: str) -> Stated:
        """Where a sensor's intrinsics come from."""
        return self.stated.get(sensor, "nominal") if isinstance(self.stated, Mapping) else self.stated

    def size_share_of(self, target: str) -> float:
        """The standard deviation of a target's size, a share of 1."""
        return self.size_share.get(target, 0.0) if isinstance(self.size_share, Mapping) else self.size_share

    def camera_of(self, sensor: str) -> str:
        """The sensor whose intrinsics this sensor has: its own, or the first one's of its group."""
        return next((group[0] for group in self.shared if sensor in group), sensor)
