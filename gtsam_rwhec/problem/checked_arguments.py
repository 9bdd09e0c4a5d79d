"""Arguments of ``Problem`` that several of its calls check, and what they warn of."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Literal

from gtsam_rwhec.errors import FrameError, OptionError, RotationsProjectedWarning
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import ROTATION_TOLERANCE
from gtsam_rwhec.problem.knowledge import check_name
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.problem.pairs import Pair

#: What the names of a pair are.
SIDES: tuple[Literal["target"], Literal["sensor"]] = ("target", "sensor")


def warn_of_projected(where: str, projected: int, stacklevel: int) -> None:
    """Warn of rotations that were not exact."""
    warnings.warn(
        f"{where}: {projected} rotations were not exact: R'R differs from I, by less than "
        f"{ROTATION_TOLERANCE:g}; they were projected to the nearest rotation",
        RotationsProjectedWarning,
        stacklevel=stacklevel + 1,
    )


def seen_pair(target: str, sensor: str) -> Pair:
    """A target and the sensor that saw it; a FrameError where their names are none, or one."""
    check_name(target, "the target's name")
    check_name(sensor, "the sensor's name")
    if target == sensor:
        raise FrameError(f"{target!r} is given as target and as sensor; names are unique across both")
    return Pair(target, sensor)


def check_measurements(measurements: object) -> None:
    """Raise an OptionError for anything but raw measurements by pair."""
    if not isinstance(measurements, Mapping):
        raise OptionError(f"measurements is a {type(measurements).__name__}; give {{pair: Measurements}}")
    for pair, raw in measurements.items():
        if not isinstance(pair, Pair) or not isinstance(raw, Measurements):
            raise OptionError(
                f"measurements has a {type(raw).__name__} for {brief(pair)}; give "
                "{Pair(target, sensor): Measurements}"
            )
