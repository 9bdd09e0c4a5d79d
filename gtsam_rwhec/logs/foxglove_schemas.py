"""Foxglove's well-known schemas to records, from JSON and from protobuf; and our own, from JSON.

A JSON object and a protobuf message are read by the same code: a field is ``get(message, name)``, with `get` being
``operator.getitem`` or ``getattr``. They differ in times (``sec``, ``nsec`` in JSON; ``seconds``, ``nanos`` in
protobuf) and in bytes (base64 in JSON).
"""

from __future__ import annotations

import base64
import json
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from gtsam_rwhec.errors import MessageError
from gtsam_rwhec.logs.checked_poses import LARGEST_M, transforms
from gtsam_rwhec.logs.message_kinds import MEASURED_PAIR, TAG_DETECTIONS
from gtsam_rwhec.logs.records import (
    Array,
    DetectionRecord,
    ImageRecord,
    IntrinsicsRecord,
    PairRecord,
    PoseRecord,
    Record,
)

#: A message's records, or what is wrong with it.
Read = Sequence[Record] | str
Get = Callable[[Any, str], Any]
#: Of a board's corners: those of 100 x 100 squares.
MOST_NUMBERS = 20_000
#: What a stranger's message can raise on its way to numbers.
_FAULTS = (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError, IndexError)


class Access:
    """How fields, times and bytes of one encoding are reached."""

    def __init__(self, get: Get, seconds: str, nanoseconds: str, as_bytes: Callable[[Any], bytes]) -> None:
        self.get = get
        self.bytes = as_bytes
        self._time = (seconds, nanoseconds)

    def stamp(self, message: Any) -> int:
        """Nanoseconds of a message's ``timestamp``."""
        time = self.get(message, "timestamp")
        seconds, nanoseconds = (self.get(time, name) for name in self._time)
        if type(seconds) is int and type(nanoseconds) is int:
            stamp = seconds * 1_000_000_000 + nanoseconds
            if abs(stamp) < 1 << 63:
                return stamp
        raise ValueError(f"timestamp {str(seconds)[:40]}, {str(nanoseconds)[:40]} is no seconds and nanoseconds")


JSON = Access(operator.getitem, "sec", "nsec", lambda text: base64.b64decode(text, validate=True))
PROTOBUF = Access(getattr, "seconds", "nanos", bytes)


def decoder(
    schema: str, parse: Callable[[bytes | memoryview], Any], access: Access
) -> Callable[[str, Sequence[bytes | memoryview], list[int]], list[Read]]:
    """Make the function that reads messages of a schema: (topic, messages, logged_ns) -> records of each.

    Parameters
    ----------
    schema
        A key of `SCHEMAS`.
    parse
        Bytes to a JSON object or a protobuf message; raises `MessageError` where they are none.
    access
        `JSON` or `PROTOBUF`.
    """
    if schema in _POSES:
        return _pose_decoder(_POSES[schema], parse, access)
    read_one = _OTHERS[schema]

    def read(topic: str, messages: Sequence[bytes | memoryview], logged_ns: list[int]) -> list[Read]:
        out: list[Read] = []
        for message, logged in zip(messages, logged_ns, strict=True):
            try:
                out.append(read_one(parse(message), access, topic, logged))
            except MessageError as error:
                out.append(str(error))
            except _FAULTS as error:
                out.append(_words(error))
        return out

    return read


def parse_json(message: bytes | memoryview) -> Any:
    """JSON object of a message.

    Raises
    ------
    MessageError
        For anything else.
    """
    try:
        value = json.loads(bytes(message))
    except (ValueError, RecursionError) as error:
        raise MessageError(f"not JSON: {error}") from error
    if not isinstance(value, dict):
        raise MessageError(f"JSON, but a {type(value).__name__} in place of an object")
    return value


def _words(error: Exception) -> str:
    if isinstance(error, KeyError | AttributeError):
        return f"lacks a field: {error}"
    return f"cannot be read as its schema: {error}"


#: One pose of a message: stamp, parent, child, then x, y, z and x, y, z, w.
_Row = tuple[int, str, str, tuple[float, ...]]


def _pose_decoder(
    rows_of: Callable[[Any, Access], list[_Row]], parse: Callable[[bytes | memoryview], Any], access: Access
) -> Callable[[str, Sequence[bytes | memoryview], list[int]], list[Read]]:
    """Rows are read one by one and made transforms together."""

    def read(topic: str, messages: Sequence[bytes | memoryview], logged_ns: list[int]) -> list[Read]:
        out: list[Any] = []
        rows: list[_Row] = []
        for message in messages:
            try:
                of_message = rows_of(parse(message), access)
            except MessageError as error:
                out.append(str(error))
            except _FAULTS as error:
                out.append(_words(error))
            else:
                out.append(range(len(rows), len(rows) + len(of_message)))
                rows += of_message
        numbers = np.array([row[3] for row in rows], dtype=np.float64).reshape(-1, 7)
        T, faults = transforms(numbers[:, :3], numbers[:, 3:])
        for i, found in enumerate(out):
            if isinstance(found, str):
                continue
            fault = next((faults[j] for j in found if j in faults), None) if faults else None
            logged = logged_ns[i]
            out[i] = fault or [PoseRecord(logged, rows[j][0], topic, rows[j][1], rows[j][2], T[j]) for j in found]
        return out

    return read


def _numbers(get: Get, position: Any, rotation: Any) -> tuple[float, ...]:
    return (
        float(get(position, "x")), float(get(position, "y")), float(get(position, "z")),
        float(get(rotation, "x")), float(get(rotation, "y")), float(get(rotation, "z")), float(get(rotation, "w")),
    )  # fmt: skip


def _text(get: Get, message: Any, name: str) -> str:
    value = get(message, name)
    if not isinstance(value, str):
        raise TypeError(f"{name} is {value!r} in place of a string")
    return value


def _frame(get: Get, message: Any, name: str = "frame_id") -> str:
    return _text(get, message, name).removeprefix("/")


def _frame_transform(message: Any, access: Access) -> list[_Row]:
    get = access.get
    numbers = _numbers(get, get(message, "translation"), get(message, "rotation"))
    parent, child = _frame(get, message, "parent_frame_id"), _frame(get, message, "child_frame_id")
    return [(access.stamp(message), parent, child, numbers)]


def _frame_transforms(message: Any, access: Access) -> list[_Row]:
    return [row for part in access.get(message, "transforms") for row in _frame_transform(part, access)]


def _pose_in_frame(message: Any, access: Access) -> list[_Row]:
    get = access.get
    pose = get(message, "pose")
    numbers = _numbers(get, get(pose, "position"), get(pose, "orientation"))
    return [(access.stamp(message), _frame(get, message), "", numbers)]


def _poses_in_frame(message: Any, access: Access) -> list[_Row]:
    get = access.get
    stamp, frame = access.stamp(message), _frame(get, message)
    return [
        (stamp, frame, "", _numbers(get, get(pose, "position"), get(pose, "orientation")))
        for pose in get(message, "poses")
    ]


def _compressed_image(message: Any, access: Access, topic: str, logged: int) -> Read:
    get = access.get
    data = access.bytes(get(message, "data"))
    if not data:
        return "image without data"
    frame, encoding = _frame(get, message), _text(get, message, "format")
    return (ImageRecord(logged, access.stamp(message), topic, frame, encoding, data),)


def _raw_image(message: Any, access: Access, topic: str, logged: int) -> Read:
    get = access.get
    data = access.bytes(get(message, "data"))
    width, height, step = (_whole(get, message, name) for name in ("width", "height", "step"))
    if width * height == 0 or step * height > len(data):
        return f"image of {width} x {height} pixels, {step} bytes a row, has {len(data)} bytes"
    frame, encoding = _frame(get, message), _text(get, message, "encoding")
    return (ImageRecord(logged, access.stamp(message), topic, frame, encoding, data, width, height, step),)


def _whole(get: Get, message: Any, name: str) -> int:
    value = get(message, name)
    if type(value) is not int or not 0 <= value < 1 << 32:
        raise ValueError(f"{name} is {value!r}")
    return value


def _camera_calibration(message: Any, access: Access, topic: str, logged: int) -> Read:
    get = access.get
    K, D, R, P = (_vector(get(message, name), name) for name in "KDRP")
    if len(R) == 0:
        R = np.eye(3).ravel()  # R and P are for rectified images, and optional
    if len(P) == 0:
        P = np.c_[K.reshape(-1, 3), np.zeros(len(K) // 3)].ravel()
    if (len(K), len(R), len(P)) != (9, 9, 12):
        return f"K, R and P have {len(K)}, {len(R)} and {len(P)} numbers in place of 9, 9 and 12"
    width, height = _whole(get, message, "width"), _whole(get, message, "height")
    frame, model = _frame(get, message), _text(get, message, "distortion_model")
    K, R, P = K.reshape(3, 3), R.reshape(3, 3), P.reshape(3, 4)
    return (IntrinsicsRecord(logged, access.stamp(message), topic, frame, width, height, model, K, D, R, P),)


def _vector(values: Any, name: str, most: int = 1000) -> Array:
    array = np.array([float(value) for value in values], dtype=np.float64)
    if len(array) > most:
        raise ValueError(f"{name} has {len(array)} numbers")
    return array


def _tag_detections(message: Any, access: Access, topic: str, logged: int) -> Read:
    """Our own ``gtsam_rwhec.TagDetections`` (see `written_schemas`)."""
    get = access.get
    stamp, frame = access.stamp(message), _frame(get, message)
    records = []
    for tag in message["detections"]:
        T = covariance = corners = None
        if tag.get("pose") is not None:
            numbers = np.array([_numbers(get, tag["pose"]["position"], tag["pose"]["orientation"])])
            made, faults = transforms(numbers[:, :3], numbers[:, 3:])
            if faults:
                return faults[0]
            T = made[0]
        if tag.get("covariance") is not None:
            covariance = _vector(tag["covariance"], "covariance").reshape(6, 6)
        if tag.get("corners_px") is not None:
            corners = _vector([c[axis] for c in tag["corners_px"] for axis in "xy"], "corners", MOST_NUMBERS)
            corners = corners.reshape(-1, 2)
        size, error = (None if tag.get(n) is None else float(tag[n]) for n in ("size_m", "reprojection_px"))
        family, name = _text(get, tag, "family"), _text(get, tag, "id")
        reason = _text(get, tag, "reason") if "reason" in tag else ""
        indices = None if tag.get("corner_indices") is None else tuple(int(i) for i in tag["corner_indices"])
        numbers_of = {"covariance": covariance, "corners_px": corners, "size_m": size, "reprojection_px": error}
        for field, given in numbers_of.items():
            if given is not None and not np.isfinite(given).all():
                return f"{field} is not finite: {np.asarray(given).tolist()}"
        if indices is not None and (corners is None or len(indices) != len(corners)):
            return f"{len(indices)} corner_indices for {0 if corners is None else len(corners)} corners"
        records.append(
            DetectionRecord(
                logged, stamp, topic, frame, family, name, corners, T, covariance, size, error, reason, indices
            )
        )
    return records


def _measured_pair(message: Any, access: Access, topic: str, logged: int) -> Read:
    """Our own ``gtsam_rwhec.MeasuredPair`` (see `written_schemas`)."""
    get = access.get
    A, B = (_vector(get(message, name), name).reshape(4, 4) for name in "AB")
    for name, T in (("A", A), ("B", B)):
        R = T[:3, :3]
        is_rotation = np.isfinite(T).all() and np.abs(R.T @ R - np.eye(3)).max() < 1e-3 and np.linalg.det(R) > 0.0
        if not (is_rotation and np.abs(T[:3, 3]).max() <= LARGEST_M and T[3].tolist() == [0, 0, 0, 1]):
            return f"{name} is no transform: {T.tolist()}"
    target, sensor, reason = (_text(get, message, name) for name in ("target", "sensor", "reason"))
    stamp, inlier = access.stamp(message), bool(get(message, "is_inlier"))
    given = message.get("covariance")
    covariance = None if given is None else _vector(given, "covariance").reshape(6, 6)
    if covariance is not None and not np.isfinite(covariance).all():
        return f"covariance is not finite: {covariance.tolist()}"
    return (PairRecord(logged, stamp, topic, target, sensor, A, B, inlier, reason, covariance),)


_POSES: dict[str, Callable[[Any, Access], list[_Row]]] = {
    "foxglove.FrameTransform": _frame_transform,
    "foxglove.FrameTransforms": _frame_transforms,
    "foxglove.PoseInFrame": _pose_in_frame,
    "foxglove.PosesInFrame": _poses_in_frame,
}
_OTHERS: dict[str, Callable[[Any, Access, str, int], Read]] = {
    "foxglove.CompressedImage": _compressed_image,
    "foxglove.RawImage": _raw_image,
    "foxglove.CameraCalibration": _camera_calibration,
    TAG_DETECTIONS: _tag_detections,
    MEASURED_PAIR: _measured_pair,
}
SCHEMAS = frozenset(_POSES) | frozenset(_OTHERS)
