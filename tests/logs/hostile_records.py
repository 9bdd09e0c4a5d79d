"""Logs whose records or index were made to exhaust their reader, each with the words of its refusal."""

from __future__ import annotations

import struct
from collections.abc import Callable

from crafted_logs import JSON_POSES, MIB, one_chunk
from crafted_mcap import (
    ATTACHMENT,
    ATTACHMENT_INDEX,
    MESSAGE_INDEX,
    METADATA,
    METADATA_INDEX,
    Mcap,
    channel,
    chunk,
    message,
    record,
    schema,
    text,
)
from log_files import definition

# Records


def records_of_nothing(opcode: int, content: bytes = b"", size: int = 50 * MIB, *, has_index: bool = True) -> bytes:
    one = record(opcode, content)
    return one_chunk(one * (size // len(one)), has_index=has_index)


def channels_without_end(count: int, definition_bytes: int) -> bytes:
    """Channels that share one schema of many lines, with one message each."""
    mcap = Mcap()
    lines = (definition("geometry_msgs/PoseStamped") + "\n====\nMSG: x/Y\n").encode() + b"bool b\n" * (
        definition_bytes // 7
    )
    mcap.describe(schema(1, "geometry_msgs/msg/PoseStamped", "ros2msg", lines))
    for i in range(count):
        mcap.describe(channel(i, 1, f"/{i}", "cdr"))
    data = b"".join(message(i, b"") for i in range(count))
    mcap.counts = dict.fromkeys(range(count), 1)
    mcap.add_chunk(chunk(data), len(data))
    return mcap.file(has_index=False)


def schemas_without_end() -> bytes:
    """Each of them must be read, since a channel uses it."""
    mcap = Mcap()
    lines = definition("geometry_msgs/PoseStamped").encode() + b"\n====\nMSG: x/Y\n" + b"bool b\n" * 50_000
    for i in range(1, 40):
        described_ = schema(i, "geometry_msgs/msg/PoseStamped", "ros2msg", lines) + channel(i, i, f"/{i}", "cdr")
        mcap.add(chunk(described_ + message(i, b"")))
    return mcap.file(has_index=False)


def a_channel_with_entries(count: int) -> bytes:
    entries = b"".join(text(f"{i}") + text("") for i in range(count))
    return one_chunk(channel(9, 1, "/x", "json", entries), has_index=False)


def a_channel_that_changes() -> bytes:
    mcap = Mcap()
    mcap.describe(JSON_POSES)
    data = message(1, b"{}") + channel(1, 1, "/other", "json") + message(1, b"{}")
    mcap.add_chunk(chunk(data), len(data))
    mcap.counts = {1: 2}
    return mcap.file()


def a_chunk_of_channels() -> bytes:
    """65,536 channels, one message each, none described."""
    data = b"".join(message(i, b"") for i in range(1 << 16))
    return one_chunk(data, has_index=False)


RECORDS: dict[str, tuple[Callable[[], bytes], str]] = {
    "empty records": (lambda: records_of_nothing(200), "messages, records, numbers and strings"),
    "empty records without index": (lambda: records_of_nothing(200, has_index=False), "messages, records"),
    "empty messages": (lambda: records_of_nothing(5, bytes(22)), "messages, records, numbers and strings"),
    "channels of one schema": (lambda: channels_without_end(20_000, 400_000), "not CDR"),
    "long definition": (lambda: channels_without_end(1, 1_000_000), "beyond the limit of"),
    "schemas": (schemas_without_end, "the definitions of its messages have more than"),
    "one large schema": (
        lambda: one_chunk(schema(7, "x", "", bytes(50 * MIB)), has_index=False), "its schemas have more than",
    ),
    "entries of a channel": (lambda: a_channel_with_entries(1_000_000), "its channels have more than"),
    "channel twice": (a_channel_that_changes, "channel 1 is described twice, and differently"),
    "channels not described": (a_chunk_of_channels, "is not described in the file"),
    "schema with a long string": (
        lambda: one_chunk(record(3, b"\1\0" + struct.pack("<I", 2**32 - 1) + b"abc"), has_index=False),
        "cannot be read",
    ),
}  # fmt: skip


# The index


def indexed(*entries: bytes, counts: dict[int, int] | None = None, before: bytes = b"") -> bytes:
    mcap = Mcap()
    mcap.describe(JSON_POSES)
    if before:
        mcap.add(before)
    mcap.index += b"".join(entries)
    mcap.counts = counts or {}
    data = message(1, b"{}")
    mcap.add_chunk(chunk(data), len(data))
    return mcap.file()


def metadata_listed(times: int, entries: int) -> bytes:
    mcap = Mcap()
    pairs = b"".join(text(f"{i}") + text("") for i in range(entries))
    content = record(METADATA, text("x") + text(pairs))
    at = mcap.add(content)
    for _ in range(times):
        mcap.index += record(METADATA_INDEX, struct.pack("<QQ", at, len(content)) + text("x"))
    return mcap.file()


def attachment_that_lies() -> bytes:
    mcap = Mcap()
    content = record(METADATA, text("x") + text(b""))
    at = mcap.add(content)
    mcap.index += record(METADATA_INDEX, struct.pack("<QQ", at, len(content)) + text("x"))
    content = record(ATTACHMENT, bytes(16) + text("x") + text("") + struct.pack("<Q", 1 << 62) + b"abc")
    at = mcap.add(content)
    mcap.index += record(ATTACHMENT_INDEX, struct.pack("<QQQQQ", at, len(content), 0, 0, 9) + text("x") + text(""))
    return mcap.file()


def a_long_index_of_messages() -> bytes:
    """The index begins in the data, where there are millions of entries that nobody needs."""
    mcap = Mcap()
    at = mcap.add(record(MESSAGE_INDEX, struct.pack("<H", 1) + text(bytes(16 * 500_000))))
    mcap.describe(JSON_POSES)
    return mcap.file(summary_start=at)


def offsets_without_end() -> bytes:
    mcap = Mcap()
    mcap.describe(JSON_POSES)
    data = message(1, b"{}")
    for _ in range(3):
        at = mcap.add(chunk(data))
        mcap.list_chunk(at, len(mcap.data) - at, len(data), offsets=range(1 << 16))
    mcap.counts = {1: 3}
    return mcap.file()


INDEX: dict[str, tuple[Callable[[], bytes], str]] = {
    "counts of 2^63": (lambda: indexed(counts={1: 2**63}), "1 left out"),
    "metadata listed often": (lambda: metadata_listed(2_000, 10_000), "its index lists bytes more than once"),
    "entries of metadata": (lambda: metadata_listed(1, 200_000), "", ),
    "attachment of 2^62": (attachment_that_lies, ""),
    "index of messages": (a_long_index_of_messages, ""),
    "offsets of chunks": (offsets_without_end, ""),
    "chunk of no bytes": (lambda: indexed(chunk_listed(8, 0)), "1 left out"),
    "chunk outside": (lambda: indexed(chunk_listed(1 << 60, 1 << 60)), "1 left out"),
}  # fmt: skip


def chunk_listed(at: int, length: int) -> bytes:
    mcap = Mcap()
    mcap.list_chunk(at, length)
    return bytes(mcap.index)
