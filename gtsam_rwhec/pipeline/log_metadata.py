"""What the stages leave in a log for the next one: the rig file, the cameras and their reports, as metadata."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import Log, LogWriter
from gtsam_rwhec.rig import Rig, parse_rig, rig_text
from gtsam_rwhec.vision.camera import Camera

RIG, CAMERAS = "gtsam_rwhec.rig", "gtsam_rwhec.cameras"
DETECTION, CLEANING = "gtsam_rwhec.detection", "gtsam_rwhec.cleaning"

Report = TypeVar("Report", bound=BaseModel)


def write_rig(out: LogWriter, rig: Rig) -> None:
    """Embed a rig file."""
    out.metadata(RIG, {"yaml": rig_text(rig)})


def read_embedded_rig(log: Log) -> Rig:
    """The rig file that an earlier stage embedded.

    Raises
    ------
    LogError
        There is none.
    """
    found = log.metadata().get(RIG)
    if found is None or "yaml" not in found:
        raise LogError(
            f"{log.files[0].path} has no rig file in it: it was not written by gtsam-rwhec detect or clean, or is not "
            "whole. Begin with detect (again)"
        )
    return parse_rig(found["yaml"], f"{log.files[0].path}, metadata {RIG}")


def write_cameras(out: LogWriter, cameras: Mapping[str, Camera]) -> None:
    """Embed intrinsics, by sensor."""
    entries = {
        sensor: json.dumps(
            {"width": c.width, "height": c.height, "model": c.model, "K": c.K.tolist(), "D": c.D.tolist()}
        )
        for sensor, c in cameras.items()
    }
    out.metadata(CAMERAS, entries)


def read_cameras(log: Log) -> dict[str, Camera]:
    """Intrinsics that an earlier stage embedded, by sensor.

    Raises
    ------
    LogError
        They are damaged.
    """
    where = f"{log.files[0].path}, metadata {CAMERAS}"
    cameras = {}
    for sensor, text in log.metadata().get(CAMERAS, {}).items():
        try:
            fields = json.loads(text)
            numbers = fields["width"], fields["height"], fields["model"], fields["K"], fields["D"]
            cameras[sensor] = Camera.of(*numbers, where)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            raise LogError(f"{where}: the intrinsics of {sensor} cannot be read: {error!r}") from error
    return cameras


def write_report(out: LogWriter, name: str, report: BaseModel) -> None:
    """Embed a stage's report."""
    out.metadata(name, {"json": report.model_dump_json()})


def read_report(log: Log, name: str, kind: type[Report]) -> Report:
    """A stage's report.

    Raises
    ------
    LogError
        It is not there, or damaged.
    """
    found = log.metadata().get(name)
    where = f"{log.files[0].path}, metadata {name}"
    if found is None or "json" not in found:
        raise LogError(
            f"{where} is not there: the stage before this one did not write this log, or it is not whole. The stages "
            "are detect, clean, solve, export; each takes the log that the one before it wrote"
        )
    try:
        return kind.model_validate_json(found["json"])
    except ValidationError as error:
        raise LogError(f"{where} cannot be read: {error.errors()[0]['msg']}") from error
