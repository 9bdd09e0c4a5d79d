"""Which stages must run again if a log that a stage wrote is used with a changed rig file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.files.terminal_text import some
from gtsam_rwhec.logs import Log
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.rig.odometry_sections import OdometrySensor
from gtsam_rwhec.rig.sections import Sensor
from gtsam_rwhec.runs.run_log import read_embedded_rig

#: Detection depends on these keys of a sensor's section.
DETECTED_BY = ("images", "detections", "clouds", "unit_m", "intrinsics")
#: Cleaning depends on these keys of the section of the carriers.
CLEANED_BY = ("sensors", "targets", "poses", "max_gap_s")
#: A message names at most this many differences.
MOST_NAMED = 10


@dataclass(frozen=True)
class Changes:
    """Keys in which a rig file differs from the one that a log was made with, by the stage that must run again.

    Sensors and targets that the new rig file leaves out do not count. Keys that only solving depends on (sizes, noise,
    robust, stated) do not count either.
    """

    detection: tuple[str, ...]
    cleaning: tuple[str, ...]


def changes(made_with: Rig, rig: Rig) -> Changes:
    """Compare the rig file that a log was made with and a new one."""
    return Changes(tuple(_of_detection(made_with, rig)), tuple(_of_cleaning(made_with, rig)))


def rig_for_cleaning(log: Log, rig: Rig | None) -> Rig:
    """The rig file for cleaning a log of detections: `rig`, or by default the log's own.

    Raises `LogError` if targets or cameras of `rig` differ from those that detection used.
    """
    made_with = read_embedded_rig(log)
    if rig is None:
        return made_with
    keys = changes(made_with, rig).detection
    if keys:
        raise LogError(
            f"{log.files[0].path} was made with another rig file. The rig files differ in "
            f"{some(keys, MOST_NAMED)}, and the detections depend on this: begin with the raw log, or leave --rig out"
        )
    return rig


def rig_for_solving(log: Log, rig: Rig | None) -> Rig:
    """The rig file for solving a cleaned log: `rig`, or by default the log's own.

    Raises `LogError` if targets or cameras of `rig` differ from those that detection used, or if its carriers or its
    settings for cleaning differ from those that cleaning used.
    """
    chosen = rig_for_cleaning(log, rig)
    keys = changes(read_embedded_rig(log), chosen).cleaning
    if keys:
        raise LogError(
            f"{log.files[0].path} was cleaned with another rig file. The rig files differ in "
            f"{some(keys, MOST_NAMED)}. Clean the log again with this rig file (gtsam-rwhec clean LOG --rig ..., or "
            "calibrate), or leave --rig out"
        )
    return chosen


def _of_detection(made_with: Rig, rig: Rig) -> Iterator[str]:
    yield from (f"targets.{name}" for name, target in rig.targets.items() if made_with.targets.get(name) != target)
    for name, sensor in rig.sensors.items():
        old = made_with.sensors.get(name)
        if old is None:
            yield f"sensors.{name}"
        else:
            before, now = _for_detection(old), _for_detection(sensor)
            yield from (f"sensors.{name}.{key}" for key in DETECTED_BY if getattr(before, key) != getattr(now, key))
    if made_with.detection != rig.detection:
        yield "detection"
    if made_with.corner_px != rig.corner_px:
        yield "noise.corner_px"


def _for_detection(sensor: Sensor) -> Sensor:
    """The sensor's section without `intrinsics.stated`, which only refinement uses."""
    if sensor.intrinsics is None:
        return sensor
    return sensor.model_copy(update={"intrinsics": sensor.intrinsics.model_copy(update={"stated": None})})


def _before_solving(sensor: OdometrySensor | None) -> OdometrySensor | None:
    """The sensor's section without ``together``, which only solving uses."""
    if sensor is None:
        return None
    return sensor.model_copy(update={"odometry": sensor.odometry.model_copy(update={"together": True})})


def _of_cleaning(made_with: Rig, rig: Rig) -> Iterator[str]:
    old, new = made_with.carriers, rig.carriers
    yield from (f"carriers.{key}" for key in CLEANED_BY if getattr(old, key) != getattr(new, key))
    for name, sensor in rig.sensors.items():
        if name in made_with.sensors and made_with.sensors[name].time_offset != sensor.time_offset:
            yield f"sensors.{name}.time_offset"
    for name, odometry in rig.odometries.items():
        if _before_solving(made_with.odometries.get(name)) != _before_solving(odometry):
            yield f"sensors.{name}"
    if made_with.reference != rig.reference:
        yield "reference"
    if made_with.cleaning.model_copy(update={"robust": rig.cleaning.robust}) != rig.cleaning:
        yield "cleaning"
