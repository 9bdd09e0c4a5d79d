"""ROS 2 messages to records, by the name of their schema; `ros2_detections` has those of tags and boards.

Each decoder takes a batch of messages of one shape. It returns, for each message, its records or the fault in words.
A pose message gives one `PoseRecord`, a ``TFMessage`` gives one for each of its transforms, and an array of detections
gives one `DetectionRecord` for each tag. Messages of ROS 1 bags have the same fields after ``convert``, but for the
names of some.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from gtsam_rwhec.errors import MessageError
from gtsam_rwhec.logs import ros2_detections
from gtsam_rwhec.logs.cdr import Batch, MessageType, Numbers, find
from gtsam_rwhec.logs.checked_poses import image_fault
from gtsam_rwhec.logs.records import ImageRecord, IntrinsicsRecord, PoseRecord
from gtsam_rwhec.logs.ros2_fields import Decode, Pose, Read, by_message, frame_of, parts_of, poses_of, stamps_of


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


SCHEMAS: dict[str, Decode] = {
    "geometry_msgs/PoseStamped": partial(_poses, Pose("pose")),
    "geometry_msgs/PoseWithCovarianceStamped": partial(_poses, Pose("pose.pose", "pose.covariance")),
    "geometry_msgs/TransformStamped": partial(_poses, Pose("transform", child="child_frame_id")),
    "tf2_msgs/TFMessage": partial(_poses, Pose("transform", child="child_frame_id", parts="transforms")),
    "nav_msgs/Odometry": partial(_poses, Pose("pose.pose", "pose.covariance", "child_frame_id")),
    "sensor_msgs/Image": _image,
    "sensor_msgs/CompressedImage": _compressed_image,
    "sensor_msgs/CameraInfo": _camera_info,
    **ros2_detections.SCHEMAS,
}
