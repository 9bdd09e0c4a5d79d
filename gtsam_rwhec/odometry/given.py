"""What a person knows of sensors that know only their own motion: heights, the ground, directions, distances."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from gtsam_rwhec.errors import FrameError, NoiseError, OptionError

Vector = tuple[float, float, float]
#: What has a known direction: an axis of the sensor, or the line from the reference sensor to it.
DirectionOf = Literal["x", "y", "z", "lever_arm"]

#: No two sensors of a vehicle are further apart, metres; nor further above the ground.
MOST_M = 150.0


@dataclass(frozen=True)
class Ground:
    """The plane that the vehicle drives on, in the reference sensor's frame.

    Attributes
    ----------
    normal : (x, y, z)
        It points up, away from the ground; of any length.
    distance_m : float
        Height of the reference sensor's origin above the plane, metres.
    sigma_rad : float
        Standard deviation of the normal about each axis across it, radians.
    sigma_m : float
        Standard deviation of the distance, metres.
    """

    normal: Vector
    distance_m: float
    sigma_rad: float
    sigma_m: float


@dataclass(frozen=True)
class KnownDirection:
    """A direction in the reference sensor's frame.

    Attributes
    ----------
    sensor : str
        The sensor that it is about.
    of : "x", "y", "z" or "lever_arm"
        An axis of the sensor, or the line from the reference sensor's origin to the sensor's.
    direction : (x, y, z)
        In the reference sensor's frame; of any length.
    sigma_rad : float
        Standard deviation about each axis across it, radians.
    """

    sensor: str
    of: DirectionOf
    direction: Vector
    sigma_rad: float


@dataclass(frozen=True)
class Given:
    """What a person knows; nothing by default.

    Attributes
    ----------
    heights_m : dict of sensor to (value, sigma)
        Heights of the sensors' origins above the ground, metres. The reference sensor needs one too, or the ground.
    ground : Ground or None
        The plane that the vehicle drives on. Without it heights are along the axis that the vehicle turned about.
    directions : tuple of KnownDirection
    distances_m : dict of (sensor, sensor) to (value, sigma)
        Measured distances of two sensors' origins, metres. They are used in the refinement only.
    """

    heights_m: dict[str, tuple[float, float]] = field(default_factory=dict, hash=False)
    ground: Ground | None = None
    directions: tuple[KnownDirection, ...] = ()
    distances_m: dict[tuple[str, str], tuple[float, float]] = field(default_factory=dict, hash=False)

    @property
    def is_empty(self) -> bool:
        """Whether nothing is given that says where a sensor is."""
        return not (self.heights_m or self.directions or self.distances_m)

    def checked(self, sensors: Collection[str], reference: str) -> None:
        """Raise an error in words for what is not about these sensors, or is no number.

        Raises
        ------
        FrameError
            A sensor is not there, is the reference where it may not be, or is given twice in a distance.
        NoiseError
            A standard deviation is not positive and finite.
        OptionError
            A value is not finite or larger than a vehicle, a distance or height not sensible, or a direction has no
            length.
        """
        for where, named in self._named():
            if named not in sensors:
                raise FrameError(
                    f"{where} is of {named!r}, and no track is of that sensor; the sensors are {', '.join(sensors)}"
                )
        for where, value, sigma in self._numbers():
            if not np.isfinite(value):
                raise OptionError(f"{where} is {value!r}; give a finite number")
            if not (np.isfinite(sigma) and sigma > 0.0):
                raise NoiseError(f"{where} has the standard deviation {sigma!r}; give a positive number")
            if abs(value) > MOST_M:
                raise OptionError(
                    f"{where} is {value:g} m, and no vehicle is larger than {MOST_M:g} m; give metres: {value:g} mm "
                    f"would be {1e-3 * value:g}"
                )
        for where, direction in self._vectors():
            length = float(np.linalg.norm(direction)) if len(direction) == 3 else 0.0
            if not (np.isfinite(length) and length > 0.0):
                raise OptionError(f"{where} is {direction!r}; give three numbers that are not all zero")
        for known in self.directions:
            if known.of not in get_args(DirectionOf):
                raise OptionError(
                    f"the direction of {known.sensor} is of {known.of!r}; choose one of "
                    f"{', '.join(get_args(DirectionOf))}"
                )
            if known.sensor == reference:
                raise FrameError(
                    f"a direction is given for {reference!r}, which is the reference: its axes are the frame itself"
                )
        for (first, second), (value, _) in self.distances_m.items():
            if first == second:
                raise FrameError(f"a distance of {first!r} to itself is given; name two sensors")
            if value <= 0.0:
                raise OptionError(f"the distance of {first} and {second} is {value:g} m; give a positive number")
        others = [name for name in self.heights_m if name != reference]
        if others and reference not in self.heights_m and self.ground is None:
            raise FrameError(
                f"the height of {others[0]} is given, and neither that of the reference sensor {reference} nor the "
                "ground: poses are in the reference's frame, so heights count from there; give its height too"
            )

    def _named(self) -> Iterator[tuple[str, str]]:
        yield from (("a height", name) for name in self.heights_m)
        yield from (("a direction", known.sensor) for known in self.directions)
        yield from (("a distance", name) for pair in self.distances_m for name in pair)

    def _numbers(self) -> Iterator[tuple[str, float, float]]:
        yield from ((f"the height of {name}", *number) for name, number in self.heights_m.items())
        yield from ((f"the distance of {a} and {b}", *number) for (a, b), number in self.distances_m.items())
        yield from ((f"the direction of {known.sensor}", 0.0, known.sigma_rad) for known in self.directions)
        if self.ground is not None:
            yield "the ground's distance", self.ground.distance_m, self.ground.sigma_m
            yield "the ground's normal", 0.0, self.ground.sigma_rad

    def _vectors(self) -> Iterator[tuple[str, Vector]]:
        yield from ((f"the direction of {known.sensor}", known.direction) for known in self.directions)
        if self.ground is not None:
            yield "the ground's normal", self.ground.normal
