"""ROS 1 bags held against their budget before the `rosbags` library reads them.

The library follows every place and count that a bag states, and decompresses without a limit. This module goes through
the file once: records lie one behind the other, the index lists each chunk once and points to records, and chunks yield
what they state.
"""

from __future__ import annotations

import bz2
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import numpy as np

from gtsam_rwhec.errors import BudgetError, LogError
from gtsam_rwhec.files.budgets import BZ2_BYTES, Spending
from gtsam_rwhec.logs.bag_definitions import check_definitions

_MAGIC = b"#ROSBAG V2.0\n"
_LENGTH = struct.Struct("<I")
#: What the field ``op`` of a record says.
_MESSAGE, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = b"\2", b"\4", b"\5", b"\6", b"\7"
#: Bytes. The fields of a record, without its data, have at most this much.
_LONGEST_HEADER = 1 << 16
#: Connections that stand in a chunk between a message and the place that the index has for it.
_MOST_BETWEEN = 16
#: An index has 12 bytes for each message: seconds, nanoseconds, and the place in the opened chunk.
_ENTRY = np.dtype([("seconds", "<u4"), ("nanoseconds", "<u4"), ("place", "<u4")])
_FAULTS = (struct.error, ValueError, OverflowError)


@dataclass
class _Chunk:
    """A chunk: its number in the file, the size that it states, and the places in it that an index may have."""

    number: int
    size: int
    places: set[int]


@dataclass(frozen=True)
class _Record:
    """A record: where it begins in the file, its fields, and where its data are and how long."""

    begin: int
    fields: dict[bytes, bytes]
    at: int
    length: int


@dataclass
class _Seen:
    """What went by: chunks by their place in the file, times and chunks of messages, definitions."""

    chunks: dict[int, _Chunk] = field(default_factory=dict)
    times: list[np.ndarray] = field(default_factory=list)
    numbers: list[np.ndarray] = field(default_factory=list)
    definitions: list[str] = field(default_factory=list)
    listed: set[int] = field(default_factory=set)


def check_ros1_bag(path: Path) -> None:
    """Refuse a bag that asks for more memory or work than one of its size may.

    Raises
    ------
    BudgetError
        It does: its chunks yield too much, its index lists a chunk twice, its definitions are too long.
    LogError
        It cannot be read, or is damaged.
    """
    try:
        with open(path, "rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            spending = Spending(path, size)
            seen = _Seen()
            if stream.read(len(_MAGIC)) != _MAGIC:
                return  # `rosbags` says what it is
            for record in _records(stream, len(_MAGIC), size):
                spending.take_parts(1)
                _note(stream, record, seen, spending)
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror}.") from error
    except BudgetError:
        raise
    except _FAULTS as error:
        raise LogError(f"{path} cannot be read as a ROS bag: {error}") from error
    check_definitions(seen.definitions, path, size)
    _check_order(seen, spending)


def _records(stream: BinaryIO, at: int, end: int) -> Iterator[_Record]:
    """One record after another; none leads beyond the end."""
    while at < end:
        begin = at
        stream.seek(at)
        (length,) = _LENGTH.unpack(stream.read(_LENGTH.size))
        at += 2 * _LENGTH.size + length
        if length > _LONGEST_HEADER or at > end:
            raise ValueError(f"a record at byte {begin} of {end} states {length} bytes of fields")
        fields = _fields(stream.read(length))
        (size,) = _LENGTH.unpack(stream.read(_LENGTH.size))
        if at + size > end:
            raise ValueError(f"a record at byte {begin} of {end} states {size} bytes of data")
        yield _Record(begin, fields, at, size)
        at += size


def _fields(content: bytes) -> dict[bytes, bytes]:
    found, at = {}, 0
    while at < len(content):
        (length,) = _LENGTH.unpack_from(content, at)
        at += _LENGTH.size
        if at + length > len(content):
            raise ValueError("a field is longer than its record")
        name, _, value = content[at : at + length].partition(b"=")
        found[name] = value
        at += length
    return found


def _note(stream: BinaryIO, record: _Record, seen: _Seen, spending: Spending) -> None:
    fields, at, length = record.fields, record.at, record.length
    kind = fields.get(b"op", b"\0")[:1]
    if kind == _CHUNK:
        stream.seek(at)
        (size,) = _LENGTH.unpack(fields[b"size"]) if b"size" in fields else (0,)
        places = _places(_opened(stream.read(length), fields.get(b"compression", b""), size, spending), spending)
        seen.chunks[record.begin] = _Chunk(len(seen.chunks), size, places)
    elif kind == _INDEX and seen.chunks:
        stream.seek(at)
        entries = np.frombuffer(stream.read(length - length % _ENTRY.itemsize), _ENTRY)
        spending.take_parts(len(entries))
        chunk = list(seen.chunks.values())[-1]
        if not chunk.places.issuperset(entries["place"].tolist()):
            raise ValueError(f"the index at byte {at} has places where no message is")
        seen.times.append(entries["seconds"].astype(np.int64) * 10**9 + entries["nanoseconds"])
        seen.numbers.append(np.full(len(entries), chunk.number))
    elif kind == _CHUNK_INFO:
        place = int.from_bytes(fields.get(b"chunk_pos", b""), "little")
        if place in seen.listed:
            raise BudgetError(f"{spending.path}: its index lists the chunk at byte {place} more than once.")
        if place not in seen.chunks:
            raise ValueError(f"the index lists a chunk at byte {place}, where none is")
        seen.listed.add(place)
    elif kind == _CONNECTION:
        stream.seek(at)
        seen.definitions.append(_fields(stream.read(length)).get(b"message_definition", b"").decode(errors="replace"))


def _opened(content: bytes, compression: bytes, size: int, spending: Spending) -> bytes:
    """A chunk's data, if they are as long as the chunk states."""
    if compression == b"none":
        return content
    open_ = _DECOMPRESS.get(compression)
    if open_ is None:
        raise ValueError(f"compression {compression[:20]!r} is not supported")
    if size > spending.budget.bag_chunk:
        raise BudgetError(
            f"{spending.path}: a chunk yields {size} bytes, beyond the limit of {spending.budget.bag_chunk} for a bag "
            f"of {spending.budget.size} bytes."
        )
    spending.take_opened(size * (BZ2_BYTES if compression == b"bz2" else 1))
    try:
        data = open_(content, size + 1)
    except (OSError, RuntimeError, EOFError) as error:
        raise ValueError(f"a chunk does not decompress: {error}") from error
    if len(data) != size:
        raise ValueError(f"a chunk has {len(data)} bytes or more after decompression, and states {size}")
    return data


def _places(data: bytes, spending: Spending) -> set[int]:
    """Where messages are in an opened chunk, and the few connections before each."""
    places: set[int] = set()
    at = between = 0
    waiting: list[int] = []
    while at + _LENGTH.size <= len(data):
        (length,) = _LENGTH.unpack_from(data, at)
        fields = at + _LENGTH.size
        if fields + length + _LENGTH.size > len(data) or length > _LONGEST_HEADER:
            raise ValueError("a record in a chunk is longer than the chunk")
        kind = _fields(data[fields : fields + length]).get(b"op", b"")
        waiting.append(at)
        if kind == _MESSAGE:
            places.update(waiting[-_MOST_BETWEEN:])
            waiting.clear()
        (size,) = _LENGTH.unpack_from(data, fields + length)
        at = fields + length + _LENGTH.size + size
        between += 1
        if between % 1000 == 0:
            spending.take_parts(1000)
    spending.take_parts(between % 1000)
    return places


def _check_order(seen: _Seen, spending: Spending) -> None:
    """Hold against the budget how often chunks are opened: messages are read by time, and one chunk is open at once."""
    if not seen.times:
        return
    numbers = np.concatenate(seen.numbers)[np.argsort(np.concatenate(seen.times), kind="stable")]
    sizes = np.array([chunk.size for chunk in seen.chunks.values()], dtype=np.int64)
    changes = np.append(True, np.diff(numbers) != 0)
    spending.check_opened(int(sizes[numbers[changes]].sum()))


_DECOMPRESS: dict[bytes, Callable[[bytes, int], bytes]] = {
    b"bz2": lambda content, most: bz2.BZ2Decompressor().decompress(content, max_length=most),
    b"lz4": lambda content, most: bytes(lz4.frame.LZ4FrameDecompressor().decompress(content, max_length=most)),
}
