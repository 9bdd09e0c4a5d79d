"""The contract of the stages: the names under which one stage writes and the next stage reads.

Detection copies the raw log and adds `detections_topic`, `annotations_topic` and `poses_topic` of each sensor, and the
odometries that are in files. Cleaning
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
