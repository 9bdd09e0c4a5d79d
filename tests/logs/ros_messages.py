"""Messages with their packages' definitions, in bags of ROS 1 and ROS 2 that `rosbags` writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

rosbag1 = pytest.importorskip("rosbags.rosbag1")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

#: Definitions of packages that ROS's own distributions do not have.
DEFINITIONS = {
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y\n",
    "apriltag_msgs/msg/AprilTagDetection": (
        "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\nPoint centre\n"
        "Point[4] corners\nfloat64[9] homography\n"
    ),
    "apriltag_msgs/msg/AprilTagDetectionArray": "std_msgs/Header header\nAprilTagDetection[] detections\n",
    "apriltag_ros/msg/AprilTagDetection": (
        "int32[] id\nfloat64[] size\ngeometry_msgs/PoseWithCovarianceStamped pose\n"
    ),
    "apriltag_ros/msg/AprilTagDetectionArray": "std_msgs/Header header\nAprilTagDetection[] detections\n",
    "apriltags_ros/msg/AprilTagDetection": "int32 id\nfloat64 size\ngeometry_msgs/PoseStamped pose\n",
    "apriltags_ros/msg/AprilTagDetectionArray": "AprilTagDetection[] detections\n",
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetection": (
        "string family\nint32 id\ngeometry_msgs/Point center\ngeometry_msgs/Point[4] corners\n"
        "geometry_msgs/PoseWithCovarianceStamped pose\n"
    ),
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray": (
        "std_msgs/Header header\nAprilTagDetection[] detections\n"
    ),
    "aruco_msgs/msg/Marker": (
        "std_msgs/Header header\nuint32 id\ngeometry_msgs/PoseWithCovariance pose\nfloat64 confidence\n"
    ),
    "aruco_msgs/msg/MarkerArray": "std_msgs/Header header\nMarker[] markers\n",
    "aruco_opencv_msgs/msg/MarkerPose": "uint16 marker_id\ngeometry_msgs/Pose pose\n",
    "aruco_opencv_msgs/msg/BoardPose": "string board_name\ngeometry_msgs/Pose pose\n",
    "aruco_opencv_msgs/msg/ArucoDetection": "std_msgs/Header header\nMarkerPose[] markers\nBoardPose[] boards\n",
    "ros2_aruco_interfaces/msg/ArucoMarkers": (
        "std_msgs/Header header\nint64[] marker_ids\ngeometry_msgs/Pose[] poses\n"
    ),
    "fiducial_msgs/msg/Fiducial": (
        "int32 fiducial_id\nint32 direction\nfloat64 x0\nfloat64 y0\nfloat64 x1\nfloat64 y1\nfloat64 x2\nfloat64 y2\n"
        "float64 x3\nfloat64 y3\n"
    ),
    "fiducial_msgs/msg/FiducialArray": "std_msgs/Header header\nint32 image_seq\nFiducial[] fiducials\n",
}
#: The first version of apriltag_msgs had corners as numbers.
FIRST_APRILTAG = (
    "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\nfloat64[2] centre\n"
    "float64[8] corners\nfloat64[9] homography\n"
)
Message = tuple[str, str, dict[str, Any], int]


def bag(path: Path, version: int, messages: list[Message], definitions: dict[str, str] | None = None) -> Path:
    """A bag of (topic, type, fields, stamp_ns); fields that are left out are zero or empty."""
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if version == 1 else typesys.Stores.ROS2_HUMBLE)
    for name, text in (DEFINITIONS | (definitions or {})).items():
        store.register(typesys.get_types_from_msg(text, name))
    opened = rosbag1.Writer(path) if version == 1 else rosbag2.Writer(path, version=9)
    with opened as writer:
        connections = {}
        for topic, name, fields, stamp in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            made = _made(store, name, fields)
            raw = store.serialize_ros1(made, name) if version == 1 else store.serialize_cdr(made, name)
            writer.write(connections[topic], stamp, raw)
    return path


def header(stamp_ns: int, frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}


def _made(store: Any, name: str, fields: dict[str, Any]) -> Any:
    values = {key: _value(store, kind, fields.get(key)) for key, kind in store.fielddefs[name][1]}
    assert set(fields) <= set(values), (name, set(fields) - set(values))
    return store.types[name](**values)


def _value(store: Any, kind: Any, value: Any) -> Any:
    node, inside = int(kind[0]), kind[1]
    if node == 2:  # a message
        return _made(store, inside, value or {})
    if node == 1:
        if inside[0] == "string":
            return value or ""
        return value if value is not None else 0
    part, length = inside
    items = value if value is not None else [None] * (length if node == 3 else 0)
    if int(part[0]) == 1 and part[1][0] != "string":
        return np.array([0 if item is None else item for item in items], dtype=part[1][0])
    return [_value(store, part, item) for item in items]
