"""ROS 2 messages to records, by the name of their schema; `ros2_detections` has those of tags and boards.

Each decoder takes a batch of messages of one shape. It returns, for each message, its records or the fault in words.
A pose message gives one `PoseRecord`, a ``TFMessage`` gives one for each of its transforms, and an array of detections
gives one `DetectionRecord` for each tag. Messages of ROS 1 bags have the same fields after ``convert``, but for the
names of some.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import repeat
from typing import Any, TypeAlias

import numpy as np

from gtsam_rwhec.errors import MessageError
from gtsam_rwhec.logs.cdr import Batch, MessageType, Numbers, find
from gtsam_rwhec.logs.records import (
    Array,
    CloudRecord,
    DetectionRecord,
    ImageRecord,
    IntrinsicsRecord,
    PoseRecord,
    Record,
    cloud_fault,
    gtsam_covariances,
    image_fault,
    transforms,
)


def ros2_decoder(
    schema: str, definition: str, take: Callable[[int], None]
) -> Callable[[str, Sequence[bytes | memoryview], list[int]], list[Read]]:
    """Make the function that reads messages of a schema: (topic, messages, logged_ns) -> records of each.

    `take` is told how many parts of messages were read, and raises an error when they are too many.
    A MessageError says that the definition in the log cannot be read.
    """
    decode = ROS2_SCHEMAS[schema.replace("/msg/", "/")]
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


def _poses(where: Pose, batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    trees = parts_of(batch, where.parts)
    if not trees:
        return [()] * len(logged_ns)
    parts: list[list[PoseRecord]] = []
    T, covariances, faults = poses_of(batch, trees, where)
    for tree, T_of_part, of_part in zip(trees, T, covariances, strict=True):
        parent, child = frame_of(batch, tree), frame_of(batch, tree, where.child) if where.child else ""
        each = zip(logged_ns, stamps_of(batch, tree), T_of_part, of_part, strict=True)
        parts.append([PoseRecord(logged, stamp, topic, parent, child, T_i, S) for logged, stamp, T_i, S in each])
    return by_message(parts, faults, len(logged_ns))


def _bytes(batch: Batch) -> list[bytes]:
    leaf = find(batch.shape.tree, "data")
    if not isinstance(leaf, Numbers) or np.dtype(leaf.dtype).itemsize != 1:
        raise MessageError("field data has no bytes")
    return [row.tobytes() for row in batch.rows[:, leaf.offset : leaf.offset + (leaf.count or 0)]]


def _image(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    tree = batch.shape.tree
    columns = [batch.numbers(tree, name).tolist() for name in ("width", "height", "step", "is_bigendian")]
    frame, encoding = frame_of(batch, tree), batch.text(tree, "encoding")
    return [
        image_fault(width, height, step, data)
        or (ImageRecord(logged, stamp, topic, frame, encoding, data, width, height, step, bool(is_big)),)
        for logged, stamp, data, width, height, step, is_big in zip(
            logged_ns, stamps_of(batch, tree), _bytes(batch), *columns, strict=True
        )
    ]


def _compressed_image(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    tree = batch.shape.tree
    frame, encoding = frame_of(batch, tree), batch.text(tree, "format")
    return [
        (ImageRecord(logged, stamp, topic, frame, encoding, data),)
        for logged, stamp, data in zip(logged_ns, stamps_of(batch, tree), _bytes(batch), strict=True)
    ]


def _camera_info(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    tree = batch.shape.tree
    names = "kdrp" if "k" in tree else "KDRP"  # of ROS 2 and of ROS 1
    K, D, R, P = (batch.numbers(tree, name).astype(np.float64) for name in names)
    if (K.shape[1:], R.shape[1:], P.shape[1:]) != ((9,), (9,), (12,)):
        raise MessageError("k, r and p must have 9, 9 and 12 numbers")
    frame, model = frame_of(batch, tree), batch.text(tree, "distortion_model")
    width, height = (batch.numbers(tree, name).tolist() for name in ("width", "height"))
    matrices = K.reshape(-1, 3, 3), D, R.reshape(-1, 3, 3), P.reshape(-1, 3, 4)
    return [
        (IntrinsicsRecord(logged, stamp, topic, frame, w, h, model, *numbers),)
        for logged, stamp, w, h, *numbers in zip(
            logged_ns, stamps_of(batch, tree), width, height, *matrices, strict=True
        )
    ]


#: NumPy's names for the types of a PointField, without the order of bytes.
POINT_FIELDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def _point_cloud(batch: Batch, topic: str, logged_ns: list[int]) -> list[Read]:
    tree = batch.shape.tree
    columns = [batch.numbers(tree, name).tolist() for name in ("width", "height", "point_step", "row_step")]
    big = batch.numbers(tree, "is_bigendian").tolist()
    parts = [
        (batch.text(part, "name"), *(batch.numbers(part, name).tolist() for name in ("offset", "datatype", "count")))
        for part in parts_of(batch, "fields")
    ]
    found: list[Read] = []
    each = zip(logged_ns, stamps_of(batch, tree), _bytes(batch), *columns, strict=True)
    for i, (logged, stamp, data, width, height, step, row_step) in enumerate(each):
        kinds = [POINT_FIELDS.get(kind[i]) for _, _, kind, _ in parts]
        fields = tuple(  # what has several numbers, or an unknown type, is nothing that a cloud needs
            (name, offset[i], (">" if big[i] else "<") + kind)
            for (name, offset, _, count), kind in zip(parts, kinds, strict=True)
            if kind is not None and count[i] <= 1
        )
        frame = frame_of(batch, tree)
        cloud = CloudRecord(logged, stamp, topic, frame, width, height, step, row_step, fields, data)
        found.append(cloud_fault(cloud) or (cloud,))
    return found


#: A read message gives its records, or its fault in words.
Read: TypeAlias = Sequence[Record] | str
Decode: TypeAlias = Callable[[Batch, str, list[int]], list[Read]]


@dataclass(frozen=True)
class Pose:
    """Paths of a pose's fields; an empty path means no field. `parts` is the list whose entries have one pose each."""

    pose: str
    covariance: str = ""
    child: str = ""
    parts: str = ""


def stamps_of(batch: Batch, tree: Any) -> list[int]:
    """The stamp of each message's header, nanoseconds."""
    seconds = batch.numbers(tree, "header.stamp.sec").astype(np.int64)
    nanoseconds = batch.numbers(tree, "header.stamp.nanosec").astype(np.int64)
    stamps: list[int] = (seconds * 1_000_000_000 + nanoseconds).tolist()
    return stamps


def frame_of(batch: Batch, tree: Any, path: str = "header.frame_id") -> str:
    """A frame's name. Drivers from before tf2 begin it with a slash, which tf2 does not have."""
    return batch.text(tree, path).removeprefix("/")


def parts_of(batch: Batch, name: str) -> list[Any]:
    """The messages in the list `name` of a message. Without a name, the result is the message itself."""
    value = find(batch.shape.tree, name) if name else [batch.shape.tree]
    if not isinstance(value, list):
        raise MessageError(f"field {name} is not a list of messages")
    return value


def _columns_of_a_pose(batch: Batch, tree: Any, where: Pose) -> list[Numbers]:
    """Where a pose's x, y, z and x, y, z, w stand."""
    pose = find(tree, where.pose)
    position, rotation = ("translation", "rotation") if where.pose == "transform" else ("position", "orientation")
    leaves = [find(find(pose, position), name) for name in "xyz"]
    leaves += [find(find(pose, rotation), name) for name in "xyzw"]
    for leaf in leaves:
        if not isinstance(leaf, Numbers) or leaf.count is not None:
            raise MessageError(f"field {where.pose} has no {position} and {rotation}")
    return leaves


def poses_of(batch: Batch, trees: list[Any], where: Pose) -> tuple[Array, list[Sequence[Array | None]], dict[int, str]]:
    """Transforms (P, N, 4, 4) and covariances of P poses of each of N messages, and the faults of messages."""
    count = len(batch.rows)
    table = np.empty((len(trees), count, 7))
    # A message of its own shape has all its poses read together; of many messages, one pose of all is.
    if count < len(trees):
        offsets = np.array([[leaf.offset for leaf in _columns_of_a_pose(batch, tree, where)] for tree in trees])
        dtype = {leaf.dtype for leaf in _columns_of_a_pose(batch, trees[0], where)}.pop()
        size = np.dtype(dtype).itemsize
        places = offsets[:, :, None] + np.arange(size)
        table[:] = batch.rows[:, places].view(dtype)[..., 0].transpose(1, 0, 2)
    else:
        for i, tree in enumerate(trees):
            for j, leaf in enumerate(_columns_of_a_pose(batch, tree, where)):
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


def columns_of(batch: Batch, tree: Any, names: Sequence[str]) -> Array:
    """Numbers with these names as (N, len(names))."""
    return np.stack([batch.numbers(tree, name).astype(np.float64) for name in names], axis=1)


def by_message(parts: Sequence[Sequence[Record]], faults: dict[int, str], count: int) -> list[Read]:
    """The records of each message, joined from its parts. If one part has a fault, the whole message has it."""
    of_messages: list[Read] = list(zip(*parts, strict=True)) if parts else [()] * count
    for i, fault in faults.items():
        of_messages[i] = fault
    return of_messages


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
DETECTIONS: dict[str, Decode] = {
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
ROS2_SCHEMAS: dict[str, Decode] = {
    "geometry_msgs/PoseStamped": partial(_poses, Pose("pose")),
    "geometry_msgs/PoseWithCovarianceStamped": partial(_poses, Pose("pose.pose", "pose.covariance")),
    "geometry_msgs/TransformStamped": partial(_poses, Pose("transform", child="child_frame_id")),
    "tf2_msgs/TFMessage": partial(_poses, Pose("transform", child="child_frame_id", parts="transforms")),
    "nav_msgs/Odometry": partial(_poses, Pose("pose.pose", "pose.covariance", "child_frame_id")),
    "sensor_msgs/Image": _image,
    "sensor_msgs/CompressedImage": _compressed_image,
    "sensor_msgs/CameraInfo": _camera_info,
    "sensor_msgs/PointCloud2": _point_cloud,
    **DETECTIONS,
}
