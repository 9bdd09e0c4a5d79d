"""One valid message of each schema that the library reads, as trees of plain values."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
from log_files import POSE, TRANSFORM, foxglove_protobuf, header, ros2_log, xyz
from mcap.reader import make_reader
from mcap.writer import CompressionType

T0 = 1_700_000_000_000_000_000
_K = [500.0, 0, 320, 0, 510, 240, 0, 0, 1]
_POSE = {"pose": POSE, "covariance": np.diag([1.0, 4, 9, 0.01, 0.04, 0.09]).ravel().tolist()}
_STAMPED = {"header": header(T0, "/base"), "child_frame_id": "hand", "transform": TRANSFORM}
_TWIST = {"twist": {"linear": xyz(0, 0, 0), "angular": xyz(0, 0, 0)}, "covariance": [0.0] * 36}
_TAG = {
    "family": "36h11", "id": 7, "hamming": 0, "goodness": 0.0, "decision_margin": 50.0, "centre": xyz(1, 1),
    "corners": [xyz(0, 0), xyz(2, 0), xyz(2, 2), xyz(0, 2)], "homography": [0.0] * 9,
}  # fmt: skip
_ISAAC = {
    "family": "tag36h11", "id": 5, "center": xyz(1, 1, 0), "corners": [xyz(i, i, 0) for i in range(4)],
    "pose": {"header": header(T0, "cam"), "pose": _POSE},
}  # fmt: skip
_ROI = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}

#: By ROS 2 schema.
ROS2: dict[str, dict[str, Any]] = {
    "geometry_msgs/PoseStamped": {"header": header(T0), "pose": POSE},
    "geometry_msgs/PoseWithCovarianceStamped": {"header": header(T0), "pose": _POSE},
    "geometry_msgs/TransformStamped": _STAMPED,
    "tf2_msgs/TFMessage": {"transforms": [_STAMPED, _STAMPED]},
    "nav_msgs/Odometry": {"header": header(T0), "child_frame_id": "b", "pose": _POSE, "twist": _TWIST},
    "sensor_msgs/Image": {
        "header": header(T0, "cam"), "height": 2, "width": 3, "encoding": "mono8", "is_bigendian": 0, "step": 3,
        "data": b"abcdef",
    },
    "sensor_msgs/CompressedImage": {"header": header(T0, "cam"), "format": "jpeg", "data": b"\xff\xd8"},
    "sensor_msgs/CameraInfo": {
        "header": header(T0, "cam"), "height": 480, "width": 640, "distortion_model": "plumb_bob",
        "d": [0.1, 0.2, 0.0, 0.0, 0.3], "k": _K, "r": np.eye(3).ravel().tolist(), "p": [0.0] * 12,
        "binning_x": 0, "binning_y": 0, "roi": _ROI,
    },
    "apriltag_msgs/AprilTagDetectionArray": {"header": header(T0, "cam"), "detections": [_TAG, {**_TAG, "id": 8}]},
    "isaac_ros_apriltag_interfaces/AprilTagDetectionArray": {"header": header(T0, "cam"), "detections": [_ISAAC]},
    "ros2_aruco_interfaces/ArucoMarkers": {
        "header": header(T0, "cam"), "marker_ids": [3, 4], "poses": [POSE, POSE],
    },
    "aruco_msgs/MarkerArray": {
        "header": header(T0, "cam"),
        "markers": [{"header": header(T0, "cam"), "id": 9, "pose": _POSE, "confidence": 1.0}],
    },
    "aruco_opencv_msgs/ArucoDetection": {
        "header": header(T0, "cam"), "markers": [{"marker_id": 2, "pose": POSE}],
        "boards": [{"board_name": "lid", "pose": POSE}],
    },
}  # fmt: skip

_TIME = {"sec": T0 // 10**9, "nsec": 5}
_TRANSFORM = {"timestamp": _TIME, "parent_frame_id": "base", "child_frame_id": "hand", **TRANSFORM}
_PIXELS = base64.b64encode(b"abcdef").decode()
_T = [1.0, 0, 0, 1, 0, 1, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1]
_COVARIANCE = np.diag(np.arange(1.0, 7) / 7).ravel().tolist()

#: By schema of Foxglove or of this library, for JSON.
FOXGLOVE: dict[str, dict[str, Any]] = {
    "foxglove.FrameTransform": _TRANSFORM,
    "foxglove.FrameTransforms": {"transforms": [_TRANSFORM, _TRANSFORM]},
    "foxglove.PoseInFrame": {"timestamp": _TIME, "frame_id": "base", "pose": POSE},
    "foxglove.PosesInFrame": {"timestamp": _TIME, "frame_id": "base", "poses": [POSE, POSE]},
    "foxglove.CompressedImage": {"timestamp": _TIME, "frame_id": "c", "format": "png", "data": _PIXELS},
    "foxglove.RawImage": {
        "timestamp": _TIME, "frame_id": "c", "width": 3, "height": 2, "encoding": "mono8", "step": 3, "data": _PIXELS,
    },
    "foxglove.CameraCalibration": {
        "timestamp": _TIME, "frame_id": "c", "width": 4, "height": 3, "distortion_model": "kannala_brandt",
        "D": [0, 0, 0, 0], "K": [1, 0, 2, 0, 1, 2, 0, 0, 1], "R": [], "P": [],
    },
    "gtsam_rwhec.TagDetections": {
        "timestamp": _TIME, "frame_id": "c",
        "detections": [
            {
                "family": "36h11", "id": "7", "size_m": 0.1, "corners_px": [xyz(0, 0), xyz(2, 0), xyz(2, 2)],
                "corner_indices": [0, 1, 2], "pose": POSE, "covariance": _COVARIANCE, "reprojection_px": 0.5,
                "reason": "",
            },
            {"family": "36h11", "id": "8", "pose": None},
        ],
    },
    "gtsam_rwhec.MeasuredPair": {
        "timestamp": _TIME, "target": "tag", "sensor": "cam", "A": _T, "B": _T, "is_inlier": True, "reason": "",
        "covariance": _COVARIANCE,
    },
}  # fmt: skip


def encoded(schema: str, folder: Path) -> bytes:
    """The message of a ROS 2 schema in CDR."""
    path = ros2_log(folder / "one.mcap", [("/a", schema, ROS2[schema], T0)], CompressionType.NONE)
    with open(path, "rb") as stream:
        ((_, _, message),) = make_reader(stream).iter_messages()
    return message.data


def protobuf_message() -> Any:
    """A foxglove.FrameTransform."""
    message = foxglove_protobuf()["FrameTransform"](parent_frame_id="base", child_frame_id="hand")
    message.timestamp.FromNanoseconds(T0 + 5)
    message.translation.x, message.translation.y, message.translation.z = 1, 2, 3
    message.rotation.z, message.rotation.w = 0.6, 0.8
    return message
