"""What a result file keeps of ``calibrate``: findings, choices with their evidence, and how far off points are."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gtsam_rwhec.calibration.calibrated import Calibration
from gtsam_rwhec.calibration.choices import Choice
from gtsam_rwhec.calibration.task_units import PointUncertainty, point_sentence
from gtsam_rwhec.calibration.verdict import Finding


@dataclass(frozen=True)
class PointFields:
    """How far off a point is that a sensor sees; ``str()`` is a sentence.

    Attributes
    ----------
    frame, seen_from : str
        The sensor's frame, and the frame in which the point is expressed.
    point_m : 3 float
        The point in ``frame``, metres.
    level : float
        The true point is within ``radius_mm`` of the given one with this probability.
    radius_mm : float
        Millimetres; infinite (null) where a free direction moves the point.
    measurement_mm : float or None
        The same for the noise of one new measurement alone; None where it is not known.
    """

    frame: str
    seen_from: str
    point_m: tuple[float, float, float]
    level: float
    radius_mm: float
    measurement_mm: float | None

    def __str__(self) -> str:
        distance_m = math.hypot(*self.point_m)
        return point_sentence(self.frame, self.seen_from, distance_m, self.level, self.radius_mm, self.measurement_mm)

    @staticmethod
    def of(point: PointUncertainty) -> PointFields:
        """The record of a point."""
        x, y, z = point.point_m.tolist()
        return PointFields(point.frame, point.seen_from, (x, y, z), point.level, point.radius_mm, point.measurement_mm)


@dataclass(frozen=True)
class CalibrationFields:
    """What ``calibrate`` found and chose.

    Attributes
    ----------
    findings : tuple of Finding
        What it found against the poses, besides what certificate, free directions and log say; the verdict counts it.
    choices : tuple of Choice
        Every choice, with its evidence.
    points : tuple of PointFields
        How far off a point is, where each sensor typically saw its targets.
    noise : str
        The noise that the answer counts with, in words.
    outliers : str
        How many measurements were left out, in words.
    notes : tuple of str
        Warnings on the way that changed no choice.
    constant_errors : two tuples of 6 float, or empty
        Deviations of a constant error of the carriers' poses, which the covariance holds although no residual shows
        it: [omega (rad), v (m)] of the targets' carrier in its own axes, and of the sensors'. Another calibration with
        the same carriers has the same error.
    """

    findings: tuple[Finding, ...]
    choices: tuple[Choice, ...]
    points: tuple[PointFields, ...]
    noise: str
    outliers: str
    notes: tuple[str, ...]
    constant_errors: tuple[tuple[float, ...], ...] = ()

    @staticmethod
    def of(calibration: Calibration) -> CalibrationFields:
        """What a file keeps of a calibration, besides its solution and its refined poses."""
        return CalibrationFields(
            findings=calibration.findings,
            choices=calibration.choices,
            points=tuple(map(PointFields.of, calibration.points.values())),
            noise=str(calibration.noise),
            outliers=str(calibration.outliers),
            notes=calibration.notes,
            constant_errors=() if calibration.noise.model is None else calibration.noise.model.constant_deviations,
        )
