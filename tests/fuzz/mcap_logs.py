"""MCAP files: changes inside chunks too, with sizes, checksums and the index made anew so that they are read."""

from __future__ import annotations

import json
import random
import struct
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard
from harness import Harness, scratch
from log_files import POSE, header, json_log, ros2_log
from mcap.writer import CompressionType
from mutations import json_tree, numbers_in_bytes
from seed_messages import FOXGLOVE, ROS2, T0

from gtsam_rwhec.logs import mcap_reader, mcap_writer

FOLDER = scratch()
MAGIC = b"\x89MCAP0\r\n"
FOOTER, MESSAGE, CHUNK, CHUNK_INDEX, DATA_END = 0x02, 0x05, 0x06, 0x08, 0x0F
#: Where a chunk's own fields end and the name of its compression begins.
CHUNK_HEAD = 8 + 8 + 8 + 4


@dataclass
class Part:
    """A record; a chunk's `inside` are the records in it, if they could be read."""

    code: int
    body: bytes
    inside: list[Part] | None = None
    compression: bytes = b""


def read(data: bytes) -> None:
    """All that a log can be asked."""
    path = FOLDER / "fuzzed.mcap"
    path.write_bytes(data)
    with mcap_reader.open_log(path) as log:
        str(log.topics())
        log.topics_in_words()
        log.metadata()
        log.attachment("result.json")
        for record in log.records():
            str(record)
        for topic in log.topics()[:3]:
            if not topic.unreadable:
                log.poses(topic.name)


def records_in(data: bytes) -> list[Part]:
    """The records as far as they can be cut."""
    found, at = [], 0
    while at + 9 <= len(data):
        code, length = struct.unpack_from("<BQ", data, at)
        found.append(Part(code, data[at + 9 : at + 9 + length]))
        at += 9 + length
    return found


def opened(part: Part) -> Part:
    """A chunk with what is in it, or the record as it is."""
    if part.code != CHUNK or len(part.body) < CHUNK_HEAD + 12:
        return part
    (length,) = struct.unpack_from("<I", part.body, CHUNK_HEAD)
    name = part.body[CHUNK_HEAD + 4 : CHUNK_HEAD + 4 + length]
    packed = part.body[CHUNK_HEAD + 4 + length + 8 :]
    try:
        if name == b"zstd":
            packed = zstandard.ZstdDecompressor().decompressobj().decompress(packed)
        elif name == b"lz4":
            packed = lz4.frame.decompress(packed)
    except (zstandard.ZstdError, RuntimeError):
        return part
    return Part(part.code, part.body, records_in(packed), name)


def joined(parts: Iterable[Part]) -> bytes:
    """The bytes of records."""
    return b"".join(struct.pack("<BQ", part.code, len(part.body)) + part.body for part in parts)


def closed(part: Part) -> Part:
    """A chunk's record, with size and checksum of what is in it now."""
    if part.inside is None:
        return part
    data = joined(part.inside)
    packed = data
    if part.compression == b"zstd":
        packed = zstandard.ZstdCompressor(level=1).compress(data)
    elif part.compression == b"lz4":
        packed = lz4.frame.compress(data)
    head = part.body[:16] + struct.pack("<QI", len(data), zlib.crc32(data))
    name = struct.pack("<I", len(part.compression)) + part.compression
    return Part(CHUNK, head + name + struct.pack("<Q", len(packed)) + packed)


def with_index(parts: list[Part]) -> bytes:
    """The file, its index pointing to where the chunks are now."""
    out, places, summary = bytearray(MAGIC), [], 0
    for part in parts:
        body = part.body
        if part.code == CHUNK:
            places.append((len(out), 9 + len(body), body[16:24]))
        elif part.code == CHUNK_INDEX and places and len(body) >= 32:
            at, length, opened_size = places.pop(0)
            body = body[:16] + struct.pack("<QQ", at, length) + body[32:-8] + opened_size
        elif part.code == FOOTER and len(body) >= 8:
            body = struct.pack("<Q", summary) + body[8:]
        out += struct.pack("<BQ", part.code, len(body)) + body
        if part.code == DATA_END:
            summary = len(out)
    return bytes(out + MAGIC)


def _changed(part: Part, chance: random.Random, plain: Callable[[bytes], bytes]) -> Part:
    if part.code == MESSAGE and part.body[22:23] == b"{" and chance.random() < 0.5:
        return Part(part.code, part.body[:22] + json_tree(part.body[22:], chance, plain))
    if chance.random() < 0.03:
        return Part(chance.randrange(1, 16), part.body)
    return Part(part.code, numbers_in_bytes(part.body, chance, plain))


def mutate(data: bytes, chance: random.Random, plain: Callable[[bytes], bytes]) -> bytes:
    """Change, double, drop or move records of the file or of one chunk."""
    if chance.random() < 0.15 or len(data) > 100_000:
        return plain(data)
    parts = [opened(part) for part in records_in(data.removeprefix(MAGIC).removesuffix(MAGIC))]
    if not parts:
        return plain(data)
    for _ in range(chance.choice((1, 1, 2, 4))):
        lists = [parts, *[part.inside for part in parts if part.inside]]
        records = chance.choice(lists)
        if not records:
            continue
        at = chance.randrange(len(records))
        kind = chance.randrange(12)
        if kind == 0:
            del records[at]
        elif kind == 1:
            records.insert(chance.randrange(len(records) + 1), records[at])
        elif kind == 2:
            other = chance.randrange(len(records))
            records[at], records[other] = records[other], records[at]
        elif kind == 3 and records[at].inside is not None:
            records[at].compression = chance.choice((b"", b"zstd", b"lz4", b"none", b"bz2"))
        elif kind == 4:
            records[at:at] = [records[at]] * chance.choice((2, 10, 100))
        else:
            if records[at].inside is not None:
                continue
            records[at] = _changed(records[at], chance, plain)
    if not parts:
        return plain(data)
    parts = [closed(part) for part in parts]
    return with_index(parts) if chance.random() < 0.8 else MAGIC + joined(parts) + MAGIC


def seeds() -> Iterable[bytes]:
    """Logs of ROS 2 and Foxglove: with and without chunks, index, compression; with metadata and attachments."""
    ros2: list[Any] = [(f"/{i}", name, message, T0 + i) for i, (name, message) in enumerate(ROS2.items())]
    foxglove: list[Any] = [(f"/{i}", name, message, T0 + i) for i, (name, message) in enumerate(FOXGLOVE.items())]
    poses: list[Any] = [
        ("/pose", "geometry_msgs/PoseStamped", {"header": header(T0 + i), "pose": POSE}, T0 - i) for i in range(6)
    ]
    path = FOLDER / "seed.mcap"

    def content(path: Path) -> bytes:
        return path.read_bytes()

    yield content(ros2_log(path, poses, CompressionType.ZSTD, chunk_size=300))
    yield content(ros2_log(path, poses, CompressionType.NONE, chunk_size=300, enable_crcs=False))
    for some in (ros2[:4], ros2[4:8], ros2[8:]):
        yield content(ros2_log(path, some, CompressionType.LZ4))
    yield content(json_log(path, foxglove, compression=CompressionType.NONE))
    yield content(json_log(path, foxglove[:3], use_chunking=False))
    yield content(json_log(path, foxglove[:3], chunk_size=100, use_statistics=False))
    with mcap_writer.LogWriter(path) as out:
        out.metadata("certificate", {"gap": "1e-9"})
        out.attachment("result.json", "application/json", json.dumps({}).encode())
    yield content(path)


HARNESS = Harness(read, seeds, mutate)
