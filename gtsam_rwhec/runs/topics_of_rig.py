"""Whether the topics that a rig file names are in the log, and whether their messages are of the sensors named."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

from gtsam_rwhec.errors import LogError, LogWarning
from gtsam_rwhec.files.yaml_lines import KeyPath
from gtsam_rwhec.logs import CloudRecord, DetectionRecord, ImageRecord, IntrinsicsRecord, Log
from gtsam_rwhec.logs.records import TAG_DETECTIONS, TF_TOPICS
from gtsam_rwhec.logs.ros2_messages import DETECTIONS
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.run_log import detections_topic, is_from_stage, pairs_topic

_IMAGES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage", "foxglove.RawImage", "foxglove.CompressedImage")
#: The types of messages that are read, by what the rig file takes from them.
READ = {
    "images": _IMAGES,
    "clouds": ("sensor_msgs/PointCloud2", "foxglove.PointCloud", *_IMAGES),
    "detections": (*DETECTIONS, TAG_DETECTIONS),
    "intrinsics": ("sensor_msgs/CameraInfo", "foxglove.CameraCalibration"),
    "poses": (
        "geometry_msgs/PoseStamped", "geometry_msgs/PoseWithCovarianceStamped", "geometry_msgs/TransformStamped",
        "nav_msgs/Odometry", "tf2_msgs/TFMessage", "foxglove.PoseInFrame", "foxglove.FrameTransform",
        "foxglove.FrameTransforms",
    ),
}  # fmt: skip


def check_topics(log: Log, rig: Rig) -> None:
    """Check the topics that a rig file names, before anything is read.

    Raises `LogError` if the log lacks a topic or its type cannot be read; the message says which line of the rig file
    names the topic, and what can be read. Warns (`LogWarning`) if the messages on a sensor's topic have the frame of
    another sensor: the two topics may be exchanged.
    """
    there = {topic.name for topic in log.topics()}
    _check_types(log, rig)
    for path, topic in named_topics(rig):
        # What else there is of intrinsics, their reader says.
        if topic not in there and path[-2:] != ("intrinsics", "topic"):
            file = log.files[0].path
            if is_from_stage(log):
                raise LogError(
                    f"{file} holds the detections and no topic {topic}: run gtsam-rwhec clean {file}, or detect in the "
                    "recording"
                )
            raise LogError(f"{rig.source.place(path)}: {file} has no topic {topic}; it has: {log.topics_in_words()}.")
    owners = {frame: name for name in rig.sensors for frame in (name, rig.frame_of(name))}
    for path, topic in named_topics(rig):
        frame, sensor = _frame_of(log, topic) if topic in there else "", str(path[1])
        if owners.get(frame, sensor) != sensor:
            warnings.warn(
                f"{rig.source.place(path)}: the messages on {topic} are of frame {frame}, which is that of sensor "
                f"{owners[frame]} and not of {sensor}. Are the topics of the two exchanged?",
                LogWarning,
                stacklevel=2,
            )


def wanted_topics(rig: Rig) -> tuple[str, ...]:
    """The topics that the stages read from a log, raw or with detections; tf topics have their usual names."""
    poses = rig.carriers.poses.topic
    own = (poses,) if poses is not None else tuple(f"/{name}" for name in TF_TOPICS)
    of_stage = (topic(sensor) for sensor in rig.sensors for topic in (detections_topic, pairs_topic))
    return tuple(dict.fromkeys((*own, *(topic for _, topic in named_topics(rig)), *of_stage)))


def _check_types(log: Log, rig: Rig) -> None:
    """Refuse topics of a type that cannot be read."""
    named = list(named_topics(rig))
    if rig.carriers.poses.topic is not None:
        named.append((("carriers", "poses", "topic"), rig.carriers.poses.topic))
    of_topic = {topic.name: topic for topic in log.topics()}
    for path, name in named:
        topic = of_topic.get(name)
        if topic is not None and topic.unreadable:
            has_poses = path[0] == "carriers" or path[-2:] == ("odometry", "topic")
            what = "poses" if has_poses else str(path[-2] if path[-1] == "topic" else path[-1])
            can = [each.name for each in of_topic.values() if each.schema.replace("/msg/", "/") in READ[what]]
            raise LogError(
                f"{rig.source.place(path)}: {log.files[0].path}, topic {name}: {topic.unreadable}. The types of {what} "
                f"that are read: {', '.join(READ[what])}. Topics of these in this log: {', '.join(can) or 'none'}"
            )


def named_topics(rig: Rig) -> Iterator[tuple[KeyPath, str]]:
    """The topics of sensors and where the rig file names them."""
    for name, sensor in rig.sensors.items():
        for key, topic in (("images", sensor.images), ("detections", sensor.detections), ("clouds", sensor.clouds)):
            if topic is not None:
                yield ("sensors", name, key), topic
        if sensor.intrinsics is not None and sensor.intrinsics.topic is not None:
            yield ("sensors", name, "intrinsics", "topic"), sensor.intrinsics.topic
    for name, moving in rig.odometries.items():
        for key, topic in (("topic", moving.odometry.topic), ("clouds", moving.odometry.clouds)):
            if topic is not None:
                yield ("sensors", name, "odometry", key), topic


def _frame_of(log: Log, topic: str) -> str:
    """The frame of a topic's first message; empty if the topic has no message or cannot be read."""
    if any(each.name == topic and each.unreadable for each in log.topics()):
        return ""
    kinds = (ImageRecord, IntrinsicsRecord, DetectionRecord, CloudRecord)
    with warnings.catch_warnings(action="ignore", category=LogWarning):  # the reader of the whole topic warns
        first = next((record for record in log.records([topic]) if isinstance(record, kinds)), None)
    return "" if first is None else first.frame
