"""MCAP files byte by byte, what no writer would write: records, then whole logs of crafted chunks and messages."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import lz4.frame
import zstandard
from log_files import definition

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)

COMPRESS: dict[str, Any] = {
    "zstd": lambda data: zstandard.ZstdCompressor().compress(data),
    "lz4": lambda data: lz4.frame.compress(data),
    "": lambda data: data,
}


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value: str | bytes) -> bytes:
    content = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(content)) + content


def schema(id_: int, name: str, encoding: str, definition: bytes) -> bytes:
    return record(SCHEMA, struct.pack("<H", id_) + text(name) + text(encoding) + text(definition))


def channel(id_: int, schema_id: int, topic: str, encoding: str, metadata: bytes = b"") -> bytes:
    return record(CHANNEL, struct.pack("<HH", id_, schema_id) + text(topic) + text(encoding) + text(metadata))


def message(channel_id: int, data: bytes, time: int = 0) -> bytes:
    return record(MESSAGE, struct.pack("<HIQQ", channel_id, 0, time, time) + data)


def chunk(
    data: bytes, compression: str = "zstd", *, stated: int | None = None, first: int = 0, last: int = 0,
    compressed: bytes | None = None, name: str | None = None,
) -> bytes:  # fmt: skip
    """A chunk of these records. What it states may be a lie."""
    inside = COMPRESS[compression](data) if compressed is None else compressed
    size = len(data) if stated is None else stated
    head = struct.pack("<QQQI", first, last, size, 0) + text(compression if name is None else name)
    return record(CHUNK, head + struct.pack("<Q", len(inside)) + inside)


@dataclass
class Mcap:
    """A file that grows; `file` gives it its index."""

    data: bytearray = field(default_factory=lambda: bytearray(MAGIC + record(HEADER, text("") + text("crafted"))))
    index: bytearray = field(default_factory=bytearray)
    chunks: int = 0
    counts: dict[int, int] = field(default_factory=dict)

    def add(self, content: bytes) -> int:
        """Add records; return where they begin."""
        at = len(self.data)
        self.data += content
        return at

    def add_chunk(self, content: bytes, size: int = 0, first: int = 0, last: int = 0) -> int:
        """Add a chunk, and list it."""
        at = self.add(content)
        self.list_chunk(at, len(content), size, first, last)
        return at

    def list_chunk(
        self, at: int, length: int, size: int = 0, first: int = 0, last: int = 0, offsets: Iterable[int] = ()
    ) -> None:
        """List a chunk in the index, true or not."""
        pairs = b"".join(struct.pack("<HQ", channel_id, 0) for channel_id in offsets)
        content = struct.pack("<QQQQ", first, last, at, length) + text(pairs)
        content += struct.pack("<Q", 0) + text("zstd") + struct.pack("<QQ", length, size)
        self.index += record(CHUNK_INDEX, content)
        self.chunks += 1

    def describe(self, content: bytes) -> None:
        """Put schemas and channels in the index too."""
        self.add(content)
        self.index += content

    def file(self, *, has_index: bool = True, summary_start: int | None = None) -> bytes:
        """The whole file."""
        if not has_index:
            return bytes(self.data) + record(DATA_END, bytes(4)) + record(FOOTER, bytes(20)) + MAGIC
        counts = b"".join(struct.pack("<HQ", *item) for item in self.counts.items())
        statistics = struct.pack("<QHIIIIQQ", sum(self.counts.values()) % 2**64, 0, 0, 0, 0, self.chunks, 0, 0)
        data = bytes(self.data) + record(DATA_END, bytes(4))
        start = len(data) if summary_start is None else summary_start
        index = bytes(self.index) + record(STATISTICS, statistics + text(counts))
        return data + index + record(FOOTER, struct.pack("<QQI", start, 0, 0)) + MAGIC


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
