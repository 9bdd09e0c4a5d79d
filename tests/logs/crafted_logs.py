"""Whole logs of crafted chunks and messages."""

from __future__ import annotations

from typing import Any

from crafted_mcap import Mcap, channel, chunk, message, schema
from log_files import definition

MIB = 1 << 20
POSE_SCHEMA = schema(1, "foxglove.PoseInFrame", "jsonschema", b"{}")
JSON_POSES = POSE_SCHEMA + channel(1, 1, "/pose", "json")
LITTLE_ENDIAN = b"\0\1\0\0"


def cdr(name: str, content: bytes, text_of_it: str | None = None) -> bytes:
    """A log of one message of a ROS type, in one chunk."""
    mcap = Mcap()
    mcap.describe(schema(1, name, "ros2msg", (definition(name) if text_of_it is None else text_of_it).encode()))
    mcap.describe(channel(1, 1, "/a", "cdr"))
    mcap.counts = {1: 1}
    data = message(1, LITTLE_ENDIAN + content)
    mcap.add_chunk(chunk(data), len(data))
    return mcap.file()


def described(messages: list[bytes], descriptions: bytes = JSON_POSES, *, has_index: bool = True) -> bytes:
    """A log of messages on channel 1, in chunks of 4 MiB."""
    mcap = Mcap()
    mcap.describe(descriptions)
    mcap.counts = {1: len(messages)}
    gathered = b""
    for i, one in enumerate(messages):
        gathered += one
        if len(gathered) > 4 * MIB or i + 1 == len(messages):
            mcap.add_chunk(chunk(gathered, first=i, last=i), len(gathered), i, i)
            gathered = b""
    return mcap.file(has_index=has_index)


def one_chunk(data: bytes, *, has_index: bool = True, **lies: Any) -> bytes:
    mcap = Mcap()
    mcap.describe(JSON_POSES)
    mcap.add_chunk(chunk(data, **lies), lies.get("stated", len(data)))
    mcap.counts = {1: 1}
    return mcap.file(has_index=has_index)


def zeros(count: int) -> bytes:
    return message(1, bytes(count))
