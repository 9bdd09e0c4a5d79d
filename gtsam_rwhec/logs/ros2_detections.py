"""Tags and boards that drivers of ROS 1 and ROS 2 found, to records: corners in pixels, poses, or both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import repeat
from typing import Any

import numpy as np

from gtsam_rwhec.errors import MessageError
from gtsam_rwhec.logs.cdr import Batch, Numbers, find
from gtsam_rwhec.logs.records import Array, DetectionRecord
from gtsam_rwhec.logs.ros2_fields import (
    Decode,
    Pose,
    Read,
    by_message,
    columns_of,
    frame_of,
    parts_of,
    poses_of,
    stamps_of,
)


@dataclass(frozen=True)
class Tag:
    """Paths of a tag's fields in each entry of the list `parts`; its id is a number, numbers, or a board's name.

    `header` is the path of what has a header in the entry, for messages without a header.
    """

    parts: str
    id: str
    family: str = ""
    pose: Pose | None = None
    corners: str = ""
    size: str = ""
    header: str = ""


def _detections(tags: Sequence[Tag], batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    root = batch.shape.tree
    found: list[list[DetectionRecord]] = []
    faults: dict[int, str] = {}
    for tag in tags:
        for tree in parts_of(batch, tag.parts):
            above = root if "header" in root or not tag.header else find(tree, tag.header)
            stamps, frame = stamps_of(batch, above), frame_of(batch, above)
            family = batch.text(tree, tag.family) if tag.family else ""
            poses: Any = repeat((None, None))
            corners: Any = repeat(None)
            if tag.corners:
                corners = _corners(batch, tree, tag.corners)
                for i in np.flatnonzero(~np.isfinite(corners).all(axis=(1, 2))).tolist():
                    faults.setdefault(i, f"corners {corners[i].tolist()} are not finite")
            if tag.pose is not None:
                T, covariances, wrong = poses_of(batch, [tree], tag.pose)
                poses = zip(T[0], covariances[0], strict=True)
                faults = wrong | faults
            each = zip(
                logged_ns, stamps, _ids(batch, tree, tag.id), corners, poses, _sizes(batch, tree, tag), strict=False
            )
            found.append(
                [
                    DetectionRecord(logged, stamp, topic, frame, family, id_, corners_px, T_i, S, size)
                    for logged, stamp, id_, corners_px, (T_i, S), size in each
                ]
            )
    return by_message(found, faults, len(logged_ns))


def _ids(batch: Batch, tree: Any, path: str) -> Any:
    """The id of each message; a bundle of tags has theirs, joined by commas."""
    name = find(tree, path)
    if isinstance(name, str):
        return repeat(name)
    numbers = batch.numbers(tree, path).reshape(len(batch.rows), -1)
    return [",".join(map(str, row)) for row in numbers.tolist()]


def _sizes(batch: Batch, tree: Any, tag: Tag) -> Any:
    """The side of a single tag in metres; None of a bundle, and where the message does not say it."""
    if not tag.size:
        return repeat(None)
    sizes = batch.numbers(tree, tag.size).astype(np.float64).reshape(len(batch.rows), -1)
    return sizes[:, 0].tolist() if sizes.shape[1] == 1 else repeat(None)


def _corners(batch: Batch, tree: Any, path: str) -> Array:
    """Corners in pixels (N, 4, 2): four messages with x and y, eight numbers in a list, or x0, y0 to x3, y3."""
    if path == "x0":
        return np.stack([columns_of(batch, tree, (f"x{i}", f"y{i}")) for i in range(4)], axis=1)
    corners = find(tree, path)
    if isinstance(corners, Numbers) and corners.count == 8:
        return batch.column(corners).astype(np.float64).reshape(-1, 4, 2)
    if not isinstance(corners, list) or len(corners) != 4:
        raise MessageError(f"field {path} is not a list of 4 points")
    return np.stack([columns_of(batch, corner, "xy") for corner in corners], axis=1)


def _aruco_markers(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    """Make one list of markers, as other drivers have it, from the two lists of ids and poses."""
    tree = batch.shape.tree
    ids, poses = find(tree, "marker_ids"), parts_of(batch, "poses")
    if not isinstance(ids, Numbers) or ids.count != len(poses):
        raise MessageError(f"marker_ids does not have one number for each of {len(poses)} poses")
    size = np.dtype(ids.dtype).itemsize
    tree["markers"] = [
        {"id": Numbers(ids.offset + i * size, ids.dtype, None), "pose": pose} for i, pose in enumerate(poses)
    ]
    return _detections([Tag("markers", "id", pose=Pose("pose"))], batch, topic, logged_ns)


def _apriltag_ros(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    """ROS 1's messages, whose poses have covariances in newer versions, and whose ids are then lists."""
    parts = parts_of(batch, "detections")
    tag = Tag("detections", "id", pose=Pose("pose.pose"), size="size", header="pose")
    if parts and "covariance" in find(parts[0], "pose.pose"):
        tag = replace(tag, pose=Pose("pose.pose.pose", "pose.pose.covariance"))
    elif parts and "covariance" in find(parts[0], "pose"):  # a port to ROS 2 that has no header inside
        tag = replace(tag, pose=Pose("pose.pose", "pose.covariance"), header="")
    return _detections([tag], batch, topic, logged_ns)


_OF_APRILTAG = [Tag("detections", "id", "family", corners="corners")]
SCHEMAS: dict[str, Decode] = {
    "apriltag_msgs/AprilTagDetectionArray": partial(_detections, _OF_APRILTAG),
    "isaac_ros_apriltag_interfaces/AprilTagDetectionArray": partial(
        _detections, [replace(_OF_APRILTAG[0], pose=Pose("pose.pose.pose", "pose.pose.covariance"))]
    ),
    "apriltag_ros/AprilTagDetectionArray": _apriltag_ros,
    "apriltags_ros/AprilTagDetectionArray": _apriltag_ros,
    "apriltags2_ros/AprilTagDetectionArray": _apriltag_ros,
    "ros2_aruco_interfaces/ArucoMarkers": _aruco_markers,
    "aruco_interfaces/ArucoMarkers": _aruco_markers,
    "aruco_msgs/MarkerArray": partial(_detections, [Tag("markers", "id", pose=Pose("pose.pose", "pose.covariance"))]),
    "aruco_opencv_msgs/ArucoDetection": partial(
        _detections, [Tag("markers", "marker_id", pose=Pose("pose")), Tag("boards", "board_name", pose=Pose("pose"))]
    ),
    "fiducial_msgs/FiducialArray": partial(_detections, [Tag("fiducials", "fiducial_id", corners="x0")]),
    "fiducial_msgs/FiducialTransformArray": partial(
        _detections, [Tag("transforms", "fiducial_id", pose=Pose("transform"))]
    ),
}
