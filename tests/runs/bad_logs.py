"""Pieces of recordings to make bad logs of, and how a calibration of one is refused."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import synthetic_logs as made
from synthetic_logs import BEGIN_NS, Message

from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.runs.output_folder import DETECTIONS, LIST_FILE
from gtsam_rwhec.runs.whole_runs import calibrate_log

RECORDED = made.recording(4.0)
MOVING = [message for message in RECORDED if message.topic == "/tf"]
SEEN = [message for message in RECORDED if message.topic != "/tf"]
#: Cameras with images in place of a driver.
WITH_IMAGES = {
    camera: f"images: /{camera}/image\n    intrinsics: {{topic: /{camera}/camera_info}}" for camera in made.CAMERAS
}
#: What there is of a calibration.
WRITTEN = {
    "calibration.mcap", "result.json", "static_tf.launch.py", "tf.yaml", "rig.urdf.xacro", "camchain.yaml",
    "cameras.opencv.yaml", "cameras.txt", "report.html", "evidence.json",
}  # fmt: skip


def calibrate(folder: Path, messages: Iterable[Message], **pieces: str) -> Any:
    """All stages, on messages as given; `pieces` of the rig file replaced."""
    log = made.write(folder / "raw.mcap", messages)
    return calibrate_log(log, made.rig(**pieces), folder / "out")


def refused(folder: Path, messages: Iterable[Message], kind: type[RwhecError], *words: str, **pieces: str) -> str:
    """That a calibration ends with this very class and says all `words`, and that no result is there; the message."""
    with pytest.raises(RwhecError) as caught:
        calibrate(folder, messages, **pieces)
    assert type(caught.value) is kind, repr(caught.value)
    for word in words:
        assert word in str(caught.value), f"{word!r} is not in: {caught.value}"
    left = {path.name for path in (folder / "out").rglob("*")}
    assert left <= {"detected.mcap", "seen.png", DETECTIONS, LIST_FILE}  # from which to go on, and what was seen
    return str(caught.value)


def picture(family: int | None = None, number: int = 0) -> bytes:
    """A PNG, gray, or with a tag in the middle."""
    pixels = np.full((made.HEIGHT, made.WIDTH), 230, dtype=np.uint8)
    if family is not None:
        dictionary = cv2.aruco.getPredefinedDictionary(family)
        pixels[140:340, 220:420] = cv2.aruco.generateImageMarker(dictionary, number, 200)
    return bytes(cv2.imencode(".png", pixels)[1].tobytes())


def images(data: bytes, count: int = 6) -> list[Message]:
    """Of both cameras, with their intrinsics before them."""
    messages = [made.camera_info(camera) for camera in made.CAMERAS]
    for i in range(count):
        stamp = BEGIN_NS + i * 400_000_000
        for camera in made.CAMERAS:
            content = {
                "timestamp": {"sec": stamp // 10**9, "nsec": stamp % 10**9},
                "frame_id": camera,
                "data": base64.b64encode(data).decode(),
                "format": "png",
            }
            messages.append(Message(f"/{camera}/image", "foxglove.CompressedImage", content, stamp))
    return messages


def linked(message: Message, **names: str) -> Message:
    """A message of tf between other frames."""
    return replace(message, content={"transforms": [part | names for part in message.content["transforms"]]})


def restamped(messages: Iterable[Message], topics: str, stamp: Callable[[int], int]) -> list[Message]:
    """With the stamps of topics (a regular expression) changed."""
    return [m.stamped(stamp(m.stamp_ns)) if re.fullmatch(topics, m.topic) else m for m in messages]


def since_1970(stamp_ns: int) -> int:
    """What a clock that began at 0 when the camera was switched on has."""
    return stamp_ns - BEGIN_NS + 10**9
