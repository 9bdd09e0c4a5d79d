"""Logs written in MCAP: messages copied from another log, and messages of this library beside them.

    with open_log("run.mcap") as log, LogWriter("clean.mcap") as out:
        out.copy(log, images="leave_out")
        out.transforms("/calibration", stamp_ns, [("rig", "cam_0", T_rig_cam)])

The file gets its name once it is whole (`atomic_stream`): an error leaves the earlier file as it was.
"""

from __future__ import annotations

import base64
import json
import os
import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
from mcap.records import Channel, Schema
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from scipy.spatial.transform import Rotation

from gtsam_rwhec.errors import BudgetError, LogError
from gtsam_rwhec.files.whole_files import atomic_stream
from gtsam_rwhec.logs.mcap_reader import Log
from gtsam_rwhec.logs.records import (
    CLOUD_SCHEMAS,
    IMAGE_SCHEMAS,
    MEASURED_PAIR,
    TAG_DETECTIONS,
    VIDEO_SCHEMAS,
    Array,
    CloudRecord,
    DetectionRecord,
    IntrinsicsRecord,
    PairRecord,
    schema_word,
)
from gtsam_rwhec.logs.ros2_messages import POINT_FIELDS

Images = Literal["copy", "leave_out"]
#: foxglove.PointsAnnotation has this number for a closed line.
_LINE_LOOP = 2
_GREEN = {"r": 0.0, "g": 1.0, "b": 0.0, "a": 1.0}
_BLACK = {"r": 0.0, "g": 0.0, "b": 0.0, "a": 0.6}


_MESSAGE = f"{'=' * 80}\nMSG: "
#: The definition of ROS 2's PoseArray, with those of its parts.
POSE_ARRAY = "\n".join(
    [
        "std_msgs/Header header\ngeometry_msgs/Pose[] poses",
        f"{_MESSAGE}std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id",
        f"{_MESSAGE}builtin_interfaces/Time\nint32 sec\nuint32 nanosec",
        f"{_MESSAGE}geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
        f"{_MESSAGE}geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z",
        f"{_MESSAGE}geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    ]
).encode()
#: The definition of ROS 2's PointCloud2, with those of its parts.
POINT_CLOUD = "\n".join(
    [
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields",
        "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense",
        f"{_MESSAGE}std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id",
        f"{_MESSAGE}builtin_interfaces/Time\nint32 sec\nuint32 nanosec",
        f"{_MESSAGE}sensor_msgs/PointField\nstring name\nuint32 offset\nuint8 datatype\nuint32 count",
    ]
).encode()


class LogWriter(AbstractContextManager["LogWriter"]):
    """A context manager that writes one MCAP file. A file of this name is replaced when the block ends without an
    error.

    Every method raises a LogError where the file cannot be written: no such folder, no permission, disk full.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(os.path.realpath(path))
        self._file = atomic_stream(self.path)
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[str, str, int, tuple[tuple[str, str], ...]], int] = {}
        with self._saying(), ExitStack() as on_error:
            self._writer = McapWriter(on_error.enter_context(self._file), compression=CompressionType.ZSTD)
            self._writer.start(profile="", library="gtsam-rwhec")
            on_error.pop_all()  # __exit__ closes the file

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._file.__exit__(kind, error, trace)
            return
        with self._saying(), ExitStack() as closing:
            closing.push(self._file)
            self._writer.finish()  # type: ignore[no-untyped-call]

    def copy(
        self,
        log: Log,
        topics: Iterable[str] | None = None,
        images: Images = "copy",
        of_stages: re.Pattern[str] | None = None,
    ) -> int:
        """Copy messages byte for byte, with their schemas, channels and times, but no metadata and no attachments.

        Without `topics`, of all; ``images="leave_out"`` leaves out images, videos and clouds, but not those on topics
        that match `of_stages`. Damaged blocks are left out (``log.losses`` and `Log.records` name them). Returns how
        many messages were copied.
        """
        wanted = None if topics is None else set(topics)
        leaves = images == "leave_out"
        copied = 0
        for file in log.files:
            file.spending.begin_pass()
            for block in sorted(file.blocks, key=lambda block: block.start_ns):
                try:
                    messages = file.open(block)
                except BudgetError:
                    raise
                except LogError:
                    continue
                made: dict[int, int | None] = {}
                spans = zip(messages.start, messages.end, strict=True)
                for (channel_id, sequence, logged, published), (start, end) in zip(
                    messages.heads.tolist(), spans, strict=True
                ):
                    if channel_id not in made:
                        made[channel_id] = self._copied_channel(file, channel_id, wanted, of_stages, leaves=leaves)
                    target = made[channel_id]
                    if target is not None:
                        with self._saying():
                            self._writer.add_message(target, logged, messages.data[start:end], published, sequence)
                        copied += 1
        return copied

    def message(self, channel: Channel, schema: Schema | None, logged_ns: int, data: bytes) -> None:
        """Write a message byte for byte, as it came on a channel with a schema."""
        schema_id = 0 if schema is None else self._schema(schema.name, schema.encoding, schema.data)
        target = self._channel(channel.topic, channel.message_encoding, schema_id, channel.metadata)
        with self._saying():
            self._writer.add_message(target, logged_ns, data, logged_ns)

    def transforms(self, topic: str, stamp_ns: int, transforms: Iterable[tuple[str, str, Array]]) -> None:
        """Write a ``foxglove.FrameTransforms`` of (parent, child, T_parent_child)."""
        time = _time(stamp_ns)
        parts = [
            {
                "timestamp": time, "parent_frame_id": parent, "child_frame_id": child,
                **dict(zip(("translation", "rotation"), _pose(T).values(), strict=True)),
            }
            for parent, child, T in transforms
        ]  # fmt: skip
        self._write(topic, "foxglove.FrameTransforms", stamp_ns, {"transforms": parts})

    def poses(self, topic: str, stamp_ns: int, frame: str, T: Array) -> None:
        """Write a ``foxglove.PosesInFrame`` of (N, 4, 4) poses."""
        message = {"timestamp": _time(stamp_ns), "frame_id": frame, "poses": _poses(T)}
        self._write(topic, "foxglove.PosesInFrame", stamp_ns, message)

    def pose_array(self, topic: str, stamp_ns: int, frame: str, T: Array) -> None:
        """Write a ``geometry_msgs/msg/PoseArray`` of (N, 4, 4) poses as ROS 2 does: CDR, little endian."""
        time = _time(stamp_ns)
        head = _padded(struct.pack("<iI", time["sec"], time["nsec"]) + _cdr_text(frame)) + struct.pack("<I", len(T))
        poses = [[*part["position"].values(), *part["orientation"].values()] for part in _poses(T)]
        data = b"\0\1\0\0" + head + bytes(-len(head) % 8) + np.array(poses, "<f8").tobytes()
        self._add(topic, "cdr", ("geometry_msgs/msg/PoseArray", "ros2msg", POSE_ARRAY), stamp_ns, data)

    def point_cloud(self, cloud: CloudRecord) -> None:
        """Write a ``sensor_msgs/msg/PointCloud2`` as ROS 2 does: CDR, little endian. The points are in the frame."""
        time, types = _time(cloud.stamp_ns), {kind: number for number, kind in POINT_FIELDS.items()}
        head = _padded(struct.pack("<iI", time["sec"], time["nsec"]) + _cdr_text(cloud.frame))
        head += struct.pack("<III", cloud.height, cloud.width, len(cloud.fields))
        for name, offset, kind in cloud.fields:
            head = _padded(_padded(head + _cdr_text(name)) + struct.pack("<IB", offset, types[kind[1:]]))
            head += struct.pack("<I", 1)
        is_big = any(kind.startswith(">") for _, _, kind in cloud.fields)
        head = _padded(head + bytes([is_big])) + struct.pack("<III", cloud.step, cloud.row_step, len(cloud.data))
        data = b"".join((b"\0\1\0\0", head, cloud.data, b"\0"))
        self._add(cloud.topic, "cdr", ("sensor_msgs/msg/PointCloud2", "ros2msg", POINT_CLOUD), cloud.logged_ns, data)

    def pose(self, topic: str, stamp_ns: int, frame: str, T: Array) -> None:
        """Write a ``foxglove.PoseInFrame`` of one pose (4, 4)."""
        message = {"timestamp": _time(stamp_ns), "frame_id": frame, "pose": _pose(T)}
        self._write(topic, "foxglove.PoseInFrame", stamp_ns, message)

    def compressed_image(self, topic: str, stamp_ns: int, frame: str, encoding: str, data: bytes) -> None:
        """Write a ``foxglove.CompressedImage``; `encoding` is ``jpeg``, ``png`` or the like."""
        content = base64.b64encode(data).decode()
        message = {"timestamp": _time(stamp_ns), "frame_id": frame, "data": content, "format": encoding}
        self._write(topic, "foxglove.CompressedImage", stamp_ns, message)

    def calibration(self, intrinsics: IntrinsicsRecord) -> None:
        """Write a ``foxglove.CameraCalibration`` to its topic; every number comes back to the last bit.

        `intrinsics.model` is written unchanged; Foxglove knows ``plumb_bob`` (k1, k2, p1, p2, k3),
        ``rational_polynomial`` (k1, k2, p1, p2, k3 to k6) and ``kannala_brandt`` (OpenCV's fisheye, k1 to k4).
        """
        message = {
            "timestamp": _time(intrinsics.stamp_ns), "frame_id": intrinsics.frame,
            "width": int(intrinsics.width), "height": int(intrinsics.height), "distortion_model": intrinsics.model,
            **{name: np.ravel(getattr(intrinsics, name)).tolist() for name in "DKRP"},
        }  # fmt: skip
        self._write(intrinsics.topic, "foxglove.CameraCalibration", intrinsics.stamp_ns, message)

    def annotations(self, topic: str, stamp_ns: int, outlines: Sequence[tuple[str, Array]]) -> None:
        """Write a ``foxglove.ImageAnnotations`` of (label, points (N, 2) in pixels): closed outlines, labelled."""
        time = _time(stamp_ns)
        points, texts = [], []
        for label, corners in outlines:
            places = _points(corners)
            points.append(
                {
                    "timestamp": time, "type": _LINE_LOOP, "points": places, "outline_color": _GREEN,
                    "outline_colors": [], "fill_color": {**_GREEN, "a": 0.0}, "thickness": 2.0,
                }
            )  # fmt: skip
            texts.append(
                {
                    "timestamp": time, "position": places[0], "text": label, "font_size": 12.0, "text_color": _GREEN,
                    "background_color": _BLACK,
                }
            )  # fmt: skip
        self._write(topic, "foxglove.ImageAnnotations", stamp_ns, {"circles": [], "points": points, "texts": texts})

    def detections(self, topic: str, stamp_ns: int, frame: str, tags: Iterable[DetectionRecord]) -> None:
        """Write a ``gtsam_rwhec.TagDetections`` of one image; the records' own stamps and frames are not used."""
        tags = list(tags)
        poses = iter(_poses([tag.T_camera_tag for tag in tags if tag.T_camera_tag is not None]))
        parts = [
            {
                "size_m": tag.size_m,
                "corners_px": None if tag.corners_px is None else _points(tag.corners_px),
                "corner_indices": tag.corner_indices,
                "pose": None if tag.T_camera_tag is None else next(poses),
                "covariance": None if tag.covariance is None else np.ravel(tag.covariance).tolist(),
                "reprojection_px": tag.reprojection_px,
                "reason": tag.reason or None,
                "family": tag.family,
                "id": tag.id,
            }
            for tag in tags
        ]
        known = [{name: value for name, value in part.items() if value is not None} for part in parts]
        message = {"timestamp": _time(stamp_ns), "frame_id": frame, "detections": known}
        self._write(topic, TAG_DETECTIONS, stamp_ns, message)

    def pair(self, pair: PairRecord) -> None:
        """Write a ``gtsam_rwhec.MeasuredPair`` to its topic; every number comes back to the last bit."""
        message: dict[str, Any] = {
            "timestamp": _time(pair.stamp_ns), "target": pair.target, "sensor": pair.sensor,
            "A": np.ravel(pair.A).tolist(), "B": np.ravel(pair.B).tolist(),
            "is_inlier": bool(pair.is_inlier), "reason": pair.reason,
        }  # fmt: skip
        if pair.covariance is not None:
            message["covariance"] = np.ravel(pair.covariance).tolist()
        self._write(pair.topic, MEASURED_PAIR, pair.stamp_ns, message)

    def metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a metadata record."""
        with self._saying():
            self._writer.add_metadata(name, dict(entries))

    def attachment(self, name: str, media_type: str, data: bytes, stamp_ns: int = 0) -> None:
        """Attach a file."""
        with self._saying():
            self._writer.add_attachment(stamp_ns, stamp_ns, name, media_type, data)

    def _write(self, topic: str, schema: str, stamp_ns: int, message: dict[str, Any]) -> None:
        try:
            data = json.dumps(message, allow_nan=False).encode()
        except ValueError as error:
            raise LogError(f"topic {topic}: a {schema} with numbers that are not finite cannot be written") from error
        self._add(topic, "json", (schema, "jsonschema", json_schema(schema)), stamp_ns, data)

    def _add(self, topic: str, encoding: str, schema: tuple[str, str, bytes], stamp_ns: int, data: bytes) -> None:
        """Write the bytes of a message of a schema (name, encoding, content)."""
        channel = self._channel(topic, encoding, self._schema(*schema), {})
        with self._saying():
            self._writer.add_message(channel, stamp_ns, data, stamp_ns)

    def _copied_channel(
        self, file: Any, channel_id: int, wanted: set[str] | None, of_stages: re.Pattern[str] | None, *, leaves: bool
    ) -> int | None:
        """The channel of this log for a channel of `file`. It is None if its messages are not copied."""
        channel = file.channels.get(channel_id)
        if channel is None or (wanted is not None and channel.topic not in wanted):
            return None
        schema = file.schemas.get(channel.schema_id)
        large = IMAGE_SCHEMAS + VIDEO_SCHEMAS + CLOUD_SCHEMAS
        is_of_stage = of_stages is not None and of_stages.fullmatch(channel.topic)
        if leaves and schema is not None and schema_word(schema.name) in large and not is_of_stage:
            return None
        schema_id = 0 if schema is None else self._schema(schema.name, schema.encoding, schema.data)
        return self._channel(channel.topic, channel.message_encoding, schema_id, channel.metadata)

    def _schema(self, name: str, encoding: str, data: bytes) -> int:
        key = name, encoding, data
        if key not in self._schemas:
            with self._saying():
                self._schemas[key] = self._writer.register_schema(name, encoding, data)
        return self._schemas[key]

    def _channel(self, topic: str, encoding: str, schema_id: int, metadata: Mapping[str, str]) -> int:
        key = topic, encoding, schema_id, tuple(sorted(metadata.items()))
        if key not in self._channels:
            with self._saying():
                self._channels[key] = self._writer.register_channel(topic, encoding, schema_id, dict(metadata))
        return self._channels[key]

    @contextmanager
    def _saying(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise LogError(f"{self.path} cannot be written: {error.strerror}.") from error


def _padded(data: bytes) -> bytes:
    """Bytes of CDR up to where a number of four bytes may begin."""
    return data + bytes(-len(data) % 4)


def _cdr_text(text: str) -> bytes:
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data


def _points(corners: Array) -> list[dict[str, float]]:
    return [{"x": float(x), "y": float(y)} for x, y in corners]


def _time(stamp_ns: int) -> dict[str, int]:
    if not 0 <= stamp_ns < 1 << 64:
        raise LogError(f"stamp {stamp_ns} ns cannot be written: give a stamp between 0 and 2^64 ns")
    return {"sec": int(stamp_ns) // 10**9, "nsec": int(stamp_ns) % 10**9}


def _pose(T: Array) -> dict[str, dict[str, float]]:
    return _poses([T])[0]


def _poses(every: Iterable[Array]) -> list[dict[str, dict[str, float]]]:
    poses = [np.asarray(T, dtype=np.float64) for T in every]
    for T in poses:
        if T.shape != (4, 4) or not np.isfinite(T).all():
            raise LogError(f"a pose must be a finite (4, 4) matrix to be written, not {T.tolist()}")
    if not poses:
        return []
    T = np.array(poses)
    R = T[:, :3, :3]
    wrong = (np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max(axis=(1, 2)) > 1e-3) | (np.linalg.det(R) < 0)
    if wrong.any():
        raise LogError(f"a pose to be written has {R[wrong.argmax()].tolist()} where its rotation should be")
    return [
        {"position": dict(zip("xyz", t, strict=True)), "orientation": dict(zip("xyzw", q, strict=True))}
        for t, q in zip(T[:, :3, 3].tolist(), Rotation.from_matrix(R).as_quat().tolist(), strict=True)
    ]


#: Messages by schema, each with a value of its type in every field; a list has one entry.
_TIME: dict[str, Any] = {"sec": 0, "nsec": 0}
_VECTOR, _QUATERNION = dict.fromkeys("xyz", 0.0), dict.fromkeys("xyzw", 0.0)
_POSE = {"position": _VECTOR, "orientation": _QUATERNION}
_POINT = dict.fromkeys("xy", 0.0)
_IN_FRAME: dict[str, Any] = {"timestamp": _TIME, "frame_id": ""}
_TRANSFORM = {
    "timestamp": _TIME, "parent_frame_id": "", "child_frame_id": "", "translation": _VECTOR, "rotation": _QUATERNION,
}  # fmt: skip
_POINTS = {
    "timestamp": _TIME, "type": 0, "points": [_POINT], "outline_color": _GREEN, "outline_colors": [_GREEN],
    "fill_color": _GREEN, "thickness": 0.0,
}  # fmt: skip
_TEXT = {
    "timestamp": _TIME, "position": _POINT, "text": "", "font_size": 0.0, "text_color": _GREEN,
    "background_color": _GREEN,
}  # fmt: skip
_DETECTION = {
    "family": "", "id": "", "size_m": 0.0, "corners_px": [_POINT], "pose": _POSE, "covariance": [0.0],
    "corner_indices": [0], "reprojection_px": 0.0, "reason": "",
}  # fmt: skip
_MESSAGES: dict[str, dict[str, Any]] = {
    "foxglove.FrameTransforms": {"transforms": [_TRANSFORM]},
    "foxglove.PoseInFrame": {**_IN_FRAME, "pose": _POSE},
    "foxglove.PosesInFrame": {**_IN_FRAME, "poses": [_POSE]},
    "foxglove.ImageAnnotations": {"circles": [{}], "points": [_POINTS], "texts": [_TEXT]},
    "foxglove.CompressedImage": {**_IN_FRAME, "data": b"", "format": ""},
    "foxglove.CameraCalibration": {
        **_IN_FRAME, "width": 0, "height": 0, "distortion_model": "", "D": [0.0], "K": [0.0], "R": [0.0], "P": [0.0],
    },
    TAG_DETECTIONS: {**_IN_FRAME, "detections": [_DETECTION]},
    MEASURED_PAIR: {
        "timestamp": _TIME, "target": "", "sensor": "", "A": [0.0], "B": [0.0], "is_inlier": True, "reason": "",
        "covariance": [0.0],
    },
}  # fmt: skip
_TYPES = {bool: "boolean", int: "integer", float: "number", str: "string"}


def json_schema(name: str) -> bytes:
    """The JSON schema that a channel of messages `name` carries."""
    return json.dumps({"title": name, **_schema_of(_MESSAGES[name])}).encode()


def _schema_of(value: Any) -> dict[str, Any]:
    if isinstance(value, dict):
        return {"type": "object", "properties": {field: _schema_of(each) for field, each in value.items()}}
    if isinstance(value, list):
        return {"type": "array", "items": _schema_of(value[0])}
    return {"type": "string", "contentEncoding": "base64"} if value == b"" else {"type": _TYPES[type(value)]}
