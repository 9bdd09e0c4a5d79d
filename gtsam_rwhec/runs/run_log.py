"""The contract of the stages: the names under which one stage writes and the next stage reads.

Detection copies the raw log and adds `detections_topic`, `annotations_topic` and `poses_topic` of each sensor, and the
odometries that are in files. Cleaning
copies the detected log and adds `pairs_topic` of each sensor. Solving copies the cleaned log, replaces its pairs by the
pairs that the answer was computed from, and adds `SOLUTION_TOPIC`. Each stage writes the metadata of the stages before
it again.
"""

from __future__ import annotations

import json
import re
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import NamedTuple, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, Log, LogWriter, Record
from gtsam_rwhec.results.log_history import CleaningReport, DetectionReport
from gtsam_rwhec.rig import Rig, parse_rig, rig_text

Kind = TypeVar("Kind", bound=Record)

#: This topic has the calibrated frames as static transforms, which viewers show at any time.
SOLUTION_TOPIC = "/calibration/tf_static"
#: Detection writes topics with these names.
_OF_DETECTION = re.compile(r"/calibration/.+/(detections|annotations|poses|odometry)")
#: Cleaning and solving write topics with these names.
_OF_CLEANING_AND_SOLVING = re.compile(r"/calibration/(.+/pairs|tf_static)")

#: This metadata holds the text of the rig file.
RIG_METADATA = "gtsam_rwhec.rig"
#: This metadata holds the intrinsics of each sensor.
CAMERAS_METADATA = "gtsam_rwhec.cameras"
#: This metadata holds the report of detection.
DETECTION_METADATA = "gtsam_rwhec.detection"
#: This metadata holds the report of cleaning.
CLEANING_METADATA = "gtsam_rwhec.cleaning"
#: This metadata holds the certificate, for people who look at the log.
CERTIFICATE_METADATA = "gtsam_rwhec.certificate"

#: A folder of images becomes a log in the output folder, with its name and this ending. It is removed at the end.
RECORDED_LOG = ".images.mcap"
#: This metadata has the names of the files that a folder's images were, by topic and stamp (`image_key`).
IMAGES_METADATA = "gtsam_rwhec.images"
#: Detection writes this file in the output folder. It is removed at the end.
DETECTED_LOG = "detected.mcap"
#: Cleaning writes this file in the output folder. Solving adds its solution to it.
CLEAN_LOG = "clean.mcap"
#: The result's file in the output folder has this name, and so has its copy attached to the solved log.
RESULT_FILE = "result.json"
#: What the report shows beside the result, in the output folder.
EVIDENCE_FILE = "evidence.json"
#: The report, in the output folder.
REPORT_FILE = "report.html"
#: The contact sheet of the images in the output folder: what was found, and what was not.
SEEN_SHEET = "seen.png"


def image_key(topic: str, stamp_ns: int) -> str:
    """The key of an image in `IMAGES_METADATA`."""
    return f"{topic} {stamp_ns}"


def detections_topic(sensor: str) -> str:
    """Topic of the detections of a sensor (``gtsam_rwhec.TagDetections``)."""
    return f"/calibration/{sensor}/detections"


def annotations_topic(sensor: str) -> str:
    """Topic of the outlines of a sensor's detections, for viewers (``foxglove.ImageAnnotations``)."""
    return f"/calibration/{sensor}/annotations"


def poses_topic(sensor: str) -> str:
    """Topic of the poses of a sensor's used detections, for viewers (``foxglove.PosesInFrame``)."""
    return f"/calibration/{sensor}/poses"


def pairs_topic(sensor: str) -> str:
    """Topic of the synchronised measurements of a sensor (``gtsam_rwhec.MeasuredPair``)."""
    return f"/calibration/{sensor}/pairs"


def is_from_stage(log: Log) -> bool:
    """Whether a stage wrote the log. Only then does it have the report of a stage."""
    return bool({DETECTION_METADATA, CLEANING_METADATA} & set(log.metadata()))


def raw_topics(log: Log) -> list[str]:
    """The topics that no stage wrote."""
    if not is_from_stage(log):
        return [topic.name for topic in log.topics()]
    return [name for name in topics_up_to_detection(log) if not _OF_DETECTION.fullmatch(name)]


def topics_up_to_detection(log: Log) -> list[str]:
    """The topics of the raw log and of detection."""
    return [topic.name for topic in log.topics() if not _OF_CLEANING_AND_SOLVING.fullmatch(topic.name)]


def records_of(log: Log, topics: Iterable[str], kind: type[Kind]) -> Iterator[Kind]:
    """The records of one kind on some topics, in the order of the log. A topic that the log lacks has none."""
    there = {topic.name for topic in log.topics()}.intersection(topics)
    if there:
        yield from (record for record in log.records(there) if isinstance(record, kind))


#: A part of a file's name has at most this many characters.
LONGEST = 80


def image_names(log: Log) -> Mapping[str, str]:
    """The names of the files that a folder's images were, by `image_key`; empty for other logs."""
    return log.metadata().get(IMAGES_METADATA, {})


def image_name(names: Mapping[str, str], topic: str, stamp_ns: int) -> str:
    """The name of the file that an image was, from its folder; else its stamp in nanoseconds."""
    return names.get(image_key(topic, stamp_ns), str(stamp_ns))


def picture_file(sensor: str, name: str) -> str:
    """The file name of an image's picture: its sensor and its own name, whatever characters strangers gave them."""
    stem = PurePosixPath(name).stem or name
    return f"{_plain(sensor)}_{_plain(stem)}.png"


def _plain(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name)[:LONGEST].strip(".") or "_"


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


class SeenCorners(NamedTuple):
    """A target's corners in an image: their numbers (n,), pixels (n, 2), and T_camera_target (4, 4), metres."""

    target: str
    indices: np.ndarray
    corners_px: Array
    T: Array


def seen_corners(log: Log, sensor: str, targets: Container[str]) -> Iterator[SeenCorners]:
    """The corners of a sensor's detections of some targets that were not rejected, and have corners and a pose."""
    for record in records_of(log, [detections_topic(sensor)], DetectionRecord):
        indices, pixels, T = record.corner_indices, record.corners_px, record.T_camera_tag
        if record.reason or record.id not in targets or indices is None or pixels is None or T is None:
            continue
        yield SeenCorners(record.id, np.array(indices), pixels, T)
