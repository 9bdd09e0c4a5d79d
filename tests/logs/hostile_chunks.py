"""Logs whose chunks were made to exhaust their reader, each with the words of its refusal."""

from __future__ import annotations

import struct
from collections.abc import Callable

import zstandard
from crafted_logs import JSON_POSES, LITTLE_ENDIAN, MIB, one_chunk, zeros
from crafted_mcap import Mcap, channel, chunk, message, schema, text
from log_files import definition


def chunks_that_overlap() -> bytes:
    """Ten chunks of 48 MiB, all of one time."""
    mcap = Mcap()
    mcap.describe(
        schema(1, "sensor_msgs/msg/CompressedImage", "ros2msg", definition("sensor_msgs/CompressedImage").encode())
    )
    mcap.describe(channel(1, 1, "/a", "cdr"))
    image = bytes(8) + text(b"\0") + bytes(3) + text(b"png\0") + struct.pack("<I", 3 * MIB) + bytes(3 * MIB)
    data = message(1, LITTLE_ENDIAN + image, 0) + message(1, LITTLE_ENDIAN + image, 9) * 15
    content = chunk(data, last=9)
    for _ in range(10):
        mcap.add_chunk(content, len(data), 0, 9)
    mcap.counts = {1: 160}
    return mcap.file()


def one_chunk_four_hundred_times() -> bytes:
    mcap = Mcap()
    mcap.describe(JSON_POSES)
    data = message(1, b"{}") * 1_000
    content = chunk(data)
    at = mcap.add(content)
    for _ in range(400):
        mcap.list_chunk(at, len(content), len(data))
    mcap.counts = {1: 100_000}
    return mcap.file()


def a_chunk_inside_a_chunk() -> bytes:
    mcap = Mcap()
    mcap.describe(JSON_POSES)
    inner = chunk(message(1, b"{}"))
    content = chunk(inner, "")
    at = mcap.add_chunk(content, len(inner))
    mcap.list_chunk(at + len(content) - len(inner), len(inner), 100)
    return mcap.file()


def many_chunks(compression: str = "zstd", *, has_index: bool = True, count: int = 400, size: int = 50 * MIB) -> bytes:
    """One after another, and all together hundreds of times what black images have."""
    mcap = Mcap()
    mcap.describe(JSON_POSES)
    data = message(1, b'{"' + bytes(size))
    content = chunk(data, compression)
    for i in range(count):
        mcap.add_chunk(content, len(data), i, i)
    mcap.counts = {1: count}
    return mcap.file(has_index=has_index)


def an_index_that_understates() -> bytes:
    """It says that chunks are small, and they are not."""
    mcap = Mcap()
    mcap.describe(JSON_POSES)
    content = chunk(message(1, b'{"' + bytes(50 * MIB)))
    for i in range(400):
        mcap.add_chunk(content, 100, i, i)
    mcap.counts = {1: 400}
    return mcap.file()


def without_a_declared_size(count: int) -> bytes:
    compressor = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    return compressor.compress(zeros(count)) + compressor.flush()


def with_a_window_of(logarithm: int) -> bytes:
    """A frame of zstd that demands a window of 2^logarithm bytes, and has one byte, a thousand times."""
    return (
        b"\x28\xb5\x2f\xfd" + bytes([0x00, (logarithm - 10) << 3]) + struct.pack("<I", (1000 << 3) | 0b11)[:3] + b"\0"
    )


CHUNKS: dict[str, tuple[Callable[[], bytes], str]] = {
    "overlap": (chunks_that_overlap, "chunks overlap in time"),
    "repeated": (one_chunk_four_hundred_times, "its index lists bytes more than once"),
    "nested": (a_chunk_inside_a_chunk, "its index lists bytes more than once"),
    "many": (many_chunks, "its chunks yield"),
    "many without index": (lambda: many_chunks(has_index=False), "its chunks yield"),
    "many lz4": (lambda: many_chunks("lz4", count=50, size=4 * MIB), "50 left out"),
    "understated": (an_index_that_understates, "and the index 100; not opened"),
    "huge zstd": (lambda: one_chunk(zeros(1 << 28)), "beyond the limit of"),
    "huger zstd": (lambda: one_chunk(zeros(1 << 30)), "its chunks yield"),
    "huge lz4": (lambda: one_chunk(zeros(1 << 28), compression="lz4"), "beyond the limit of"),
    "huge without index": (lambda: one_chunk(zeros(1 << 28), has_index=False), "beyond the limit of"),
    "states less": (lambda: one_chunk(zeros(1 << 28), stated=1000), "has 1001 bytes after decompression"),
    "states more": (lambda: one_chunk(zeros(1000), stated=50 * MIB), "after decompression, and states"),
    "states 2^64": (lambda: one_chunk(zeros(1000), stated=2**64 - 1), "its chunks yield"),
    "lz4 states less": (lambda: one_chunk(zeros(1 << 28), compression="lz4", stated=9), "has 10 bytes after"),
    "long compression": (lambda: one_chunk(zeros(9), name="x" * 2**20), "is not supported"),
    "no declared size": (
        lambda: one_chunk(b"", compressed=without_a_declared_size(1 << 29), stated=99), "has 100 bytes after",
    ),
    "wide window": (lambda: one_chunk(b"", compressed=with_a_window_of(31), stated=1000), "does not decompress"),
    "many frames": (
        lambda: one_chunk(b"", compressed=zstandard.compress(bytes(8 * MIB)) * 500, stated=1000),
        "has 1001 bytes after",
    ),
    "not compressed": (lambda: one_chunk(zeros(100), stated=50 * MIB, compression=""), "and states"),
    "other compression": (lambda: one_chunk(zeros(9), name="x" * 9), "is not supported"),
}  # fmt: skip
