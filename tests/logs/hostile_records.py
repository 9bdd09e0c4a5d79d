"""Logs that were made to exhaust their reader, by records, index, chunks or messages, with the words of refusal."""

from __future__ import annotations

import struct
from collections.abc import Callable
from itertools import pairwise

import zstandard
from crafted_mcap import (
    ATTACHMENT,
    ATTACHMENT_INDEX,
    JSON_POSES,
    LITTLE_ENDIAN,
    MESSAGE_INDEX,
    METADATA,
    METADATA_INDEX,
    MIB,
    Mcap,
    cdr,
    channel,
    chunk,
    described,
    message,
    one_chunk,
    record,
    schema,
    text,
    zeros,
)
from log_files import definition, foxglove_protobuf

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


#: Each message has two lists of two of the next.
NESTED = "m/A a" + "".join(f"\n====\nMSG: m/{a}\n{b}[2] x\n{b}[2] y" for a, b in pairwise("ABCDEFGHIJKLMNO"))
NESTED += "\n====\nMSG: m/O\nuint8[0] z"
#: A message without fields, and one whose field has no bytes.
EMPTY = "\n====\nMSG: geometry_msgs/E\n"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"


def odd(fields: str) -> str:
    """The definition of a pose with other fields before it."""
    return f"{fields}\n{definition('geometry_msgs/PoseStamped')}"


def transforms_of_many_shapes() -> bytes:
    """Each message has another number of transforms, so each is walked over."""
    one = bytes(8) + text(b"a\0") + bytes(2) + text(b"b\0") + bytes(2) + bytes(7 * 8)
    messages = [message(1, LITTLE_ENDIAN + struct.pack("<I", n) + bytes(4) + one * n, n) for n in range(1, 800)]
    descriptions = schema(1, "tf2_msgs/msg/TFMessage", "ros2msg", definition("tf2_msgs/TFMessage").encode())
    return described(messages, descriptions + channel(1, 1, "/tf", "cdr"))


def long_strings_that_differ() -> bytes:
    texts = [f"{i:06}".encode() + b"x" * 60_000 + b"\0" for i in range(1000)]
    messages = [message(1, LITTLE_ENDIAN + bytes(8) + text(name) + bytes(64), i) for i, name in enumerate(texts)]
    descriptions = schema(1, POSE_STAMPED, "ros2msg", definition("geometry_msgs/PoseStamped").encode())
    return described(messages, descriptions + channel(1, 1, "/pose", "cdr"))


def json_message(content: bytes) -> bytes:
    return described([message(1, content)])


def protobuf(name: str, content: bytes, descriptors: bytes) -> bytes:
    descriptions = schema(1, name, "protobuf", descriptors) + channel(1, 1, "/a", "protobuf")
    return described([message(1, content)], descriptions)


def descriptors_of_poses() -> bytes:
    """foxglove.PosesInFrame, whose poses may be empty."""
    from google.protobuf import descriptor_pb2, timestamp_pb2

    files = descriptor_pb2.FileDescriptorSet()
    files.file.add().ParseFromString(timestamp_pb2.DESCRIPTOR.serialized_pb)
    foxglove_protobuf()["Pose"].DESCRIPTOR.file.CopyToProto(files.file.add())
    file = files.file.add(name="p.proto", package="foxglove", syntax="proto3")
    file.dependency.extend(["google/protobuf/timestamp.proto", "foxglove/Messages.proto"])
    poses = file.message_type.add(name="PosesInFrame")
    poses.field.add(name="timestamp", number=1, label=1, type=11, type_name=".google.protobuf.Timestamp")
    poses.field.add(name="frame_id", number=2, label=1, type=9)
    poses.field.add(name="poses", number=3, label=3, type=11, type_name=".foxglove.Pose")
    return files.SerializeToString()


def descriptors_without_end() -> bytes:
    from google.protobuf import descriptor_pb2

    files = descriptor_pb2.FileDescriptorSet()
    file = files.file.add(name="a.proto", package="foxglove", syntax="proto3")
    for i in range(20_000):
        file.message_type.add(name=f"M{i}")
    file.message_type.add(name="PosesInFrame")
    return files.SerializeToString()


MESSAGES: dict[str, tuple[Callable[[], bytes], str]] = {
    "string[]": (
        lambda: cdr(POSE_STAMPED, struct.pack("<I", 5 * MIB) + bytes(20 * MIB), odd("string[] s")),
        "a list of 5242880 string; at most 100000",
    ),
    "string[] that lies": (
        lambda: cdr(POSE_STAMPED, struct.pack("<I", 2**32 - 1), odd("string[] s")), "a list of 4294967295 string; at",
    ),
    "string of 4 GB": (lambda: cdr(POSE_STAMPED, b"\xff" * 4, odd("string s")), "ends after 8 bytes"),
    "empty messages": (
        lambda: cdr(POSE_STAMPED, struct.pack("<I", 20 * MIB) + bytes(20 * MIB), odd("E[] s") + EMPTY),
        "a list of 20971520 geometry_msgs/E; at most",
    ),
    "no bytes each": (
        lambda: cdr(POSE_STAMPED, struct.pack("<I", 2**31), odd("E[] s") + EMPTY + "uint8[0] z"),
        "a list of 2147483648 geometry_msgs/E; at most",
    ),
    "fixed list": (
        lambda: cdr(POSE_STAMPED, bytes(20 * MIB), odd("string[4999999] s")), "a list of 4999999 string; at most",
    ),
    "lists in lists": (lambda: cdr(POSE_STAMPED, bytes(MIB), NESTED), "a list of 2 m/O; at most 100000"),
    "itself": (lambda: cdr(POSE_STAMPED, bytes(99), "PoseStamped p"), "more than 16 deep"),
    "list of itself": (
        lambda: cdr(POSE_STAMPED, struct.pack("<I", 1) * 1000, "PoseStamped[] p"), "more than 16 deep",
    ),
    "transforms of many shapes": (transforms_of_many_shapes, "messages, records, numbers and strings"),
    "long strings": (long_strings_that_differ, "norm 0"),
    "deep JSON": (lambda: json_message(b"[" * 20 * MIB), "messages, records, numbers and strings"),
    "shorter JSON list": (lambda: json_message(b'{"a":[' + b"[]," * 60_000 + b"1]}"), "JSON of 120003 numbers"),
    "less deep JSON": (lambda: json_message(b"[" * 90_000), "not JSON: maximum recursion"),
    "long JSON list": (
        lambda: json_message(b'{"a":[' + b"[]," * 7 * MIB + b"1]}"), "messages, records, numbers and strings",
    ),
    "long JSON text": (lambda: json_message(b'{"a":"' + b"x" * 22 * MIB + "\U0001f600".encode() + b'"}'), "in memory"),
    "escaped JSON text": (lambda: json_message(b'{"a":"' + b"x" * 22 * MIB + rb'\ud83d\ude00"}'), "lacks a field"),
    "JSON message": (lambda: json_message(b'{"a":"' + b"x" * 50 * MIB + b'"}'), "a message of"),
    "long JSON number": (lambda: json_message(b'{"a":' + b"9" * 20 * MIB + b"}"), "not JSON: Exceeds the limit"),
    "empty poses of protobuf": (
        lambda: protobuf("foxglove.PosesInFrame", b"\x1a\x00" * 10 * MIB, descriptors_of_poses()), "with lists in them",
    ),
    "fewer empty poses of protobuf": (
        lambda: protobuf("foxglove.PosesInFrame", b"\x1a\x00" * 500_000, descriptors_of_poses()),
        "poses has 500000 entries",
    ),
    "types of protobuf": (
        lambda: protobuf("foxglove.PosesInFrame", b"", descriptors_without_end()), "they define 20001 types",
    ),
    "many messages with a list": (
        lambda: described([message(1, b'{"a":[' + b"1," * 90_000 + b"1]}", i) for i in range(300)]),
        "messages, records, numbers and strings",
    ),
}  # fmt: skip
