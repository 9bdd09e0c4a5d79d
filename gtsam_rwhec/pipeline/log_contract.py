"""The contract of the stages: the names under which one stage writes and the next stage reads.

Detection copies the raw log and adds `detections_topic`, `annotations_topic` and `poses_topic` of each sensor. Cleaning
copies the detected log and adds `pairs_topic` of each sensor. Solving copies the cleaned log, replaces its pairs by the
pairs that the answer was computed from, and adds `SOLUTION_TOPIC`. Each stage writes the metadata of the stages before
it again.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import TypeVar

from gtsam_rwhec.logs import Log, Record

Kind = TypeVar("Kind", bound=Record)

#: Topic of the calibrated frames, as static transforms: viewers show them at any time.
SOLUTION_TOPIC = "/calibration/tf_static"
#: Topics that detection writes.
_OF_DETECTION = re.compile(r"/calibration/.+/(detections|annotations|poses)")
#: Topics that cleaning and solving write.
_OF_CLEANING_AND_SOLVING = re.compile(r"/calibration/(.+/pairs|tf_static)")

#: Metadata: the text of the rig file.
RIG_METADATA = "gtsam_rwhec.rig"
#: Metadata: the intrinsics of each sensor.
CAMERAS_METADATA = "gtsam_rwhec.cameras"
#: Metadata: the report of detection.
DETECTION_METADATA = "gtsam_rwhec.detection"
#: Metadata: the report of cleaning.
CLEANING_METADATA = "gtsam_rwhec.cleaning"
#: Metadata: the certificate, for people who look at the log.
CERTIFICATE_METADATA = "gtsam_rwhec.certificate"

#: File of the output folder that detection writes; it is removed at the end.
DETECTED_LOG = "detected.mcap"
#: File of the output folder that cleaning writes; solving adds its solution.
CLEAN_LOG = "clean.mcap"
#: File of the output folder with the result, and name of its copy attached to the solved log.
RESULT_FILE = "result.json"
#: Folder of the pictures, in the output folder.
PLOTS_FOLDER = "plots"


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
    """Whether a stage wrote the log: only then it has the report of a stage."""
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
    """The records of one kind on some topics, in the order of the log; a topic that the log lacks has none."""
    there = {topic.name for topic in log.topics()}.intersection(topics)
    if there:
        yield from (record for record in log.records(there) if isinstance(record, kind))
