"""The options of a plan: the wanted accuracy, what detection needs, where the robot may go, and rough guesses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Literal

import numpy as np

from gtsam_rwhec.capture.accuracy import Accuracy
from gtsam_rwhec.capture.plan_arm import Arm
from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.fitting.fit_options import CarrierNoise, Stated, check_choices
from gtsam_rwhec.geometry.poses import PoseLike
from gtsam_rwhec.geometry.real_numbers import is_real, is_whole

#: The carrier that the robot moves.
Moving = Literal["sensors", "targets"]
#: Candidates are drawn in vain for the most part; a plan has at most so many poses.
MOST_POSES, MOST_CANDIDATES = 100, 10_000


@dataclass(frozen=True)
class PlanOptions:
    """The options of `plan`; the defaults suit a camera on an arm before a board on a table."""

    #: So many poses are proposed, out of so many candidates that are seen and can be reached.
    poses: int = 12
    candidates: int = 200
    #: The wanted accuracy, and of which point. Of several sensors the worst counts.
    wanted: Accuracy = field(default_factory=Accuracy)
    #: Detection: the nearest and the farthest target (m; None: as the image and ``spacing_px`` allow), the most that a
    #: board is tilted (degrees), pixels between neighbouring corners, and the share of the image at its border that
    #: stays free.
    near_m: float | None = None
    far_m: float | None = None
    tilt_deg: float = 55.0
    spacing_px: float = 12.0
    border: float = 0.03
    #: The carrier that the robot moves, which may turn so far from its present pose (degrees), and whose origin stays
    #: in a box: its least and its largest x, y, z in the other carrier's frame (m).
    moves: Moving = "sensors"
    turn_deg: float = 90.0
    box_m: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    #: The arm, which can reach a pose or not.
    arm: Arm | None = None
    #: T_sensorcarrier_targetcarrier now; None: at the last measurement.
    present: PoseLike | None = None
    #: Rough poses of frames on their carriers, with their standard deviations; they count until the measurements
    #: tell more.
    guesses: Mapping[str, PoseLike] = field(default_factory=dict)
    guess_deg: float = 10.0
    guess_m: float = 0.05
    #: The noise of a corner (pixels), of A, and where the intrinsics come from, where no calibration has found them.
    corner_px: float = 0.15
    carrier_noise: CarrierNoise | None = None
    stated: Stated = "nominal"
    seed: int = 0

    def __post_init__(self) -> None:
        if not isinstance(self.wanted, Accuracy):
            raise OptionError(f"PlanOptions.wanted={brief(self.wanted)}; give a gtsam_rwhec.Accuracy")
        check_choices(self, {"moves": Moving, "stated": Stated})
        for name, most in (("poses", MOST_POSES), ("candidates", MOST_CANDIDATES)):
            if not (is_whole(value := getattr(self, name), 1) and value <= most):
                raise OptionError(f"PlanOptions.{name}={brief(value)}; give a whole number from 1 to {most}")
        optional = {"near_m", "far_m"}
        for one in fields(self):
            value = getattr(self, one.name)
            is_length = one.name in optional or one.type == "float"
            if (
                is_length
                and not (value is None and one.name in optional)
                and not (is_real(value) and 0.0 < value < 1e6)
            ):
                raise OptionError(f"PlanOptions.{one.name}={brief(value)}; give a positive number")
        for name, most_deg in (("tilt_deg", 90.0), ("turn_deg", 180.0)):
            if getattr(self, name) > most_deg:
                raise OptionError(f"PlanOptions.{name}={getattr(self, name):g}; give at most {most_deg:g} degrees")
        if self.border >= 0.5:
            raise OptionError(f"PlanOptions.border={self.border:g}; give less than half of the image")
        if self.near_m is not None and self.far_m is not None and self.near_m >= self.far_m:
            raise OptionError(f"PlanOptions: near_m={self.near_m:g} is not less than far_m={self.far_m:g}")
        if self.box_m is not None:
            box = np.array(self.box_m, dtype=float)
            if box.shape != (2, 3) or not (box[0] < box[1]).all():
                raise OptionError(
                    f"PlanOptions.box_m={brief(self.box_m)}; give the least and the largest x, y, z in metres"
                )
