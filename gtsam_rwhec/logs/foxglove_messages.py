"""Foxglove's well-known schemas to records, from JSON and from protobuf; this library's own schemas from JSON.

The same code reads a JSON object and a protobuf message: a field is ``get(message, name)``, where `get` is
``operator.getitem`` or ``getattr``. The encodings differ in times (``sec``, ``nsec`` in JSON; ``seconds``, ``nanos`` in
protobuf) and in bytes (base64 in JSON).
"""

from __future__ import annotations

import base64
import json
import operator
import reprlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import DescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap_protobuf.decoder import DecoderFactory

from gtsam_rwhec.errors import BudgetError, MessageError
from gtsam_rwhec.files.budgets import (
    JSON_OF_A_PART,
    MESSAGE,
    MESSAGE_TYPES,
    MIB,
    PARTS_OF_A_MESSAGE,
    PARTS_OF_A_POSE,
    SCHEMA,
    Spending,
)
from gtsam_rwhec.logs.records import (
    LARGEST_M,
    MEASURED_PAIR,
    TAG_DETECTIONS,
    Array,
    CloudRecord,
    DetectionRecord,
    ImageRecord,
    IntrinsicsRecord,
    PairRecord,
    PoseRecord,
    Record,
    cloud_fault,
    image_fault,
    transforms,
)
from gtsam_rwhec.logs.ros2_messages import ROS2_SCHEMAS, ros2_decoder

#: A read message gives its records, or its fault in words.
Read = Sequence[Record] | str
#: A row holds one pose of a message: stamp, parent, child, then x, y, z and x, y, z, w.
Row = tuple[int, str, str, tuple[float, ...]]
#: A message's list has at most this many numbers, enough for the corners of a board of 100 x 100 squares.
MOST_NUMBERS = 20_000
#: A message has at most this many poses or tags.
MOST_POSES = 10_000
#: A damaged message can raise these errors when it is converted to numbers.
_FAULTS = (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError, IndexError)


@dataclass(frozen=True)
class Access:
    """How the fields, times and bytes of one encoding are reached."""

    get: Callable[[Any, str], Any]
    seconds: str
    nanoseconds: str
    as_bytes: Callable[[Any], bytes]

    def stamp(self, message: Any) -> int:
        """The ``timestamp`` of a message in nanoseconds."""
        time = self.get(message, "timestamp")
        seconds, nanoseconds = self.get(time, self.seconds), self.get(time, self.nanoseconds)
        if type(seconds) is int and type(nanoseconds) is int:
            stamp = seconds * 1_000_000_000 + nanoseconds
            if abs(stamp) < 1 << 63:
                return stamp
        raise ValueError(f"timestamp {str(seconds)[:40]}, {str(nanoseconds)[:40]} is not seconds and nanoseconds")

    def pose(self, message: Any, position: str = "position", rotation: str = "orientation") -> tuple[float, ...]:
        """x, y, z and x, y, z, w."""
        get, t, q = self.get, self.get(message, position), self.get(message, rotation)
        return (
            float(get(t, "x")), float(get(t, "y")), float(get(t, "z")),
            float(get(q, "x")), float(get(q, "y")), float(get(q, "z")), float(get(q, "w")),
        )  # fmt: skip

    def text(self, message: Any, name: str) -> str:
        """A string."""
        value = self.get(message, name)
        if not isinstance(value, str):
            raise TypeError(f"{name} is {reprlib.repr(value)} in place of a string")
        return value

    def frame(self, message: Any, name: str = "frame_id") -> str:
        """A frame's name."""
        return self.text(message, name).removeprefix("/")

    def whole(self, message: Any, name: str) -> int:
        """An unsigned 32-bit number."""
        value = self.get(message, name)
        if type(value) is not int or not 0 <= value < 1 << 32:
            raise ValueError(f"{name} is {reprlib.repr(value)}")
        return value

    def listed(self, message: Any, name: str) -> Any:
        """A list of poses or tags."""
        value = self.get(message, name)
        if len(value) > MOST_POSES:
            raise ValueError(f"{name} has {len(value)} entries, and at most {MOST_POSES} are read")
        return value

    def vector(self, message: Any, name: str, most: int = 1000) -> Array:
        """A list of numbers, (n,)."""
        values = self.get(message, name)
        if len(values) > most:
            raise ValueError(f"{name} has {len(values)} numbers, and at most {most} are read")
        return np.array([float(value) for value in values], dtype=np.float64)


JSON = Access(operator.getitem, "sec", "nsec", lambda text: base64.b64decode(text, validate=True))
PROTOBUF = Access(getattr, "seconds", "nanos", bytes)


def foxglove_decoder(
    schema: str, parse: Callable[[bytes | memoryview], Any], access: Access, take: Callable[[int], None]
) -> Callable[[str, Sequence[bytes | memoryview], list[int]], list[Read]]:
    """Make the function that reads messages of a schema in `SCHEMAS`: (topic, messages, logged_ns) -> records of each.

    `parse` makes a JSON object or a protobuf message of bytes, or raises `MessageError`. `take` is told how many parts
    of messages were read, and raises an error when they are too many.
    """
    rows_of = _POSES.get(schema)

    def read(topic: str, messages: Sequence[bytes | memoryview], logged_ns: list[int]) -> list[Read]:
        out: list[Any] = []
        rows: list[Row] = []
        for message, logged in zip(messages, logged_ns, strict=True):
            try:
                if rows_of is None:
                    out.append(_OTHERS[schema](parse(message), access, topic, logged))
                else:
                    first = len(rows)
                    rows += rows_of(parse(message), access)
                    take(PARTS_OF_A_POSE * (len(rows) - first))
                    out.append(range(first, len(rows)))
            except BudgetError:
                raise
            except MessageError as error:
                out.append(str(error))
            except (KeyError, AttributeError) as error:
                out.append(f"lacks a field: {error}")
            except _FAULTS as error:
                out.append(f"cannot be read as its schema: {error}")
        return out if rows_of is None else _with_poses(out, rows, topic, logged_ns)

    return read


def _with_poses(out: list[Any], rows: list[Row], topic: str, logged_ns: list[int]) -> list[Read]:
    """Put records in place of the ranges of rows; the transforms of all rows are made together."""
    numbers = np.array([row[3] for row in rows], dtype=np.float64).reshape(-1, 7)
    T, faults = transforms(numbers[:, :3], numbers[:, 3:])
    for i, (found, logged) in enumerate(zip(out, logged_ns, strict=True)):
        if not isinstance(found, str):
            fault = next((faults[j] for j in found if j in faults), None) if faults else None
            out[i] = fault or [PoseRecord(logged, rows[j][0], topic, rows[j][1], rows[j][2], T[j]) for j in found]
    return out


def parse_json(message: bytes | memoryview, take: Callable[[int], None]) -> Any:
    """The JSON object of a message. Anything else raises a MessageError, and so does one of too many parts.

    Parts are counted before they are made: a number, list or string of two characters becomes an object of up to a
    hundred bytes.
    """
    try:
        text = str(message, "utf-8")
    except UnicodeDecodeError as error:
        raise MessageError(f"not JSON: {error}") from error
    parts = 1 + sum(map(text.count, ",[{"))
    take(parts // JSON_OF_A_PART)
    if parts > PARTS_OF_A_MESSAGE:
        raise MessageError(
            f"JSON of {parts} numbers, strings, lists and objects; at most {PARTS_OF_A_MESSAGE} are read"
        )
    # With a character beyond Latin-1, all take two or four bytes in memory.
    if sys.getsizeof(text) > 2 * max(MESSAGE, len(message)):
        raise MessageError(f"JSON of {len(message)} bytes that needs {sys.getsizeof(text)} in memory")
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise MessageError(f"not JSON: {error}") from error
    if not isinstance(value, dict):
        raise MessageError(f"JSON, but a {type(value).__name__} in place of an object")
    return value


def _frame_transform(message: Any, access: Access) -> list[Row]:
    numbers = access.pose(message, "translation", "rotation")
    parent, child = access.frame(message, "parent_frame_id"), access.frame(message, "child_frame_id")
    return [(access.stamp(message), parent, child, numbers)]


def _frame_transforms(message: Any, access: Access) -> list[Row]:
    return [row for part in access.listed(message, "transforms") for row in _frame_transform(part, access)]


def _pose_in_frame(message: Any, access: Access) -> list[Row]:
    return [(access.stamp(message), access.frame(message), "", access.pose(access.get(message, "pose")))]


def _poses_in_frame(message: Any, access: Access) -> list[Row]:
    stamp, frame = access.stamp(message), access.frame(message)
    return [(stamp, frame, "", access.pose(pose)) for pose in access.listed(message, "poses")]


def _compressed_image(message: Any, access: Access, topic: str, logged: int) -> Read:
    data = access.as_bytes(access.get(message, "data"))  # none at all is the fault of this image, as other bytes are
    frame, encoding = access.frame(message), access.text(message, "format")
    return (ImageRecord(logged, access.stamp(message), topic, frame, encoding, data),)


def _raw_image(message: Any, access: Access, topic: str, logged: int) -> Read:
    data = access.as_bytes(access.get(message, "data"))
    width, height, step = (access.whole(message, name) for name in ("width", "height", "step"))
    frame, encoding = access.frame(message), access.text(message, "encoding")
    record = ImageRecord(logged, access.stamp(message), topic, frame, encoding, data, width, height, step)
    return image_fault(width, height, step, data) or (record,)


def _camera_calibration(message: Any, access: Access, topic: str, logged: int) -> Read:
    K, D, R, P = (access.vector(message, name) for name in "KDRP")
    if len(R) == 0:
        R = np.eye(3).ravel()  # R and P are for rectified images, and optional
    if len(P) == 0:
        P = np.c_[K.reshape(-1, 3), np.zeros(len(K) // 3)].ravel()
    if (len(K), len(R), len(P)) != (9, 9, 12):
        return f"K, R and P have {len(K)}, {len(R)} and {len(P)} numbers in place of 9, 9 and 12"
    width, height = access.whole(message, "width"), access.whole(message, "height")
    frame, model = access.frame(message), access.text(message, "distortion_model")
    K, R, P = K.reshape(3, 3), R.reshape(3, 3), P.reshape(3, 4)
    return (IntrinsicsRecord(logged, access.stamp(message), topic, frame, width, height, model, K, D, R, P),)


#: NumPy's names for Foxglove's types of numbers.
NUMERIC = {1: "<u1", 2: "<i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}


def _point_cloud(message: Any, access: Access, topic: str, logged: int) -> Read:
    data = access.as_bytes(access.get(message, "data"))
    step = access.whole(message, "point_stride")
    pose = np.array([access.pose(access.get(message, "pose"))])
    # Protobuf leaves a pose that is not given at zero.
    T, faults = transforms(pose[:, :3], pose[:, 3:]) if pose.any() else (np.eye(4)[None], {})
    fields = tuple(
        (access.text(part, "name"), access.whole(part, "offset"), NUMERIC[access.get(part, "type")])
        for part in access.listed(message, "fields")
        if access.get(part, "type") in NUMERIC
    )
    width = len(data) // step if step else 0
    frame, stamp = access.frame(message), access.stamp(message)
    of_frame = None if np.array_equal(T[0], np.eye(4)) else T[0]
    cloud = CloudRecord(logged, stamp, topic, frame, width, 1, step, width * step, fields, data, of_frame)
    return faults.get(0) or cloud_fault(cloud) or (cloud,)


def _tag_detections(message: Any, access: Access, topic: str, logged: int) -> Read:
    """This library's ``gtsam_rwhec.TagDetections`` (see `written_schemas`)."""
    stamp, frame = access.stamp(message), access.frame(message)
    records = []
    tags = access.listed(message, "detections")
    posed = [i for i, tag in enumerate(tags) if tag.get("pose") is not None]
    numbers = np.array([access.pose(tags[i]["pose"]) for i in posed], dtype=np.float64).reshape(-1, 7)
    transforms_of, faults = transforms(numbers[:, :3], numbers[:, 3:])
    if faults:
        return next(iter(faults.values()))
    T_of = dict(zip(posed, transforms_of, strict=True))
    for i, tag in enumerate(tags):
        given = {name: value for name, value in tag.items() if value is not None}
        arrays = {name: float(given[name]) for name in ("size_m", "reprojection_px") if name in given}
        corners = covariance = None
        if "covariance" in given:
            covariance = access.vector(tag, "covariance").reshape(6, 6)
        if "corners_px" in given:
            both = {"corners_px": [corner[axis] for corner in tag["corners_px"] for axis in "xy"]}
            corners = access.vector(both, "corners_px", MOST_NUMBERS).reshape(-1, 2)
        for field, value in {"covariance": covariance, "corners_px": corners, **arrays}.items():
            if value is not None and not np.isfinite(value).all():
                return f"{field} is not finite: {reprlib.repr(np.asarray(value).tolist())}"
        indices = tuple(int(index) for index in given["corner_indices"]) if "corner_indices" in given else None
        if indices is not None and (corners is None or len(indices) != len(corners)):
            return f"{len(indices)} corner_indices for {0 if corners is None else len(corners)} corners"
        records.append(
            DetectionRecord(
                logged, stamp, topic, frame, access.text(tag, "family"), access.text(tag, "id"), corners, T_of.get(i),
                covariance, reason=access.text(tag, "reason") if "reason" in tag else "", corner_indices=indices,
                **arrays,
            )
        )  # fmt: skip
    return records


def _measured_pair(message: Any, access: Access, topic: str, logged: int) -> Read:
    """This library's ``gtsam_rwhec.MeasuredPair`` (see `written_schemas`)."""
    A, B = (access.vector(message, name).reshape(4, 4) for name in "AB")
    for name, T in (("A", A), ("B", B)):
        R = T[:3, :3]
        is_small = np.isfinite(T).all() and np.abs(R).max() < 2.0  # larger entries could not be squared
        is_rotation = is_small and np.abs(R.T @ R - np.eye(3)).max() < 1e-3 and np.linalg.det(R) > 0.0
        if not (is_rotation and np.abs(T[:3, 3]).max() <= LARGEST_M and T[3].tolist() == [0, 0, 0, 1]):
            return f"{name} is not a transform: {T.tolist()}"
    target, sensor, reason = (access.text(message, name) for name in ("target", "sensor", "reason"))
    is_given = message.get("covariance") is not None
    covariance = access.vector(message, "covariance").reshape(6, 6) if is_given else None
    if covariance is not None and not np.isfinite(covariance).all():
        return f"covariance is not finite: {covariance.tolist()}"
    stamp, is_inlier = access.stamp(message), bool(message["is_inlier"])
    return (PairRecord(logged, stamp, topic, target, sensor, A, B, is_inlier, reason, covariance),)


_POSES: dict[str, Callable[[Any, Access], list[Row]]] = {
    "foxglove.FrameTransform": _frame_transform,
    "foxglove.FrameTransforms": _frame_transforms,
    "foxglove.PoseInFrame": _pose_in_frame,
    "foxglove.PosesInFrame": _poses_in_frame,
}
_OTHERS: dict[str, Callable[[Any, Access, str, int], Read]] = {
    "foxglove.CompressedImage": _compressed_image,
    "foxglove.RawImage": _raw_image,
    "foxglove.CameraCalibration": _camera_calibration,
    "foxglove.PointCloud": _point_cloud,
    TAG_DETECTIONS: _tag_detections,
    MEASURED_PAIR: _measured_pair,
}
FOXGLOVE_SCHEMAS = frozenset(_POSES) | frozenset(_OTHERS)


Decoder = Callable[[str, Sequence[bytes | memoryview], list[int]], list[Read]]
#: A descriptor pool raises these errors for wrong descriptors in a file.
_DESCRIPTOR_FAULTS = (McapError, DecodeError, TypeError, ValueError, KeyError, RecursionError)
#: Bytes. A protobuf message with lists in it has at most this much: two bytes of it become an object of a hundred.
LISTED_BYTES = MIB


def _protobuf_parser(schema: Schema) -> Callable[[bytes | memoryview], Any]:
    """Make the function from bytes to messages of `schema`. Raise a MessageError if descriptors lack it or are wrong.

    The function raises a MessageError for bytes that are not a message.
    """
    try:
        types = sum(
            _count(type_) for file in FileDescriptorSet.FromString(schema.data).file for type_ in file.message_type
        )
        if types > MESSAGE_TYPES:
            raise ValueError(f"they define {types} types of messages, and at most {MESSAGE_TYPES} are read")
        decode = DecoderFactory().decoder_for("protobuf", schema)
    except _DESCRIPTOR_FAULTS as error:
        raise MessageError(f"schema {schema.name}: its protobuf descriptors cannot be used: {error}") from error
    if decode is None:
        raise MessageError(f"schema {schema.name} is in {schema.encoding!r} in place of protobuf")
    descriptor = decode(b"").DESCRIPTOR
    has_lists = _has_lists(descriptor, set())
    of_bytes = {
        field.number: field.name
        for field in descriptor.fields
        if field.type == field.TYPE_BYTES and not _is_list(field)
    }

    def parse(message: bytes | memoryview) -> Any:
        apart: dict[str, bytes] = {}
        if has_lists and len(message) > LISTED_BYTES:
            message, apart = _bytes_apart(bytes(message), of_bytes)
            if len(message) > LISTED_BYTES:
                raise MessageError(f"{len(message)} bytes with lists in them, beyond the limit of {LISTED_BYTES}")
        try:
            found = decode(bytes(message))
        except DecodeError as error:
            raise MessageError(f"not a protobuf message: {error}") from error
        for name, data in apart.items():
            setattr(found, name, data)
        return found

    return parse


def _bytes_apart(message: bytes, of_bytes: dict[int, str]) -> tuple[bytes, dict[str, bytes]]:
    """A protobuf message without its outermost fields of bytes, by whose names they are returned: they are no lists."""
    rest, apart, at = bytearray(), dict[str, bytes](), 0
    try:
        while at < len(message):
            start = at
            tag, at = _varint(message, at)
            kind = tag & 7
            if kind == 0:
                _, at = _varint(message, at)
            elif kind == 2:
                length, at = _varint(message, at)
                at += length
            elif kind in (1, 5):
                at += 8 if kind == 1 else 4
            else:
                break
            if kind == 2 and tag >> 3 in of_bytes and at <= len(message):
                apart[of_bytes[tag >> 3]] = message[at - length : at]
            else:
                rest += message[start:at]
            if len(rest) > LISTED_BYTES:
                break
    except IndexError:
        pass  # it ends within a number: the decoder says so
    return bytes(rest) + message[at : at + LISTED_BYTES + 1], apart


def _varint(message: bytes, at: int) -> tuple[int, int]:
    """A number of protobuf, and the place behind it."""
    value = shift = 0
    while True:
        byte = message[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80 or shift > 63:
            return value, at


def _count(type_: DescriptorProto) -> int:
    """A type and all that are nested in it."""
    return 1 + sum(map(_count, type_.nested_type))


def _has_lists(descriptor: Descriptor, known: set[str]) -> bool:
    """Whether a message, or one inside it, has a list."""
    known.add(descriptor.full_name)
    for field in descriptor.fields:
        inner = field.message_type
        if _is_list(field) or (inner and inner.full_name not in known and _has_lists(inner, known)):
            return True
    return False


def _is_list(field: FieldDescriptor) -> bool:
    # protobuf before 6.31 has labels in place of the property.
    return bool(getattr(field, "is_repeated", getattr(field, "label", None) == field.LABEL_REPEATED))


def decoder_for(channel: Channel, schema: Schema | None, spending: Spending) -> Decoder:
    """The function from messages of a channel to their records; what they cost is taken from `spending`.

    If there is none, a MessageError is raised.
    """
    if schema is None:
        raise MessageError("it has no schema")
    name, encoding, take = schema.name, channel.message_encoding, spending.take_parts
    if len(schema.data) > SCHEMA:
        raise MessageError(f"the definition of {name[:80]} has {len(schema.data)} bytes, beyond the limit of {SCHEMA}")
    if encoding == "cdr" and schema.encoding == "ros2msg" and name.replace("/msg/", "/") in ROS2_SCHEMAS:
        spending.take_schema(len(schema.data))
        try:
            return ros2_decoder(name, schema.data.decode(), take)
        except UnicodeDecodeError as error:
            raise MessageError(f"the definition of {name} is not UTF-8") from error
    if encoding == "json" and name in FOXGLOVE_SCHEMAS:
        parse = partial(parse_json, take=take)
        return foxglove_decoder(name, parse, JSON, take)
    if encoding == "protobuf" and name in FOXGLOVE_SCHEMAS:
        spending.take_schema(len(schema.data))
        return foxglove_decoder(name, _protobuf_parser(schema), PROTOBUF, take)
    raise MessageError(f"schema {name!r} ({schema.encoding}) in {encoding!r} is not read by this library")
