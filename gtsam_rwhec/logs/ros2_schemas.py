"""ROS 2 messages to records, by the name of their schema.

Each decoder takes a batch of messages of one shape. It returns, for each message, its records or the fault in words.
A pose message gives one `PoseRecord`, a ``TFMessage`` gives one for each of its transforms, and an array of detections
gives one `DetectionRecord` for each tag.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import repeat
from typing import Any

import numpy as np

from gtsam_rwhec.errors import MessageError
from gtsam_rwhec.logs.cdr import Batch, MessageType, Numbers, find
from gtsam_rwhec.logs.checked_poses import gtsam_covariances, image_fault, transforms
from gtsam_rwhec.logs.records import Array, DetectionRecord, ImageRecord, IntrinsicsRecord, PoseRecord, Record

#: A read message gives its records, or its fault in words.
Read = Sequence[Record] | str
Decode = Callable[[Batch, str, list[int]], list[Read]]


@dataclass(frozen=True)
class Pose:
    """Paths of a pose's fields; an empty path means no field. `parts` is the list whose entries have one pose each."""

    pose: str
    covariance: str = ""
    child: str = ""
    parts: str = ""


@dataclass(frozen=True)
class Tag:
    """Paths of a tag's fields in each entry of the list `parts`; its id is a number or a board's name."""

    parts: str
    id: str
    family: str = ""
    pose: Pose | None = None
    has_corners: bool = False


def decoder(
    schema: str, definition: str, take: Callable[[int], None]
) -> Callable[[str, Sequence[bytes | memoryview], list[int]], list[Read]]:
    """Make the function that reads messages of a schema: (topic, messages, logged_ns) -> records of each.

    `take` is told how many parts of messages were read, and raises an error when they are too many.
    A MessageError says that the definition in the log cannot be read.
    """
    decode = SCHEMAS[schema.replace("/msg/", "/")]
    message_type = MessageType(schema, definition, take)

    def read(topic: str, messages: Sequence[bytes | memoryview], logged_ns: list[int]) -> list[Read]:
        out: list[Read] = [()] * len(messages)
        for places, batch in message_type.batches(messages):
            try:
                if isinstance(batch, MessageError):
                    raise batch
                results = decode(batch, topic, [logged_ns[i] for i in places])
            except MessageError as error:
                results = [str(error)] * len(places)
            for i, result in zip(places, results, strict=True):
                out[i] = result
        return out

    return read


def _stamps(batch: Batch, tree: Any) -> list[int]:
    seconds = batch.numbers(tree, "header.stamp.sec").astype(np.int64)
    nanoseconds = batch.numbers(tree, "header.stamp.nanosec").astype(np.int64)
    stamps: list[int] = (seconds * 1_000_000_000 + nanoseconds).tolist()
    return stamps


def _frame(batch: Batch, tree: Any, path: str = "header.frame_id") -> str:
    """A frame's name. Drivers from before tf2 begin it with a slash, which tf2 does not have."""
    return batch.text(tree, path).removeprefix("/")


def _parts(batch: Batch, name: str) -> list[Any]:
    """The messages in the list `name` of a message. Without a name, the result is the message itself."""
    value = find(batch.shape.tree, name) if name else [batch.shape.tree]
    if not isinstance(value, list):
        raise MessageError(f"field {name} is not a list of messages")
    return value


def _pose_columns(batch: Batch, tree: Any, where: Pose) -> list[Numbers]:
    """Where a pose's x, y, z and x, y, z, w stand."""
    pose = find(tree, where.pose)
    position, rotation = ("translation", "rotation") if where.pose == "transform" else ("position", "orientation")
    leaves = [find(find(pose, position), name) for name in "xyz"]
    leaves += [find(find(pose, rotation), name) for name in "xyzw"]
    for leaf in leaves:
        if not isinstance(leaf, Numbers) or leaf.count is not None:
            raise MessageError(f"field {where.pose} has no {position} and {rotation}")
    return leaves


def _pose(batch: Batch, trees: list[Any], where: Pose) -> tuple[Array, list[Sequence[Array | None]], dict[int, str]]:
    """Transforms (P, N, 4, 4) and covariances of P poses of each of N messages, and the faults of messages."""
    count = len(batch.rows)
    table = np.empty((len(trees), count, 7))
    # A message of its own shape has all its poses read together; of many messages, one pose of all is.
    if count < len(trees):
        offsets = np.array([[leaf.offset for leaf in _pose_columns(batch, tree, where)] for tree in trees])
        dtype = {leaf.dtype for leaf in _pose_columns(batch, trees[0], where)}.pop()
        size = np.dtype(dtype).itemsize
        places = offsets[:, :, None] + np.arange(size)
        table[:] = batch.rows[:, places].view(dtype)[..., 0].transpose(1, 0, 2)
    else:
        for i, tree in enumerate(trees):
            for j, leaf in enumerate(_pose_columns(batch, tree, where)):
                table[i, :, j] = batch.column(leaf)
    rows = table.reshape(-1, 7)
    T, wrong = transforms(rows[:, :3], rows[:, 3:])
    faults: dict[int, str] = {}
    for i, fault in wrong.items():
        faults.setdefault(i % count, fault)
    T = T.reshape(len(trees), count, 4, 4)
    covariances: list[Sequence[Array | None]] = [[None] * count for _ in trees]
    if where.covariance:
        for i, tree in enumerate(trees):
            numbers = batch.numbers(tree, where.covariance).astype(np.float64)
            if numbers.shape[1:] != (36,):
                raise MessageError(f"field covariance has {numbers.shape[1:]} numbers in place of 36")
            covariances[i] = gtsam_covariances(T[i], numbers.reshape(-1, 6, 6))
    return T, covariances, faults


def _columns(batch: Batch, tree: Any, names: str) -> Array:
    return np.stack([batch.numbers(tree, name).astype(np.float64) for name in names], axis=1)


def _by_message(parts: Sequence[Sequence[Record]], faults: dict[int, str], count: int) -> list[Read]:
    """The records of each message, joined from its parts. If one part has a fault, the whole message has it."""
    of_messages: list[Read] = list(zip(*parts, strict=True)) if parts else [()] * count
    for i, fault in faults.items():
        of_messages[i] = fault
    return of_messages


def _poses(where: Pose, batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    trees = _parts(batch, where.parts)
    if not trees:
        return [()] * len(logged_ns)
    parts: list[list[PoseRecord]] = []
    T, covariances, faults = _pose(batch, trees, where)
    for tree, T_of_part, of_part in zip(trees, T, covariances, strict=True):
        parent, child = _frame(batch, tree), _frame(batch, tree, where.child) if where.child else ""
        each = zip(logged_ns, _stamps(batch, tree), T_of_part, of_part, strict=True)
        parts.append([PoseRecord(logged, stamp, topic, parent, child, T_i, S) for logged, stamp, T_i, S in each])
    return _by_message(parts, faults, len(logged_ns))


def _detections(tags: Sequence[Tag], batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    stamps, frame = _stamps(batch, batch.shape.tree), _frame(batch, batch.shape.tree)
    parts: list[list[DetectionRecord]] = []
    faults: dict[int, str] = {}
    for tag in tags:
        for tree in _parts(batch, tag.parts):
            family = batch.text(tree, tag.family) if tag.family else ""
            name = find(tree, tag.id)
            ids = repeat(name) if isinstance(name, str) else map(str, batch.numbers(tree, tag.id).tolist())
            poses: Any = repeat((None, None))
            corners: Any = repeat(None)
            if tag.has_corners:
                corners = _corners(batch, tree)
                for i in np.flatnonzero(~np.isfinite(corners).all(axis=(1, 2))).tolist():
                    faults.setdefault(i, f"corners {corners[i].tolist()} are not finite")
            if tag.pose is not None:
                T, covariances, wrong = _pose(batch, [tree], tag.pose)
                poses = zip(T[0], covariances[0], strict=True)
                faults = wrong | faults
            each = zip(logged_ns, stamps, ids, corners, poses, strict=False)
            parts.append(
                [
                    DetectionRecord(logged, stamp, topic, frame, family, id_, corners_px, *pose)
                    for logged, stamp, id_, corners_px, pose in each
                ]
            )
    return _by_message(parts, faults, len(logged_ns))


def _corners(batch: Batch, tree: Any) -> Array:
    """Four messages with x and y as (N, 4, 2)."""
    corners = find(tree, "corners")
    if not isinstance(corners, list) or len(corners) != 4:
        raise MessageError("field corners is not a list of 4 points")
    return np.stack([_columns(batch, corner, "xy") for corner in corners], axis=1)


def _aruco_markers(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    """Make one list of markers, as other drivers have it, from the two lists of ids and poses."""
    tree = batch.shape.tree
    ids, poses = find(tree, "marker_ids"), _parts(batch, "poses")
    if not isinstance(ids, Numbers) or ids.count != len(poses):
        raise MessageError(f"marker_ids does not have one number for each of {len(poses)} poses")
    size = np.dtype(ids.dtype).itemsize
    tree["markers"] = [
        {"id": Numbers(ids.offset + i * size, ids.dtype, None), "pose": pose} for i, pose in enumerate(poses)
    ]
    return _detections([Tag("markers", "id", pose=Pose("pose"))], batch, topic, logged_ns)


def _bytes(batch: Batch) -> list[bytes]:
    leaf = find(batch.shape.tree, "data")
    if not isinstance(leaf, Numbers) or np.dtype(leaf.dtype).itemsize != 1:
        raise MessageError("field data has no bytes")
    return [row.tobytes() for row in batch.rows[:, leaf.offset : leaf.offset + (leaf.count or 0)]]


def _image(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    tree = batch.shape.tree
    columns = [batch.numbers(tree, name).tolist() for name in ("width", "height", "step", "is_bigendian")]
    frame, encoding = _frame(batch, tree), batch.text(tree, "encoding")
    return [
        image_fault(width, height, step, data)
        or (ImageRecord(logged, stamp, topic, frame, encoding, data, width, height, step, bool(is_big)),)
        for logged, stamp, data, width, height, step, is_big in zip(
            logged_ns, _stamps(batch, tree), _bytes(batch), *columns, strict=True
        )
    ]


def _compressed_image(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    tree = batch.shape.tree
    frame, encoding = _frame(batch, tree), batch.text(tree, "format")
    return [
        (ImageRecord(logged, stamp, topic, frame, encoding, data),) if data else "image without data"
        for logged, stamp, data in zip(logged_ns, _stamps(batch, tree), _bytes(batch), strict=True)
    ]


def _camera_info(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    tree = batch.shape.tree
    K, D, R, P = (batch.numbers(tree, name).astype(np.float64) for name in "kdrp")
    if (K.shape[1:], R.shape[1:], P.shape[1:]) != ((9,), (9,), (12,)):
        raise MessageError("k, r and p must have 9, 9 and 12 numbers")
    frame, model = _frame(batch, tree), batch.text(tree, "distortion_model")
    width, height = (batch.numbers(tree, name).tolist() for name in ("width", "height"))
    matrices = K.reshape(-1, 3, 3), D, R.reshape(-1, 3, 3), P.reshape(-1, 3, 4)
    return [
        (IntrinsicsRecord(logged, stamp, topic, frame, w, h, model, *numbers),)
        for logged, stamp, w, h, *numbers in zip(logged_ns, _stamps(batch, tree), width, height, *matrices, strict=True)
    ]


SCHEMAS: dict[str, Decode] = {
    "geometry_msgs/PoseStamped": partial(_poses, Pose("pose")),
    "geometry_msgs/PoseWithCovarianceStamped": partial(_poses, Pose("pose.pose", "pose.covariance")),
    "geometry_msgs/TransformStamped": partial(_poses, Pose("transform", child="child_frame_id")),
    "tf2_msgs/TFMessage": partial(_poses, Pose("transform", child="child_frame_id", parts="transforms")),
    "nav_msgs/Odometry": partial(_poses, Pose("pose.pose", "pose.covariance", "child_frame_id")),
    "sensor_msgs/Image": _image,
    "sensor_msgs/CompressedImage": _compressed_image,
    "sensor_msgs/CameraInfo": _camera_info,
    "apriltag_msgs/AprilTagDetectionArray": partial(_detections, [Tag("detections", "id", "family", has_corners=True)]),
    "isaac_ros_apriltag_interfaces/AprilTagDetectionArray": partial(
        _detections,
        [Tag("detections", "id", "family", Pose("pose.pose.pose", "pose.pose.covariance"), has_corners=True)],
    ),
    "ros2_aruco_interfaces/ArucoMarkers": _aruco_markers,
    "aruco_interfaces/ArucoMarkers": _aruco_markers,
    "aruco_msgs/MarkerArray": partial(_detections, [Tag("markers", "id", pose=Pose("pose.pose", "pose.covariance"))]),
    "aruco_opencv_msgs/ArucoDetection": partial(
        _detections, [Tag("markers", "marker_id", pose=Pose("pose")), Tag("boards", "board_name", pose=Pose("pose"))]
    ),
}
