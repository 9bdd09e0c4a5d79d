"""Whether a calibration is off by less than a limit in a volume: the record, as files have it, and its words."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.terminal_text import rounded, shown
from gtsam_rwhec.geometry.poses import LARGEST_M, Array
from gtsam_rwhec.geometry.real_numbers import real_array
from gtsam_rwhec.results.equivalence_test import spread_directions
from gtsam_rwhec.results.file_record import Triple, triple

#: A ball is tested at the corners of a solid that holds it: so many points, this much farther out.
BALL_CORNERS, BALL_MARGIN = 250, 1.015


class Answer(StrEnum):
    """The answer of an acceptance test."""

    ACCEPTED = "accepted"  #: Off by less than the limit
    NOT_YET = "not_accepted_yet"  #: Neither is shown: more touches are needed
    NOT_DETERMINED = "not_determined"  #: The touches cannot tell the error in the volume, however many there are
    REJECTED = "rejected"  #: Off by more than the limit


@dataclass(frozen=True)
class Volume:
    """Where a calibration is to be accepted: a box along the axes of the frame that carries the sensor, or a ball."""

    shape: Literal["box", "ball"]
    centre_m: Triple
    half_m: Triple  #: Half the box's lengths; of a ball its radius, three times

    @staticmethod
    def box(low_m: ArrayLike, high_m: ArrayLike) -> Volume:
        """The box from its lowest corner (3,) to its highest, metres; a side may be 0."""
        low, high = _three(low_m, "low_m"), _three(high_m, "high_m")
        if not (high >= low).all():
            raise OptionError(f"the box from {low.tolist()} to {high.tolist()} has a negative length; exchange them")
        return Volume("box", triple((low + high) / 2.0), triple((high - low) / 2.0))

    @staticmethod
    def ball(centre_m: ArrayLike, radius_m: float) -> Volume:
        """The ball about a point (3,), metres."""
        radius = _three([radius_m, radius_m, radius_m], "radius_m")
        if not radius[0] > 0.0:
            raise OptionError(f"a ball of radius {radius_m} m; give a positive one")
        return Volume("ball", triple(_three(centre_m, "centre_m")), triple(radius))

    @property
    def corners_m(self) -> Array:
        """Points (V, 3) whose convex hull holds the volume: the eight corners of a box."""
        if self.shape == "ball":
            return np.asarray(self.centre_m + BALL_MARGIN * self.half_m[0] * spread_directions(BALL_CORNERS))
        signs = np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0], indexing="ij")).reshape(3, 8).T
        return np.asarray(self.centre_m + signs * self.half_m)

    def __str__(self) -> str:
        if self.shape == "ball":
            return f"the ball of radius {self.half_m[0]:.3f} m about {place_words(self.centre_m)}"
        spans = (f"{c - h:.3f} to {c + h:.3f}" for c, h in zip(self.centre_m, self.half_m, strict=True))
        return f"the box x {', '.join(f'{axis}{span}' for axis, span in zip(('', 'y ', 'z '), spans, strict=True))} m"


def _three(values: ArrayLike, name: str) -> Array:
    try:
        array = real_array(values)
    except ValueError as error:
        raise OptionError(f"{name} of the volume cannot be read as numbers: {error}") from error
    if array.shape != (3,) or not (np.abs(array) <= LARGEST_M).all():
        raise OptionError(f"{name} of the volume is {array.tolist()}; give three finite numbers, metres")
    return array


def place_words(point_m: Triple) -> str:
    """``(0.100, 0.200, 0.300) m``."""
    return f"({', '.join(f'{value:.3f}' for value in point_m)}) m"


@dataclass(frozen=True)
class Acceptance:
    """Whether the calibration of a sensor is off by less than a limit in a volume; ``str()`` is the answer in words."""

    sensor: str
    answer: Answer
    limit_mm: float
    level: float  #: Probability of the statement: a calibration that is off by the limit is accepted in 1 - level
    volume: Volume  #: In the axes of the frame that carries the sensor
    of: Literal["touches", "views"]  #: What measured it: touched points, or views of boards
    count: int  #: How many of them
    source: str  #: The name of their file or folder; empty where they come from memory
    estimate_mm: float  #: The largest error in the volume by the least-squares estimate; infinite if not determined
    upper_mm: float  #: The error everywhere in the volume is below this with probability ``level``
    lower_mm: float  #: The largest error in the volume is above this with probability ``level``
    worst_m: Triple  #: Where the upper bound is largest
    #: Standard deviation of one touch along each axis across the line of sight of the sensor, and along it, mm
    noise_mm: tuple[float, float]
    noise: Literal["estimated", "stated"]
    degrees_of_freedom: tuple[float, ...]  #: Of the noise: across and along, or of both together; infinite if stated
    known_to_mm: float  #: Error that all known points may share, as stated; it is part of both bounds
    scale_is_free: bool  #: Whether a scale of the sensor's lengths counts as unknown too
    #: How many more touches of the same kind lead to acceptance with a chance of 80 %, if the estimate is the true
    #: error. None where it is not asked, or where no number is enough
    more: int | None
    places_m: tuple[Triple, ...]  #: Corners of the volume where the next ones tell most, the first one first
    lacking: str  #: What the touches lack, and what to do; empty if the error is determined
    remarks: tuple[str, ...]

    def __str__(self) -> str:
        where = f"in {self.volume}, in the axes of the frame that carries {shown(self.sensor)}"
        level, limit = f"{100.0 * self.level:g} %", f"{self.limit_mm:g} mm"
        of = f"{self.count} {self.of if self.count > 1 else self.of.removesuffix('s' if self.of == 'views' else 'es')}"
        if self.answer is Answer.NOT_DETERMINED:
            return f"Not determined: {self.lacking} ({of}; the limit is {limit} {where})."
        by = f"estimate {rounded(self.estimate_mm)} mm, {of}"
        if self.answer is Answer.ACCEPTED:
            return (
                f"Accepted: {shown(self.sensor)} is off by less than {limit} with {level}: by less than "
                f"{rounded(self.upper_mm)} mm ({by}) {where}."
            )
        if self.answer is Answer.REJECTED:
            return (
                f"Rejected: {shown(self.sensor)} is off by more than {limit} with {level}: by more than "
                f"{rounded(self.lower_mm)} mm ({by}) {where}. Check the tool tip and the touched points, and calibrate "
                "again."
            )
        return (
            f"Not accepted yet: that {shown(self.sensor)} is off by less than {limit} is not shown with {level}, only "
            f"by less than {rounded(self.upper_mm)} mm ({by}) {where}. {self.advice}"
        )

    @property
    def advice(self) -> str:
        """What to do where it is not accepted yet, as sentences."""
        verb = "Touch" if self.of == "touches" else "Take"
        what = "" if self.of == "touches" else " views of a board"
        if self.known_to_mm >= self.limit_mm:
            return "The points themselves are not known to the limit: measure the tool tip better."
        if self.estimate_mm + self.known_to_mm >= self.limit_mm:
            said = (
                f"The estimate itself is not below the limit, by no more than chance. {verb} {self.count} more{what} "
                "and look again, or calibrate again."
            )
        elif self.more is None:
            said = f"No number of the same kind is enough: {verb.lower()} them more exactly, or elsewhere."
        else:
            said = f"{verb} {self.more} more{what} of the same kind"
            said += (
                f" (for a chance of 80 %, if the estimate is right), and test all {self.count + self.more} together."
            )
        if self.places_m:
            places = "; ".join(map(place_words, self.places_m))
            said += f" {'Points' if self.of == 'touches' else 'Boards'} near {places} tell most."
        return said
