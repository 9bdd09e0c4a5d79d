"""What must be done again when a log that a stage wrote is used with a changed rig file."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import Log
from gtsam_rwhec.pipeline.log_metadata import read_embedded_rig
from gtsam_rwhec.rig import Rig

#: Keys of a sensor's section that detection depends on.
DETECTED_BY = ("images", "detections", "intrinsics")


@dataclass(frozen=True)
class Changes:
    """Where a rig file differs from the one that a log was made with, by the stage that must be run again for it.

    Sensors and targets that are left out do not count, nor does what only solving depends on (sizes, noise, robust).
    """

    detection: tuple[str, ...]
    cleaning: tuple[str, ...]


def changes(made_with: Rig, rig: Rig) -> Changes:
    """Compare the rig file that a log was made with and another."""
    return Changes(tuple(_of_detection(made_with, rig)), tuple(_of_cleaning(made_with, rig)))


def rig_for_cleaning(log: Log, rig: Rig | None) -> Rig:
    """The rig file to clean a log of detections with: `rig`, or the log's own.

    Raises
    ------
    LogError
        `rig` has other targets or cameras than those that were detected.
    """
    made_with = read_embedded_rig(log)
    if rig is None:
        return made_with
    _check_detection(log, changes(made_with, rig))
    return rig


def rig_for_solving(log: Log, rig: Rig | None) -> Rig:
    """The rig file to solve a cleaned log with: `rig`, or the log's own.

    Raises
    ------
    LogError
        `rig` has other targets or cameras than those that were detected, or other carriers or cleaning.
    """
    made_with = read_embedded_rig(log)
    if rig is None:
        return made_with
    found = changes(made_with, rig)
    _check_detection(log, found)
    if found.cleaning:
        raise LogError(
            f"{log.files[0].path} was cleaned with another rig file; it differs in {_named(found.cleaning)}. Clean it "
            "anew with this one (gtsam-rwhec clean LOG --rig ..., or calibrate), or leave --rig out"
        )
    return rig


def _check_detection(log: Log, found: Changes) -> None:
    if found.detection:
        raise LogError(
            f"{log.files[0].path} was made with another rig file; it differs in {_named(found.detection)}. Detections "
            "rest on that: begin with the raw log, or leave --rig out"
        )


def _of_detection(made_with: Rig, rig: Rig) -> Iterator[str]:
    for name, target in rig.targets.items():
        if made_with.targets.get(name) != target:
            yield f"targets.{name}"
    for name, sensor in rig.sensors.items():
        if name not in made_with.sensors:
            yield f"sensors.{name}"
            continue
        old = made_with.sensors[name]
        yield from (f"sensors.{name}.{key}" for key in DETECTED_BY if getattr(old, key) != getattr(sensor, key))
    if made_with.detection != rig.detection:
        yield "detection"
    if made_with.corner_px != rig.corner_px:
        yield "noise.corner_px"


def _of_cleaning(made_with: Rig, rig: Rig) -> Iterator[str]:
    old, new = made_with.carriers, rig.carriers
    yield from (
        f"carriers.{key}"
        for key in ("sensors", "targets", "poses", "max_gap_s")
        if getattr(old, key) != getattr(new, key)
    )
    for name, sensor in rig.sensors.items():
        if name in made_with.sensors and made_with.sensors[name].time_offset != sensor.time_offset:
            yield f"sensors.{name}.time_offset"
    cleaned, cleaning = made_with.cleaning, rig.cleaning
    if cleaned.model_copy(update={"robust": cleaning.robust}) != cleaning:
        yield "cleaning"


def _named(places: Iterable[str]) -> str:
    some = list(places)
    return ", ".join(some[:10]) + (f" and {len(some) - 10} others" if len(some) > 10 else "")
