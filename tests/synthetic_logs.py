"""Logs of a made-up hand with two cameras over three tags, with detections in place of images; each message as data.

    messages = recording(seconds=10.0)
    write(path, [m for m in messages if m.topic != "/tf"])
    clean_log(...)

A test spoils the messages, or the rig file's text, before they are written or parsed.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rwhec_factors import se3
from scipy.spatial.transform import Rotation

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs.mcap_writer import json_schema
from gtsam_rwhec.rig import Rig, parse_rig, read_rig
from gtsam_rwhec.runs.cleaning_stage import clean_log
from gtsam_rwhec.runs.detection_stage import detect_log
from gtsam_rwhec.runs.solving_stage import Calibrated, solve_log

BEGIN_NS = 1_700_000_000_000_000_000
SIZE_M = 0.12
CAMERAS, TAGS = ("cam_0", "cam_1"), ("tag_0", "tag_1", "tag_2")
WIDTH, HEIGHT, FOCAL = 640, 480, 400.0
K = ((FOCAL, 0.0, 320.0), (0.0, FOCAL, 240.0), (0.0, 0.0, 1.0))
RIG = f"""\
carriers:
  sensors: hand
  targets: base
  poses: {{tf: [base, hand]}}
  max_gap_s: 0.2
sensors:
  cam_0:
    detections: /cam_0/tags
  cam_1:
    detections: /cam_1/tags
targets:
  tag_0: {{type: tag, family: tag36h11, id: 0, size_m: {SIZE_M}}}
  tag_1: {{type: tag, family: tag36h11, id: 1, size_m: {SIZE_M}}}
  tag_2: {{type: tag, family: tag36h11, id: 2, size_m: {SIZE_M}}}
sizes: known
noise: estimate
"""


def pose(turned_deg: Iterable[float], position: Iterable[float]) -> Array:
    """Turned about the fixed axes x, y, z, in this order."""
    return se3.pose(Rotation.from_euler("xyz", list(turned_deg), degrees=True).as_matrix(), list(position))


#: T_hand_camera: the cameras look along the hand's z.
Y: dict[str, Array] = {"cam_0": pose((4, -6, 20), (0.06, 0.02, 0.04)), "cam_1": pose((-5, 8, -35), (-0.05, 0.01, 0.05))}
#: T_base_tag: on the table and leaning, facing up.
X: dict[str, Array] = {
    "tag_0": pose((0, 0, 10), (-0.12, 0.08, 0.0)),
    "tag_1": pose((12, -8, 80), (0.15, 0.1, 0.02)),
    "tag_2": pose((-10, 15, -50), (0.02, -0.15, 0.03)),
}


def hand(t_s: float) -> Array:
    """T_base_hand: above the table, looking down, swinging about all axes without repeating itself."""
    s = 2.0 * np.pi * t_s
    swing = (22 * np.sin(0.31 * s + 1), 20 * np.sin(0.23 * s), 40 * np.sin(0.17 * s + 2))
    place = (0.15 * np.sin(0.19 * s), 0.15 * np.cos(0.27 * s), 0.8 + 0.15 * np.sin(0.13 * s))
    return pose((180, 0, 0), place) @ pose(swing, (0, 0, 0))


@dataclass(frozen=True)
class Message:
    """One message of a log: JSON, unless `data` is given as it is to be written."""

    topic: str
    schema: str
    content: Mapping[str, Any]
    logged_ns: int
    data: bytes | None = None
    encoding: str = "json"

    def stamped(self, stamp_ns: int) -> Message:
        """With another time in it, logged when it was."""
        time = {"sec": stamp_ns // 10**9, "nsec": stamp_ns % 10**9}
        content = dict(self.content)
        if "timestamp" in content:
            content["timestamp"] = time
        if "transforms" in content:
            content["transforms"] = [part | {"timestamp": time} for part in content["transforms"]]
        return replace(self, content=content)

    @property
    def stamp_ns(self) -> int:
        """Its own."""
        time = (self.content["transforms"][0] if "transforms" in self.content else self.content)["timestamp"]
        return int(time["sec"]) * 10**9 + int(time["nsec"])


def transform(stamp_ns: int, parent: str, child: str, T: Array, topic: str = "/tf") -> Message:
    part = _pose(T)
    time = {"sec": stamp_ns // 10**9, "nsec": stamp_ns % 10**9}
    content = {
        "timestamp": time,
        "parent_frame_id": parent,
        "child_frame_id": child,
        "translation": part["position"],
        "rotation": part["orientation"],
    }
    return Message(topic, "foxglove.FrameTransforms", {"transforms": [content]}, stamp_ns)


def pose_in_frame(stamp_ns: int, frame: str, T: Array, topic: str) -> Message:
    time = {"sec": stamp_ns // 10**9, "nsec": stamp_ns % 10**9}
    content = {"timestamp": time, "frame_id": frame, "pose": _pose(T)}
    return Message(topic, "foxglove.PoseInFrame", content, stamp_ns)


def tag(
    number: int, T: Array, *, family: str = "tag36h11", size_m: float = SIZE_M, corners_px: Array | None = None
) -> dict[str, Any]:
    """One detection; T = T_camera_tag."""
    part: dict[str, Any] = {"family": family, "id": str(number), "size_m": size_m, "pose": _pose(T)}
    if corners_px is not None:
        part["corners_px"] = [{"x": float(x), "y": float(y)} for x, y in corners_px]
    return part


def detections(topic: str, stamp_ns: int, frame: str, tags: Iterable[Mapping[str, Any]]) -> Message:
    time = {"sec": stamp_ns // 10**9, "nsec": stamp_ns % 10**9}
    content = {"timestamp": time, "frame_id": frame, "detections": list(tags)}
    return Message(topic, "gtsam_rwhec.TagDetections", content, stamp_ns)


def camera_info(camera: str, stamp_ns: int = BEGIN_NS, **changed: Any) -> Message:
    """Intrinsics on /<camera>/camera_info; `changed` takes the place of what is right."""
    content = {
        "timestamp": {"sec": stamp_ns // 10**9, "nsec": stamp_ns % 10**9},
        "frame_id": camera, "width": WIDTH, "height": HEIGHT, "distortion_model": "plumb_bob",
        "D": [0.0] * 5, "K": [x for row in K for x in row], "R": [], "P": [],
    }  # fmt: skip
    return Message(f"/{camera}/camera_info", "foxglove.CameraCalibration", content | changed, stamp_ns)


def recording(
    seconds: float = 10.0,
    *,
    seed: int = 0,
    tf_hz: float = 50.0,
    camera_hz: float = 5.0,
    rotation_deg: float = 0.1,
    translation_mm: float = 1.0,
    corner_px: float = 0.1,
    true_size: Mapping[str, float] | None = None,
    offsets_s: Mapping[str, float] | None = None,
) -> list[Message]:
    """The hand's tf, and every tag in every camera with its corners, by log time.

    Parameters
    ----------
    seconds, seed, tf_hz, camera_hz
    rotation_deg, translation_mm
        Noise of detected poses, of each axis.
    corner_px
        Noise of corners, of each axis.
    true_size : dict of tag to float, optional
        True side / `SIZE_M`, where they differ; detected poses are made with `SIZE_M`, so these are off.
    offsets_s : dict of camera to float, optional
        A camera's stamp t is the hand's t + offset.
    """
    rng = np.random.default_rng(seed)
    half = 0.5 * SIZE_M
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    messages = []
    for i in range(round(seconds * tf_hz) + 1):
        stamp = BEGIN_NS + round(1e9 * i / tf_hz)
        messages.append(transform(stamp, "base", "hand", hand(i / tf_hz)))
    for number, camera in enumerate(CAMERAS):
        offset_s = (offsets_s or {}).get(camera, 0.0)
        for i in range(1, round(seconds * camera_hz)):
            t = (i + 0.1 * number) / camera_hz
            tags = []
            for name in TAGS:
                T = np.linalg.inv(hand(t) @ Y[camera]) @ X[name]
                larger = (true_size or {}).get(name, 1.0)
                seen = T[:3, :3] @ (larger * square).T + T[:3, 3:]
                pixels = (seen[:2] / seen[2] * FOCAL).T + np.array([320.0, 240.0]) + rng.normal(0.0, corner_px, (4, 2))
                noise = np.r_[rng.normal(0.0, np.radians(rotation_deg), 3), rng.normal(0.0, 1e-3 * translation_mm, 3)]
                T[:3, 3] /= larger
                T = T @ se3.expmap(noise[None])[0]
                tags.append(tag(TAGS.index(name), T, corners_px=pixels))
            stamp = BEGIN_NS + round(1e9 * (t - offset_s))
            messages.append(detections(f"/{camera}/tags", stamp, camera, tags))
    return sorted(messages, key=lambda message: message.logged_ns)


def write(
    path: Path,
    messages: Iterable[Message],
    *,
    chunk_size: int = 1 << 16,
    compression: CompressionType = CompressionType.ZSTD,
) -> Path:
    """Write an MCAP file, messages in the order in which they are given."""
    with open(path, "wb") as stream:
        writer = McapWriter(stream, chunk_size=chunk_size, compression=compression)
        writer.start()
        channels: dict[tuple[str, str, str], int] = {}
        for message in messages:
            key = message.topic, message.schema, message.encoding
            if key not in channels:
                try:
                    schema = json_schema(message.schema)
                except KeyError:
                    schema = b"{}"
                schema_id = writer.register_schema(message.schema, "jsonschema", schema)
                channels[key] = writer.register_channel(message.topic, message.encoding, schema_id)
            data = json.dumps(message.content).encode() if message.data is None else message.data
            writer.add_message(channels[key], message.logged_ns, data, message.logged_ns)
        writer.finish()
    return path


def rig(**replaced: str) -> Rig:
    """The rig file; `replaced` are pieces of its text, by their keywords in `_PIECES`."""
    return parse_rig(rig_text(**replaced), "rig.yaml")


def rig_text(**replaced: str) -> str:
    text = RIG
    for name, new in replaced.items():
        assert _PIECES[name] in text
        text = text.replace(_PIECES[name], new)
    return text


_PIECES = {
    "poses": "{tf: [base, hand]}",
    "cam_0": "detections: /cam_0/tags",
    "cam_1": "detections: /cam_1/tags",
    "tag_0": f"{{type: tag, family: tag36h11, id: 0, size_m: {SIZE_M}}}",
    "tag_1": f"{{type: tag, family: tag36h11, id: 1, size_m: {SIZE_M}}}",
    "tag_2": f"{{type: tag, family: tag36h11, id: 2, size_m: {SIZE_M}}}",
    "sizes": "sizes: known",
    "noise": "noise: estimate",
}


def _pose(T: Array) -> dict[str, dict[str, float]]:
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return {
        "position": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
        "orientation": dict(zip("xyzw", quaternion, strict=True)),
    }


def solved(folder: Path, messages: Iterable[Message], text: str) -> Calibrated:
    """The answer of the stages to a log and a rig file, without the files for others."""
    (folder / "rig.yaml").write_text(text, encoding="utf-8")
    detected, rig = folder / "detected.mcap", read_rig(folder / "rig.yaml")
    detect_log(write(folder / "raw.mcap", messages), rig, detected)
    clean_log(detected, detected, rig)
    return solve_log(detected, rig)
