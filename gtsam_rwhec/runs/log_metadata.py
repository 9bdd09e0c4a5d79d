"""The metadata of a log that a stage wrote: rig file, intrinsics and reports."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import Log, LogWriter
from gtsam_rwhec.results.log_history import CleaningReport, DetectionReport
from gtsam_rwhec.rig import Rig, parse_rig, rig_text
from gtsam_rwhec.runs.image_names import image_names
from gtsam_rwhec.runs.log_contract import (
    CAMERAS_METADATA,
    CLEANING_METADATA,
    DETECTION_METADATA,
    IMAGES_METADATA,
    RIG_METADATA,
)

Report = TypeVar("Report", bound=BaseModel)


@dataclass(frozen=True, eq=False)
class LogMetadata:
    """The metadata of a log of detections or of pairs.

    Attributes
    ----------
    rig : Rig
        The rig file that the last stage worked with.
    cameras : dict of sensor to Camera
        Intrinsics that detection used.
    detection : DetectionReport
        The report of detection.
    cleaning : CleaningReport or None
        The report of cleaning; None before cleaning.
    image_names : dict of str to str
        Of the files that a folder's images were, as `image_names` has them.
    """

    rig: Rig
    cameras: Mapping[str, Camera]
    detection: DetectionReport
    cleaning: CleaningReport | None = None
    image_names: Mapping[str, str] = field(default_factory=dict)

    def write(self, out: LogWriter) -> None:
        """Write the metadata into a log."""
        out.metadata(RIG_METADATA, {"yaml": rig_text(self.rig)})
        entries = {
            sensor: json.dumps(
                {"width": c.width, "height": c.height, "model": c.model, "K": c.K.tolist(), "D": c.D.tolist()}
            )
            for sensor, c in self.cameras.items()
        }
        out.metadata(CAMERAS_METADATA, entries)
        out.metadata(DETECTION_METADATA, {"json": self.detection.model_dump_json()})
        if self.image_names:
            out.metadata(IMAGES_METADATA, self.image_names)
        if self.cleaning is not None:
            out.metadata(CLEANING_METADATA, {"json": self.cleaning.model_dump_json()})


def read_metadata(log: Log) -> LogMetadata:
    """Read the metadata that the stages so far wrote.

    Raises
    ------
    LogError
        No stage wrote the log, or its metadata is damaged.
    """
    rig = read_embedded_rig(log)
    cleaning = read_cleaning_report(log) if CLEANING_METADATA in log.metadata() else None
    detection = _report(log, DETECTION_METADATA, DetectionReport)
    return LogMetadata(rig, read_cameras(log), detection, cleaning, image_names(log))


def read_cleaning_report(log: Log) -> CleaningReport:
    """The report of cleaning; `LogError` if the log was not cleaned, or the report is damaged."""
    return _report(log, CLEANING_METADATA, CleaningReport)


def read_embedded_rig(log: Log) -> Rig:
    """The rig file that the last stage worked with; `LogError` if the log has none."""
    found = log.metadata().get(RIG_METADATA)
    if found is None or "yaml" not in found:
        raise LogError(
            f"{log.files[0].path} has no rig file in it: gtsam-rwhec detect or clean did not write it, or it is not "
            "whole. Begin with gtsam-rwhec detect"
        )
    return parse_rig(found["yaml"], f"{log.files[0].path}, metadata {RIG_METADATA}")


def read_cameras(log: Log) -> dict[str, Camera]:
    """The intrinsics that detection used, by sensor.

    Raises
    ------
    LogError
        The intrinsics are damaged.
    """
    where = f"{log.files[0].path}, metadata {CAMERAS_METADATA}"
    cameras = {}
    for sensor, text in log.metadata().get(CAMERAS_METADATA, {}).items():
        try:
            fields = json.loads(text)
            numbers = fields["width"], fields["height"], fields["model"], fields["K"], fields["D"]
            cameras[sensor] = Camera.of(*numbers, where)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            raise LogError(f"{where}: the intrinsics of {sensor} cannot be read: {error!r}") from error
    return cameras


def _report(log: Log, name: str, kind: type[Report]) -> Report:
    found = log.metadata().get(name)
    where = f"{log.files[0].path}, metadata {name}"
    if found is None or "json" not in found:
        raise LogError(
            f"{where} is missing: the stage before this one did not write this log, or the log is not whole. The "
            "stages are detect, clean, solve and export; each reads the log that the stage before it wrote"
        )
    try:
        return kind.model_validate_json(found["json"])
    except ValidationError as error:
        raise LogError(f"{where} cannot be read: {error.errors()[0]['msg']}") from error
