"""The log of a run: names that all stages share, and a log that holds in memory what the stages found.

Detection adds `detections_topic`, `annotations_topic` and `poses_topic` of each sensor, and odometries in files;
cleaning adds `pairs_topic`; solving replaces the pairs by those of the answer and adds `SOLUTION_TOPIC`. Each stage
takes a log and returns a `RunLog`, which the next stage takes. A whole run writes it to a file once, at the end. A
stage that is run alone writes its own file, which the next stage reads.
"""

from __future__ import annotations

import heapq
import json
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError
from scipy.spatial.transform import Rotation

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import CloudRecord, DetectionRecord, Log, LogWriter, PairRecord, PoseRecord, Record
from gtsam_rwhec.logs.mcap_writer import Images
from gtsam_rwhec.logs.records import MEASURED_PAIR, TAG_DETECTIONS, Topic, transforms
from gtsam_rwhec.results.log_history import CleaningReport, DetectionReport
from gtsam_rwhec.rig import Rig, parse_rig, rig_text

Kind = TypeVar("Kind", bound=Record)
Report = TypeVar("Report", bound=BaseModel)

#: This topic has the calibrated frames as static transforms, which viewers show at any time.
SOLUTION_TOPIC = "/calibration/tf_static"
#: Detection writes topics with these names.
OF_DETECTION = re.compile(r"/calibration/.+/(detections|annotations|poses|clouds|odometry)")
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
#: The log of detections while a calibration is at work. It is removed at the end.
DETECTED_LOG = "detected.mcap"
#: The log of a run in the output folder: what was recorded, detected, cleaned and solved.
CALIBRATION_LOG = "calibration.mcap"
#: The result's file in the output folder has this name, and so has its copy attached to the solved log.
RESULT_FILE = "result.json"
#: What the report shows beside the result, in the output folder.
EVIDENCE_FILE = "evidence.json"
#: The report, in the output folder.
REPORT_FILE = "report.html"
#: The contact sheet of the images in the output folder: what was found, and what was not.
SEEN_SHEET = "seen.png"
#: A part of a file's name has at most this many characters.
LONGEST = 80


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


def clouds_topic(sensor: str) -> str:
    """Topic of a sensor's clouds, thinned, in its frame (``sensor_msgs/msg/PointCloud2``)."""
    return f"/calibration/{sensor}/clouds"


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
    return [name for name in topics_up_to_detection(log) if not OF_DETECTION.fullmatch(name)]


def topics_up_to_detection(log: Log) -> list[str]:
    """The topics of the raw log and of detection."""
    return [topic.name for topic in log.topics() if not _OF_CLEANING_AND_SOLVING.fullmatch(topic.name)]


def records_of(log: Log, topics: Iterable[str], kind: type[Kind]) -> Iterator[Kind]:
    """The records of one kind on some topics, in the order of the log. A topic that the log lacks has none."""
    there = {topic.name for topic in log.topics()}.intersection(topics)
    if there:
        yield from (record for record in log.records(there) if isinstance(record, kind))


def image_names(log: Log) -> Mapping[str, str]:
    """The names of the files that a folder's images were, by `image_key`; empty for other logs."""
    if isinstance(log, RunLog):
        return log.stages.image_names
    return log.metadata().get(IMAGES_METADATA, {})


def image_name(names: Mapping[str, str], topic: str, stamp_ns: int) -> str:
    """The name of the file that an image was, from its folder; else its stamp in nanoseconds."""
    return names.get(image_key(topic, stamp_ns), str(stamp_ns))


def picture_file(sensor: str, name: str) -> str:
    """The file name of an image's picture: its sensor and its own name, in characters that file names can have."""
    stem = PurePosixPath(name).stem or name
    return f"{_plain(sensor)}_{_plain(stem)}.png"


def _plain(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name)[:LONGEST].strip(".") or "_"


@dataclass(frozen=True, eq=False)
class LogMetadata:
    """What the stages wrote about themselves into a log."""

    rig: Rig  #: that the last stage worked with
    cameras: Mapping[str, Camera]  #: the intrinsics that detection used, by sensor
    detection: DetectionReport
    cleaning: CleaningReport | None = None  #: None before cleaning
    image_names: Mapping[str, str] = field(default_factory=dict)  #: of a folder's files, as `image_names` has them

    def entries(self) -> dict[str, dict[str, str]]:
        """The metadata records of a log, by name."""
        cameras = {sensor: json.dumps(camera.numbers) for sensor, camera in self.cameras.items()}
        entries = {
            RIG_METADATA: {"yaml": rig_text(self.rig)},
            CAMERAS_METADATA: cameras,
            DETECTION_METADATA: {"json": self.detection.model_dump_json()},
        }
        if self.image_names:
            entries[IMAGES_METADATA] = dict(self.image_names)
        if self.cleaning is not None:
            entries[CLEANING_METADATA] = {"json": self.cleaning.model_dump_json()}
        return entries

    def write(self, out: LogWriter) -> None:
        """Write the metadata into a log."""
        for name, entries in self.entries().items():
            out.metadata(name, entries)


class RunLog(Log):
    """A log with what the stages found, in memory. Reading it gives the same as reading the file written from it.

    `recorded` stays open; everything that no stage of this run found is read from it. Only its topics in `kept` are
    read: those of a stage that is run again are not. `found` has the new records by topic, in the order of time.
    `detections` has the detections by sensor as they are written.
    """

    def __init__(
        self,
        recorded: Log,
        kept: Collection[str],
        stages: LogMetadata,
        found: Mapping[str, Sequence[Record]],
        detections: Mapping[str, Sequence[DetectionRecord]],
    ) -> None:
        self.files, self.losses = recorded.files, recorded.losses
        self.recorded, self.kept, self.stages = recorded, kept, stages
        self.found, self.detections = found, detections

    @staticmethod
    def with_detections(
        log: Log,
        stages: LogMetadata,
        records: Mapping[str, Sequence[DetectionRecord]],
        others: Iterable[Sequence[CloudRecord] | Sequence[PoseRecord]] = (),
    ) -> RunLog:
        """A recorded log with the detections of each sensor, thinned clouds, and motions from files or clouds."""
        found: dict[str, Sequence[Record]] = {of[0].topic: of for of in others if of}
        for sensor, of_sensor in records.items():
            found[detections_topic(sensor)] = _as_read(detections_topic(sensor), of_sensor)
        return RunLog(log, raw_topics(log), stages, found, records)

    @staticmethod
    def with_pairs(log: Log, cleaning: CleaningReport, rig: Rig, records: Iterable[PairRecord]) -> RunLog:
        """A log of detections with the pairs that cleaning made of them."""
        found: dict[str, list[Record]] = defaultdict(list)
        for record in records:
            found[record.topic].append(record)
        stages = replace(read_metadata(log), rig=rig, cleaning=cleaning)
        if isinstance(log, RunLog):
            return RunLog(log.recorded, log.kept, stages, {**log.found, **found}, log.detections)
        return RunLog(log, topics_up_to_detection(log), stages, found, {})

    def topics(self) -> tuple[Topic, ...]:
        """Every topic, by name."""
        kinds = {
            DetectionRecord: (TAG_DETECTIONS, "json"), PairRecord: (MEASURED_PAIR, "json"),
            CloudRecord: ("sensor_msgs/msg/PointCloud2", "cdr"), PoseRecord: ("foxglove.PoseInFrame", "json"),
        }  # fmt: skip
        found = [
            Topic(name, *kinds[type(of[0])], len(of), of[0].logged_ns, of[-1].logged_ns, "")
            for name, of in self.found.items()
            if of
        ]
        kept = [topic for topic in self.recorded.topics() if topic.name in self.kept and topic.name not in self.found]
        return tuple(sorted([*kept, *found], key=lambda topic: topic.name))

    def metadata(self) -> dict[str, dict[str, str]]:
        """The metadata records that the file will have."""
        return self.stages.entries()

    def records(
        self, topics: Iterable[str] | None = None, on_bad: Literal["warn", "raise"] = "warn"
    ) -> Iterator[Record]:
        """The records of some topics in the order of log time, as of any log."""
        named = {topic.name for topic in self.topics()}
        wanted = named if topics is None else {topics} if isinstance(topics, str) else set(topics)
        found = [self.found[name] for name in sorted(wanted & self.found.keys())]
        others = wanted - self.found.keys()
        if others and not others <= named:
            raise LogError(
                f"{self.files[0].path} has no topic {min(others - named)}; it has: {self.topics_in_words()}."
            )
        recorded = self.recorded.records(others, on_bad) if others else ()
        return heapq.merge(*found, recorded, key=lambda record: record.logged_ns)

    def records_logged_at(self, topics: Iterable[str], logged_ns: Iterable[int]) -> Iterator[Record]:
        """The recorded messages of some topics whose log time is one of these."""
        return self.recorded.records_logged_at(topics, logged_ns)


def write_up_to_detection(log: Log, out: LogWriter, images: Images) -> None:
    """Write what was recorded, and what was found in it."""
    if not isinstance(log, RunLog):
        out.copy(log, topics_up_to_detection(log), images, of_stages=OF_DETECTION)
        return
    out.copy(log.recorded, log.kept, images, of_stages=OF_DETECTION)
    for cloud in records_of(log, log.found, CloudRecord):
        out.point_cloud(cloud)
    for pose in records_of(log, log.found, PoseRecord):
        out.pose(pose.topic, pose.stamp_ns, pose.parent, pose.T)
    for sensor, records in log.detections.items():
        of_image: dict[int, list[DetectionRecord]] = defaultdict(list)
        for record in records:
            of_image[record.stamp_ns].append(record)
        for stamp, seen in sorted(of_image.items()):
            out.detections(detections_topic(sensor), stamp, seen[0].frame, seen)
            outlines = [(r.label, r.corners_px) for r in seen if r.corners_px is not None and len(r.corners_px)]
            if outlines:
                out.annotations(annotations_topic(sensor), stamp, outlines)
            used = [r.T_camera_tag for r in seen if r.T_camera_tag is not None and not r.reason]
            if used:
                out.poses(poses_topic(sensor), stamp, seen[0].frame, np.array(used))


def write_run_log(log: RunLog, path: str | Path, images: Images) -> None:
    """Write the log of a run that is not solved yet into an MCAP file."""
    with LogWriter(path) as out:
        write_up_to_detection(log, out, images)
        for record in records_of(log, log.found, PairRecord):
            out.pair(record)
        log.stages.write(out)


def _as_read(topic: str, records: Sequence[DetectionRecord]) -> list[DetectionRecord]:
    """Detections as a file would give them: in the order of time, with poses converted to quaternions and back.

    So a whole run and single stages give the same results to the last bit.
    """
    posed = [record for record in records if record.T_camera_tag is not None]
    T = np.array([record.T_camera_tag for record in posed]).reshape(-1, 4, 4)
    of_quaternions, _ = transforms(T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat() if len(T) else T[:, 0])
    read = {id(record): pose for record, pose in zip(posed, of_quaternions, strict=True)}
    return [
        replace(record, topic=topic, logged_ns=record.stamp_ns, T_camera_tag=read.get(id(record)))
        for record in sorted(records, key=lambda record: record.stamp_ns)
    ]


def read_metadata(log: Log) -> LogMetadata:
    """The metadata that the stages wrote so far. Raises `LogError` if there is none, or it is damaged."""
    if isinstance(log, RunLog):
        return log.stages
    rig = read_embedded_rig(log)
    cleaning = read_cleaning_report(log) if CLEANING_METADATA in log.metadata() else None
    detection = _report(log, DETECTION_METADATA, DetectionReport)
    return LogMetadata(rig, read_cameras(log), detection, cleaning, image_names(log))


def read_cleaning_report(log: Log) -> CleaningReport:
    """The report of cleaning; `LogError` if the log was not cleaned, or the report is damaged."""
    if isinstance(log, RunLog) and log.stages.cleaning is not None:
        return log.stages.cleaning
    return _report(log, CLEANING_METADATA, CleaningReport)


def read_embedded_rig(log: Log) -> Rig:
    """The rig file that the last stage worked with; `LogError` if the log has none."""
    if isinstance(log, RunLog):
        return log.stages.rig
    found = log.metadata().get(RIG_METADATA)
    if found is None or "yaml" not in found:
        raise LogError(
            f"{log.files[0].path} has no rig file in it: gtsam-rwhec detect or clean did not write it, or it is not "
            "whole. Begin with gtsam-rwhec detect"
        )
    return parse_rig(found["yaml"], f"{log.files[0].path}, metadata {RIG_METADATA}")


def read_cameras(log: Log) -> dict[str, Camera]:
    """The intrinsics that detection used, by sensor; `LogError` if they are damaged."""
    if isinstance(log, RunLog):
        return dict(log.stages.cameras)
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
