"""The accuracy that is wanted: of plans, of the rule that stops, and of a live session."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gtsam_rwhec.calibration.point_uncertainty import checked_level
from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.terminal_text import brief, rounded
from gtsam_rwhec.geometry.real_numbers import is_real


@dataclass(frozen=True)
class Accuracy:
    """A point in front of a sensor is within ``radius_m`` of its true place on the sensor's carrier.

    The point is ``distance_m`` along z of each sensor, or of those in ``sensors``; with probability ``level``. A plan
    needs neither a radius (it says then what each pose leaves) nor a distance (None: where the sensor sees its
    targets).
    """

    radius_m: float = math.inf
    distance_m: float | None = None
    level: float = 0.95
    sensors: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, unset in (("radius_m", math.inf), ("distance_m", None)):
            value = getattr(self, name)
            if value != unset and not (is_real(value) and 0.0 < value < 1e6):
                raise OptionError(f"Accuracy.{name}={brief(value)}; give a positive number, metres")
        checked_level(self.level)

    @property
    def place_m(self) -> list[float]:
        """x, y, z of the point in a sensor's frame; an OptionError where no distance is stated."""
        if self.distance_m is None:
            raise OptionError(f"{self} has no distance; give Accuracy(radius_m, distance_m)")
        return [0.0, 0.0, self.distance_m]

    def __str__(self) -> str:
        radius = f"{rounded(1e3 * self.radius_m)} mm" if self.radius_m < math.inf else "any accuracy"
        return f"{radius} at {rounded(self.distance_m) if self.distance_m else '?'} m with {100 * self.level:g} %"
