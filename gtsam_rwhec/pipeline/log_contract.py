"""The contract of the stages: the names under which one stage writes and the next one reads.

Detection copies the raw log and adds `detections_topic`, `annotations_topic` and `poses_topic` of each sensor. Cleaning
copies that log and adds `pairs_topic` of each sensor. Solving copies that log, replaces the pairs by those that the
answer was computed from, and adds `SOLUTION_TOPIC`. Each stage writes the metadata of the stages before it anew.
"""

from __future__ import annotations

import re

from gtsam_rwhec.logs import Log

#: Poses of the calibrated frames, as static transforms: viewers show them at any time.
SOLUTION_TOPIC = "/calibration/tf_static"
_OF_DETECTION = re.compile(r"/calibration/.+/(detections|annotations|poses)")
_OF_CLEANING_AND_SOLVING = re.compile(r"/calibration/(.+/pairs|tf_static)")

#: Names of metadata records.
RIG_METADATA = "gtsam_rwhec.rig"
CAMERAS_METADATA = "gtsam_rwhec.cameras"
DETECTION_METADATA = "gtsam_rwhec.detection"
CLEANING_METADATA = "gtsam_rwhec.cleaning"
CERTIFICATE_METADATA = "gtsam_rwhec.certificate"

#: Files in the output folder; the result is attached to the solved log under the same name.
DETECTED_LOG = "detected.mcap"
CLEAN_LOG = "clean.mcap"
RESULT_FILE = "result.json"
PLOTS_FOLDER = "plots"


def detections_topic(sensor: str) -> str:
    """Where the detections of a sensor are (``gtsam_rwhec.TagDetections``)."""
    return f"/calibration/{sensor}/detections"


def annotations_topic(sensor: str) -> str:
    """Where the outlines of a sensor's detections are, for viewers (``foxglove.ImageAnnotations``)."""
    return f"/calibration/{sensor}/annotations"


def poses_topic(sensor: str) -> str:
    """Where the poses of a sensor's used detections are, for viewers (``foxglove.PosesInFrame``)."""
    return f"/calibration/{sensor}/poses"


def pairs_topic(sensor: str) -> str:
    """Where the synchronised measurements of a sensor are (``gtsam_rwhec.MeasuredPair``)."""
    return f"/calibration/{sensor}/pairs"


def is_from_stage(log: Log) -> bool:
    """Whether a stage wrote the log; a raw log has no report of a stage."""
    return bool({DETECTION_METADATA, CLEANING_METADATA} & set(log.metadata()))


def raw_topics(log: Log) -> list[str]:
    """Topics that no stage wrote."""
    if not is_from_stage(log):
        return [topic.name for topic in log.topics()]
    return [name for name in topics_up_to_detection(log) if not _OF_DETECTION.fullmatch(name)]


def topics_up_to_detection(log: Log) -> list[str]:
    """Topics that neither cleaning nor solving wrote."""
    return [topic.name for topic in log.topics() if not _OF_CLEANING_AND_SOLVING.fullmatch(topic.name)]
