"""JSON schemas of the messages that this library writes: Foxglove's well-known schemas and two of this library.

``gtsam_rwhec.TagDetections``
    Tags seen in one image. ``frame_id`` is the camera's frame; each detection has ``family``, ``id`` and, where known,
    ``size_m``, ``corners_px`` (four points; of a board the corners that were seen, which ``corner_indices`` names),
    ``pose`` (T_camera_tag), ``covariance`` (36 numbers, row-major; rotation first, radians and metres, right
    perturbation of the pose), ``reprojection_px`` (root mean square) and, if the detection is not used, ``reason``.
``gtsam_rwhec.MeasuredPair``
    A synchronised measurement of A X = Y B: ``A`` = T_sensorcarrier_targetcarrier and ``B`` = T_sensor_target, 16
    numbers each, row-major, metres; ``target`` and ``sensor``; ``is_inlier``; ``reason``, which is empty for an
    inlier; and B's ``covariance`` as above, where known.
"""

from __future__ import annotations

import json
from typing import Any

from gtsam_rwhec.logs.message_kinds import MEASURED_PAIR, TAG_DETECTIONS

_NUMBER = {"type": "number"}
_INTEGER = {"type": "integer"}
_STRING = {"type": "string"}


def _message(title: str = "", /, **properties: Any) -> dict[str, Any]:
    schema: dict[str, Any] = {"type": "object", "properties": properties}
    return {"title": title, **schema} if title else schema


def _several(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_TIME = _message("time", sec=_INTEGER, nsec=_INTEGER)
_VECTOR = _message("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _message("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _message("foxglove.Pose", position=_VECTOR, orientation=_QUATERNION)
_POINT = _message("foxglove.Point2", x=_NUMBER, y=_NUMBER)
_COLOR = _message("foxglove.Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)

_TRANSFORM = _message(
    "foxglove.FrameTransform", timestamp=_TIME, parent_frame_id=_STRING, child_frame_id=_STRING,
    translation=_VECTOR, rotation=_QUATERNION,
)  # fmt: skip
_POINTS = _message(
    "foxglove.PointsAnnotation", timestamp=_TIME, type=_INTEGER, points=_several(_POINT), outline_color=_COLOR,
    outline_colors=_several(_COLOR), fill_color=_COLOR, thickness=_NUMBER,
)  # fmt: skip
_TEXT = _message(
    "foxglove.TextAnnotation", timestamp=_TIME, position=_POINT, text=_STRING, font_size=_NUMBER, text_color=_COLOR,
    background_color=_COLOR,
)  # fmt: skip
_DETECTION = _message(
    family=_STRING, id=_STRING, size_m=_NUMBER, corners_px=_several(_POINT), pose=_POSE,
    covariance=_several(_NUMBER), corner_indices=_several(_INTEGER), reprojection_px=_NUMBER, reason=_STRING,
)  # fmt: skip

_SCHEMAS = {
    "foxglove.FrameTransforms": _message(transforms=_several(_TRANSFORM)),
    "foxglove.PoseInFrame": _message(timestamp=_TIME, frame_id=_STRING, pose=_POSE),
    "foxglove.PosesInFrame": _message(timestamp=_TIME, frame_id=_STRING, poses=_several(_POSE)),
    "foxglove.ImageAnnotations": _message(
        circles=_several(_message()), points=_several(_POINTS), texts=_several(_TEXT)
    ),
    "foxglove.CompressedImage": _message(
        timestamp=_TIME, frame_id=_STRING, data={"type": "string", "contentEncoding": "base64"}, format=_STRING
    ),
    "foxglove.CameraCalibration": _message(
        timestamp=_TIME, frame_id=_STRING, width=_INTEGER, height=_INTEGER, distortion_model=_STRING,
        **dict.fromkeys("DKRP", _several(_NUMBER)),
    ),
    TAG_DETECTIONS: _message(timestamp=_TIME, frame_id=_STRING, detections=_several(_DETECTION)),
    MEASURED_PAIR: _message(
        timestamp=_TIME, target=_STRING, sensor=_STRING, A=_several(_NUMBER), B=_several(_NUMBER),
        is_inlier={"type": "boolean"}, reason=_STRING, covariance=_several(_NUMBER),
    ),
}  # fmt: skip


def json_schema(name: str) -> bytes:
    """The JSON schema that a channel of messages `name` carries."""
    return json.dumps({"title": name, **_SCHEMAS[name]}).encode()
