"""Logs that were made to exhaust their reader: each is refused, with a reason, in little memory and time."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from crafted_mcap import LITTLE_ENDIAN, Mcap, cdr, channel, chunk, described, message, schema, text
from hostile_records import CHUNKS, INDEX, MESSAGES, RECORDS
from limited_process import MEMORY, SECONDS, Reader, Reading
from log_files import definition

#: Topics that are asked for by name, since else what cannot be read is passed over.
ASKED = {"types of protobuf": ["/a"], "long definition": ["/0"]}


def refused(reading: Reading, size: int, words: str) -> None:
    assert not reading.error.startswith("not ours"), f"{reading.error}: {reading.message}"
    assert words in reading.said, (reading.error, reading.said[:2000])
    assert reading.peak_bytes <= MEMORY + size, f"{reading.peak_bytes} bytes for {size}"
    assert reading.seconds <= SECONDS


ALL = CHUNKS | {f"{name} (records)": case for name, case in RECORDS.items()}
ALL |= {f"{name} (index)": case for name, case in INDEX.items()} | {
    f"{name} (message)": c for name, c in MESSAGES.items()
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name == "huger zstd" else name for name in ALL]
)
def test_a_hostile_log_is_refused_within_its_budget(reader: Reader, tmp_path: Path, name: str) -> None:
    make, words = ALL[name]
    path = tmp_path / "a.mcap"
    path.write_bytes(make())
    asked = ASKED.get(name.partition(" (")[0])
    refused(reader("log", path, topics=asked), path.stat().st_size, words)
    if name in CHUNKS:
        refused(reader("copy", path), path.stat().st_size, "")


# Logs of the same kinds that are honest, as large as they come


def images(count: int, width: int, height: int, channels: int, *, overlap: bool = False) -> bytes:
    """Black raw images, as a simulator records them, each in a chunk of its own."""
    mcap = Mcap()
    mcap.describe(schema(1, "sensor_msgs/msg/Image", "ros2msg", definition("sensor_msgs/Image").encode()))
    mcap.describe(channel(1, 1, "/image", "cdr"))
    encoding = text(b"mono8\0" if channels == 1 else b"rgb8\0") + (b"\0" if channels == 1 else b"\0\0")
    step, pixels = struct.pack("<I", width * channels), bytes(width * height * channels)
    padding = bytes(-(4 + 8 + 4 + 4 + 3 + 1 + 8 + len(encoding) + 1) % 4)
    head = LITTLE_ENDIAN + bytes(8) + text(b"cam\0") + struct.pack("<II", height, width) + encoding + b"\0" + padding
    for i in range(count):
        data = message(1, head + step + struct.pack("<I", len(pixels)) + pixels, i)
        last = i + 9 if overlap else i
        mcap.add_chunk(chunk(data, first=i, last=last), len(data), i, last)
    mcap.counts = {1: count}
    return mcap.file()


def frames_that_never_move(count: int) -> bytes:
    """Thirty transforms a message, in JSON: what has the most parts for each byte of its file."""
    pose = '"translation":{"x":1,"y":2,"z":3},"rotation":{"x":0,"y":0,"z":0.6,"w":0.8}'

    def content(i: int) -> bytes:
        stamp = f'"timestamp":{{"sec":{i // 100},"nsec":{i % 100 * 10**7}}}'
        parts = (f'{{{stamp},"parent_frame_id":"base","child_frame_id":"link_{k}",{pose}}}' for k in range(30))
        return f'{{"transforms":[{",".join(parts)}]}}'.encode()

    descriptions = schema(1, "foxglove.FrameTransforms", "jsonschema", b"{}") + channel(1, 1, "/tf", "json")
    return described([message(1, content(i), i) for i in range(count)], descriptions)


def markers(count: int) -> bytes:
    """A long list of poses in one message, with a list of as many numbers."""
    pose = struct.pack("<7d", 1, 2, 3, 0, 0, 0.6, 0.8)
    head = bytes(8) + text(b"cam\0") + struct.pack("<I", count)
    ids = bytes(-len(head) % 8) + struct.pack(f"<{count}q", *range(count)) + struct.pack("<I", count) + bytes(4)
    return cdr("ros2_aruco_interfaces/ArucoMarkers", head + ids + pose * count)


HONEST: dict[str, tuple[Callable[[], bytes], int]] = {
    "black images": (lambda: images(1500, 640, 480, 1), 1500),
    "large black images": (lambda: images(10, 4000, 3000, 3), 10),
    "images that overlap": (lambda: images(10, 1920, 1200, 1, overlap=True), 10),
    "frames that never move": (lambda: frames_that_never_move(1000), 30_000),
    "a long list": (lambda: markers(3000), 3000),
}


@pytest.mark.parametrize("name", HONEST)
def test_an_honest_log_of_the_same_kind_is_read(reader: Reader, tmp_path: Path, name: str) -> None:
    make, records = HONEST[name]
    path = tmp_path / "a.mcap"
    path.write_bytes(make())
    reading = reader("log", path)
    assert (reading.error, reading.warnings, reading.result) == ("", "", [1, records]), reading.said
    assert reading.peak_bytes <= MEMORY + path.stat().st_size
