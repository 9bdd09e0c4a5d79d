"""What follows from a calibration's poses and covariances, for people: angles, relative poses, errors of points."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal

import gtsam
import numpy as np

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.fitting.refined import RefinedPoses, sigma_of
from gtsam_rwhec.fitting.unknowns import UnknownKind
from gtsam_rwhec.geometry.pose_covariances import standard_deviations
from gtsam_rwhec.geometry.real_numbers import finite_or_none
from gtsam_rwhec.problem.knowledge import scale_at
from gtsam_rwhec.results.file_record import FileRecord, NotNegative, Positive, Triple, triple

Deviations = tuple[float | None, float | None, float | None]
#: Metres from a sensor at which points are tested, beside the distance at which it saw its targets.
DISTANCES_M = (0.5, 1.0, 2.0)


class FrameAngles(FileRecord):
    """The rotation of a frame on its carrier as angles."""

    frame: str  #: Sensor or target
    rpy_deg: Triple  #: Roll, pitch, yaw, degrees: R = Rz(yaw) Ry(pitch) Rx(roll)


class Scalar(FileRecord):
    """A scale or a clock offset that was estimated."""

    kind: Literal["scale", "time_offset"]
    owner: str  #: Target or sensor; empty for a scale that all share
    value: float  #: Measured / true length; or seconds: a stamp + this = the carriers' time
    deviation: float | None  #: One standard deviation; null: infinite


class PointAt(FileRecord):
    """How far off a point is that a sensor sees at a distance, in the direction in which it saw its targets."""

    sensor: str
    seen_from: str  #: The frame in which the point is expressed
    distance_m: Positive  #: From the sensor
    is_seen: bool  #: Whether this is the typical distance of its targets
    radius_mm: float | None  #: The true point is within it; null: a free direction moves the point


class RelativePose(FileRecord):
    """The pose of a sensor in another sensor's frame, which is often known far better than each on its carrier."""

    first: str
    second: str
    translation_m: Triple  #: Of T_first_second
    rpy_deg: Triple  #: Roll, pitch, yaw, degrees
    deviations_mm: Deviations  #: Along the second's axes; null: infinite
    deviations_deg: Deviations  #: About the second's axes; null: infinite


class ClockEffect(FileRecord):
    """What an error of a clock offset that was estimated would do to a frame: E[pose | offset] - E[pose]."""

    sensor: str  #: Whose clock
    frame: str  #: Whose pose moves
    rotation_deg: NotNegative  #: Of one millisecond
    translation_mm: NotNegative  #: Of one millisecond


class Derived(FileRecord):
    """What follows from poses and covariances."""

    angles: tuple[FrameAngles, ...]  #: Of every sensor and target
    scalars: tuple[Scalar, ...] = ()  #: Scales and clock offsets that were estimated
    level: float = 0.95  #: Probability of the points' radii
    points: tuple[PointAt, ...] = ()  #: At several distances, by sensor
    relative: tuple[RelativePose, ...] = ()  #: Of sensors in the first sensor's frame
    clocks: tuple[ClockEffect, ...] = ()  #: Of every estimated offset on every frame


def derived_of(calibration: Calibration) -> Derived:
    """What follows from a calibration's poses and covariances."""
    poses, refined = calibration.Y | calibration.X, calibration.refined
    angles = tuple(FrameAngles(frame=name, rpy_deg=_rpy_deg(poses[name])) for name in sorted(poses, key=natural_key))
    if refined is None:
        return Derived(angles=angles)
    return Derived(
        angles=angles,
        scalars=tuple(scalars_of(refined)),
        level=calibration.options.level,
        points=tuple(_points(calibration)),
        relative=tuple(_relative(refined)),
        clocks=tuple(clock_effects(refined)),
    )


def scalars_of(refined: RefinedPoses) -> Iterator[Scalar]:
    """Scales and clock offsets with their deviations."""
    for unknown in refined.unknowns:
        deviation = sigma_of(refined, unknown)
        if unknown.kind is UnknownKind.SCALE:
            value = scale_at(refined.scale, unknown.owner)
            yield Scalar(kind="scale", owner=unknown.owner, value=value, deviation=deviation)
        elif unknown.kind is UnknownKind.TIME_OFFSET:
            value = refined.time_offsets_s[unknown.owner]
            yield Scalar(kind="time_offset", owner=unknown.owner, value=value, deviation=deviation)


def _points(calibration: Calibration) -> Iterator[PointAt]:
    """Points at `DISTANCES_M` and where the targets were seen."""
    for sensor in sorted(calibration.views, key=natural_key):
        if sensor not in calibration.Y:
            continue
        seen = np.array(calibration.views[sensor].point_m)
        typical = float(np.linalg.norm(seen))
        if not typical > 0.0:
            continue
        for distance in sorted({*DISTANCES_M, typical}):
            point = calibration.uncertainty_at(seen * (distance / typical), sensor, level=calibration.options.level)
            yield PointAt(
                sensor=sensor,
                seen_from=point.seen_from,
                distance_m=distance,
                is_seen=distance == typical,
                radius_mm=finite_or_none(point.radius_mm),
            )


def _relative(refined: RefinedPoses) -> Iterator[RelativePose]:
    first, *others = sorted(refined.Y, key=natural_key)
    for second in others:
        pose, covariance = refined.relative(first, second)
        degrees, millimetres = standard_deviations(covariance)
        yield RelativePose(
            first=first,
            second=second,
            translation_m=triple(pose.translation()),
            rpy_deg=_rpy_deg(pose),
            deviations_mm=_deviations(millimetres),
            deviations_deg=_deviations(degrees),
        )


def clock_effects(refined: RefinedPoses) -> Iterator[ClockEffect]:
    """The regression of each pose on each estimated offset: cov(pose, offset) / var(offset), times 1 ms."""
    frames = [name for name in (*refined.Y, *refined.X) if name in refined.names]
    for unknown in refined.unknowns:
        if unknown.kind is not UnknownKind.TIME_OFFSET:
            continue
        for frame in frames:
            joint = refined.covariance(frame, unknown)
            if not (np.isfinite(joint).all() and joint[6, 6] > 0.0):
                continue
            moved = 1e-3 * joint[:6, 6] / joint[6, 6]
            yield ClockEffect(
                sensor=unknown.owner,
                frame=frame,
                rotation_deg=math.degrees(float(np.linalg.norm(moved[:3]))),
                translation_mm=1e3 * float(np.linalg.norm(moved[3:])),
            )


def _rpy_deg(pose: gtsam.Pose3) -> Triple:
    return triple(np.degrees(pose.rotation().rpy()))


def _deviations(values: np.ndarray) -> Deviations:
    x, y, z = (finite_or_none(float(value)) for value in values)
    return x, y, z
