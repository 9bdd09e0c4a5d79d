"""ROS 2 messages to records, by the name of their schema.

Every function takes a batch of messages of one shape and gives, for each message, its records or what is wrong with it
in words. A pose message becomes one `PoseRecord` (``TFMessage`` as many as it has transforms), an array of detections
one `DetectionRecord` for each tag.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gtsam_rwhec.errors import MessageError
from gtsam_rwhec.logs.cdr import Batch, MessageType, Numbers, find
from gtsam_rwhec.logs.checked_poses import gtsam_covariances, transforms
from gtsam_rwhec.logs.records import (
    Array,
    DetectionRecord,
    ImageRecord,
    IntrinsicsRecord,
    PoseRecord,
    Record,
)

#: A message's records, or what is wrong with it.
Read = Sequence[Record] | str
Decode = Callable[[Batch, str, list[int]], list[Read]]


def decoder(schema: str, definition: str) -> Callable[[str, Sequence[bytes | memoryview], list[int]], list[Read]]:
    """Make the function that reads messages of a schema: (topic, messages, logged_ns) -> records of each.

    Raises
    ------
    MessageError
        For a schema that is not in `SCHEMAS`, or whose definition in the log cannot be read.
    """
    decode = SCHEMAS[schema.replace("/msg/", "/")]
    message_type = MessageType(schema, definition)

    def read(topic: str, messages: Sequence[bytes | memoryview], logged_ns: list[int]) -> list[Read]:
        out: list[Read] = [()] * len(messages)
        for places, batch in message_type.batches(messages):
            if isinstance(batch, MessageError):
                results: list[Read] = [str(batch)] * len(places)
            else:
                try:
                    results = decode(batch, topic, [logged_ns[i] for i in places])
                except MessageError as error:
                    results = [str(error)] * len(places)
            for i, result in zip(places, results, strict=True):
                out[i] = result
        return out

    return read


def _stamps(batch: Batch, tree: Any) -> list[int]:
    seconds = batch.numbers(tree, "header", "stamp", "sec").astype(np.int64)
    nanoseconds = batch.numbers(tree, "header", "stamp", "nanosec").astype(np.int64)
    stamps: list[int] = (seconds * 1_000_000_000 + nanoseconds).tolist()
    return stamps


def _frame(tree: Any, *path: str) -> str:
    """tf2 has no leading slash; drivers from before it do."""
    name = find(tree, *(path or ("header", "frame_id")))
    if not isinstance(name, str):
        raise MessageError(f"field {'.'.join(path)} is no string")
    return name.removeprefix("/")


def _transforms(batch: Batch, tree: Any, position: str, orientation: str) -> tuple[Array, dict[int, str]]:
    where = find(tree, position)
    turned = find(tree, orientation)
    return transforms(
        np.stack([batch.numbers(where, axis).astype(np.float64) for axis in "xyz"], axis=1),
        np.stack([batch.numbers(turned, axis).astype(np.float64) for axis in "xyzw"], axis=1),
    )


def _covariances(batch: Batch, tree: Any, T: Array) -> list[Array | None]:
    numbers = batch.numbers(tree, "covariance").astype(np.float64)
    if numbers.shape[1:] != (36,):
        raise MessageError(f"field covariance has {numbers.shape[1:]} numbers in place of 36")
    return gtsam_covariances(T, numbers.reshape(-1, 6, 6))


def _poses(
    batch: Batch, topic: str, logged_ns: list[int], tree: Any, pose: Any, child: str, covariance: Any = None
) -> list[Read]:
    """Records of one pose of each message; `pose` and `covariance` are where these are in its tree."""
    names = ("translation", "rotation") if "translation" in pose else ("position", "orientation")
    T, faults = _transforms(batch, pose, *names)
    stamps = _stamps(batch, tree)
    parent = _frame(tree)
    covariances = _covariances(batch, covariance, T) if covariance is not None else [None] * len(T)
    records: list[Read] = [
        (PoseRecord(logged, stamp, topic, parent, child, T_i, covariance_i),)
        for logged, stamp, T_i, covariance_i in zip(logged_ns, stamps, T, covariances, strict=True)
    ]
    for i, fault in faults.items():
        records[i] = fault
    return records


def _pose_stamped(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    tree = batch.shape.tree
    return _poses(batch, topic, logged_ns, tree, find(tree, "pose"), "")


def _pose_with_covariance_stamped(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    tree = batch.shape.tree
    return _poses(batch, topic, logged_ns, tree, find(tree, "pose", "pose"), "", find(tree, "pose"))


def _odometry(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    tree = batch.shape.tree
    child = _frame(tree, "child_frame_id")
    return _poses(batch, topic, logged_ns, tree, find(tree, "pose", "pose"), child, find(tree, "pose"))


def _transform_stamped(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    return _one_transform(batch, topic, logged_ns, batch.shape.tree)


def _one_transform(batch: Batch, topic: str, logged_ns: list[int], tree: Any) -> list[Read]:
    return _poses(batch, topic, logged_ns, tree, find(tree, "transform"), _frame(tree, "child_frame_id"))


def _tf_message(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    parts = [_one_transform(batch, topic, logged_ns, tree) for tree in _list(batch.shape.tree, "transforms")]
    return _joined(parts, len(logged_ns))


def _list(tree: Any, *path: str) -> list[Any]:
    value = find(tree, *path)
    if not isinstance(value, list):
        raise MessageError(f"field {'.'.join(path)} is no list of messages")
    return value


def _joined(parts: list[list[Read]], count: int) -> list[Read]:
    """Parts' records of each message put together; the first fault is the message's."""
    if len(parts) == 1:
        return parts[0]
    out: list[Read] = []
    for i in range(count):
        of_message = [part[i] for part in parts]
        fault = next((read for read in of_message if isinstance(read, str)), None)
        out.append(
            fault if fault is not None else [r for read in of_message if not isinstance(read, str) for r in read]
        )
    return out


def _bytes(batch: Batch, *path: str) -> list[bytes]:
    leaf = find(batch.shape.tree, *path)
    if not isinstance(leaf, Numbers) or np.dtype(leaf.dtype).itemsize != 1:
        raise MessageError(f"field {'.'.join(path)} has no bytes")
    return [row.tobytes() for row in batch.rows[:, leaf.offset : leaf.offset + (leaf.count or 0)]]


def _image(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    tree = batch.shape.tree
    columns = [batch.numbers(tree, name).tolist() for name in ("width", "height", "step", "is_bigendian")]
    frame, encoding = _frame(tree), batch.text("encoding")
    out: list[Read] = []
    for logged, stamp, data, width, height, step, big in zip(
        logged_ns, _stamps(batch, tree), _bytes(batch, "data"), *columns, strict=True
    ):
        if width * height == 0 or step * height > len(data):
            out.append(f"image of {width} x {height} pixels, {step} bytes a row, has {len(data)} bytes")
        else:
            out.append((ImageRecord(logged, stamp, topic, frame, encoding, data, width, height, step, bool(big)),))
    return out


def _compressed_image(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    tree = batch.shape.tree
    frame, encoding = _frame(tree), batch.text("format")
    return [
        (ImageRecord(logged, stamp, topic, frame, encoding, data),) if data else "image without data"
        for logged, stamp, data in zip(logged_ns, _stamps(batch, tree), _bytes(batch, "data"), strict=True)
    ]


def _camera_info(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    tree = batch.shape.tree
    K, D, R, P = (batch.numbers(tree, name).astype(np.float64) for name in "kdrp")
    if (K.shape[1:], R.shape[1:], P.shape[1:]) != ((9,), (9,), (12,)):
        raise MessageError("k, r and p must have 9, 9 and 12 numbers")
    frame, model = _frame(tree), batch.text("distortion_model")
    sizes = zip(batch.numbers(tree, "width").tolist(), batch.numbers(tree, "height").tolist(), strict=True)
    return [
        (
            IntrinsicsRecord(
                logged_ns[i], stamp, topic, frame, width, height, model, K[i].reshape(3, 3), D[i], R[i].reshape(3, 3),
                P[i].reshape(3, 4),
            ),
        )
        for i, (stamp, (width, height)) in enumerate(zip(_stamps(batch, tree), sizes, strict=True))
    ]  # fmt: skip


def _detections(
    batch: Batch,
    topic: str,
    logged_ns: list[int],
    family: str,
    ids: list[str],
    poses: tuple[Array, dict[int, str]] | None = None,
    corners: Array | None = None,
    covariances: list[Array | None] | None = None,
) -> list[Read]:
    """Records of one tag of each message."""
    tree = batch.shape.tree
    stamps, frame = _stamps(batch, tree), _frame(tree)
    out: list[Read] = []
    for i, (logged, stamp) in enumerate(zip(logged_ns, stamps, strict=True)):
        T = poses[0][i] if poses is not None else None
        covariance = covariances[i] if covariances is not None else None
        corners_px = corners[i] if corners is not None else None
        fault = poses[1].get(i) if poses is not None else None
        if corners_px is not None and not np.isfinite(corners_px).all():
            fault = f"corners {corners_px.tolist()} are not finite"
        out.append(fault or (DetectionRecord(logged, stamp, topic, frame, family, ids[i], corners_px, T, covariance),))
    return out


def _ids(batch: Batch, tree: Any, *path: str) -> list[str]:
    return [str(number) for number in batch.numbers(tree, *path).tolist()]


def _corners(batch: Batch, tree: Any) -> Array:
    """Four messages with x and y; (N, 4, 2)."""
    corners = _list(tree, "corners")
    if len(corners) != 4:
        raise MessageError(f"{len(corners)} corners in place of 4")
    return np.stack(
        [np.stack([batch.numbers(c, axis).astype(np.float64) for axis in "xy"], axis=1) for c in corners], axis=1
    )


def _apriltag_msgs(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    parts = []
    for tag in _list(batch.shape.tree, "detections"):
        family = find(tag, "family")
        ids = _ids(batch, tag, "id")
        parts.append(_detections(batch, topic, logged_ns, str(family), ids, corners=_corners(batch, tag)))
    return _joined(parts, len(logged_ns))


def _isaac_ros_apriltag(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    parts = []
    for tag in _list(batch.shape.tree, "detections"):
        pose = find(tag, "pose", "pose")
        T, faults = _transforms(batch, find(pose, "pose"), "position", "orientation")
        covariances = _covariances(batch, pose, T)
        family, ids, corners = str(find(tag, "family")), _ids(batch, tag, "id"), _corners(batch, tag)
        parts.append(_detections(batch, topic, logged_ns, family, ids, (T, faults), corners, covariances))
    return _joined(parts, len(logged_ns))


def _aruco_markers(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    ids = batch.numbers(batch.shape.tree, "marker_ids")
    poses = _list(batch.shape.tree, "poses")
    if ids.ndim != 2 or ids.shape[1] != len(poses):
        raise MessageError(f"marker_ids {ids.shape[1:]} for {len(poses)} poses")
    parts = [
        _detections(
            batch, topic, logged_ns, "", [str(n) for n in ids[:, i].tolist()],
            _transforms(batch, pose, "position", "orientation"),
        )
        for i, pose in enumerate(poses)
    ]  # fmt: skip
    return _joined(parts, len(logged_ns))


def _aruco_msgs(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    parts = []
    for marker in _list(batch.shape.tree, "markers"):
        T, faults = _transforms(batch, find(marker, "pose", "pose"), "position", "orientation")
        covariances = _covariances(batch, find(marker, "pose"), T)
        ids = _ids(batch, marker, "id")
        parts.append(_detections(batch, topic, logged_ns, "", ids, (T, faults), covariances=covariances))
    return _joined(parts, len(logged_ns))


def _aruco_opencv(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    parts = []
    for marker in _list(batch.shape.tree, "markers"):
        poses = _transforms(batch, find(marker, "pose"), "position", "orientation")
        parts.append(_detections(batch, topic, logged_ns, "", _ids(batch, marker, "marker_id"), poses))
    for board in _list(batch.shape.tree, "boards"):
        poses = _transforms(batch, find(board, "pose"), "position", "orientation")
        names = [str(find(board, "board_name"))] * len(logged_ns)
        parts.append(_detections(batch, topic, logged_ns, "", names, poses))
    return _joined(parts, len(logged_ns))


SCHEMAS: dict[str, Decode] = {
    "geometry_msgs/PoseStamped": _pose_stamped,
    "geometry_msgs/PoseWithCovarianceStamped": _pose_with_covariance_stamped,
    "geometry_msgs/TransformStamped": _transform_stamped,
    "tf2_msgs/TFMessage": _tf_message,
    "nav_msgs/Odometry": _odometry,
    "sensor_msgs/Image": _image,
    "sensor_msgs/CompressedImage": _compressed_image,
    "sensor_msgs/CameraInfo": _camera_info,
    "apriltag_msgs/AprilTagDetectionArray": _apriltag_msgs,
    "isaac_ros_apriltag_interfaces/AprilTagDetectionArray": _isaac_ros_apriltag,
    "ros2_aruco_interfaces/ArucoMarkers": _aruco_markers,
    "aruco_interfaces/ArucoMarkers": _aruco_markers,
    "aruco_msgs/MarkerArray": _aruco_msgs,
    "aruco_opencv_msgs/ArucoDetection": _aruco_opencv,
}
