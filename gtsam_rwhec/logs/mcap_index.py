"""The index at the end of an MCAP file, and the schemas and channels that it describes. Nothing in it is trusted."""

from __future__ import annotations

import io
import itertools
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, ChunkIndex, MetadataIndex, Schema, Statistics
from mcap.summary import Summary

from gtsam_rwhec.errors import BudgetError, LogError
from gtsam_rwhec.files.budgets import CHANNELS, SCHEMAS, Spending

MAGIC = b"\x89MCAP0\r\n"
#: Every record begins with its opcode and its length.
RECORD = struct.Struct("<BQ")
#: Reading a record raises these errors if the bytes are no record.
FAULTS = (McapError, struct.error, UnicodeDecodeError, ValueError, OverflowError)
FOOTER = struct.Struct("<BQQQI")
#: A chunk's record begins with opcode, length, first and last log time, and the size that it states for its data.
CHUNK_HEAD = struct.Struct("<BQQQQ")
#: The shortest record of a chunk has this number of bytes.
SHORTEST_CHUNK = CHUNK_HEAD.size + 4 + 4 + 8
#: Bytes of a file, by offset and length; fewer where the file ends.
Read = Callable[[int, int], bytes]
Parsed = TypeVar("Parsed")


def parsed(read: Callable[[ReadDataStream], Parsed], content: bytes, begins: int = 0) -> Parsed:
    """A record from its content; one of `FAULTS` if it is not one. No length in it leads beyond the content."""
    stream = io.BytesIO(content)
    stream.seek(begins)
    return read(ReadDataStream(stream))


@dataclass
class ChannelSpan:
    """How many messages a channel has, and their first and last log time."""

    count: int = 0
    first_ns: int | None = None
    last_ns: int | None = None

    def widen(self, first_ns: int, last_ns: int) -> None:
        """Take a span of times."""
        self.first_ns = first_ns if self.first_ns is None else min(self.first_ns, first_ns)
        self.last_ns = last_ns if self.last_ns is None else max(self.last_ns, last_ns)


@dataclass
class Descriptions:
    """The schemas and channels of a file. An identifier that is described twice, differently, is refused."""

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    #: Each record that was noted, by opcode and identifier, and the bytes of all of an opcode.
    _noted: dict[tuple[int, int], bytes] = field(default_factory=dict)
    _bytes: dict[int, int] = field(default_factory=dict)

    def note(self, opcode: int, content: bytes) -> None:
        """Take a schema or a channel; a BudgetError if there are too many, a LogError if it is none."""
        key = opcode, int.from_bytes(content[:2], "little")
        before = self._noted.get(key)
        if before == content:
            return
        what, most = ("schema", SCHEMAS) if opcode == Opcode.SCHEMA else ("channel", CHANNELS)
        size = self._bytes.get(opcode, 0) + len(content)
        if size > most:
            raise BudgetError(
                f"{self.path}: its {what}s have more than {most} bytes. It is damaged, or made to exhaust who reads it."
            )
        try:
            made: Schema | Channel = parsed(Schema.read if opcode == Opcode.SCHEMA else Channel.read, content)
        except FAULTS as error:
            raise LogError(f"a {what} cannot be read: {error}") from error
        known: dict[int, Schema] | dict[int, Channel] = self.schemas if opcode == Opcode.SCHEMA else self.channels
        if before is None:
            self._noted[key], self._bytes[opcode] = content, size
            known[made.id] = made  # type: ignore[assignment]
        elif known[made.id] != made:  # entries of a channel may come in another order
            raise LogError(f"{what} {made.id} is described twice, and differently")


@dataclass(frozen=True)
class Index:
    """What the index at the end of a file says: mcap's `Summary`, and each channel's count and span of times."""

    summary: Summary
    descriptions: Descriptions
    spans: dict[int, ChannelSpan]


def read_index(read: Read, path: Path, size: int, spending: Spending, *, with_channels: bool = False) -> Index | None:
    """The index of a file of `size` bytes; None if there is none, or if the file does not bear it out.

    Only the footer and the index are read. Which channels a chunk has is kept with `with_channels` alone: they may take
    twelve times the bytes of the index. Raises `BudgetError` if it lists bytes of the file more than once, or its
    chunks yield more than a file of this size may; `LogError`, or one of `FAULTS`, if it is damaged.
    """
    footer_at = size - len(MAGIC) - FOOTER.size
    if footer_at < len(MAGIC):
        return None
    opcode, length, start, _, _ = FOOTER.unpack(read(footer_at, FOOTER.size))
    if opcode != Opcode.FOOTER or length != FOOTER.size - RECORD.size or not len(MAGIC) <= start < footer_at:
        return None
    data = read(start, footer_at - start)
    summary, descriptions, spans = Summary(), Descriptions(path), dict[int, ChannelSpan]()
    for opcode, begins, ends in records_in(data):
        spending.take_parts(1)
        content = data[begins:ends]
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            descriptions.note(opcode, content)
        elif opcode == Opcode.STATISTICS:
            summary.statistics = parsed(Statistics.read, content)
        elif opcode == Opcode.CHUNK_INDEX:
            chunk = parsed(ChunkIndex.read, content)
            if chunk.chunk_length < SHORTEST_CHUNK or chunk.message_start_time > chunk.message_end_time:
                return None
            # A channel's span is the span of its chunks: the indexes of single messages are not read.
            for channel in chunk.message_index_offsets:
                spans.setdefault(channel, ChannelSpan()).widen(chunk.message_start_time, chunk.message_end_time)
            summary.chunk_indexes.append(chunk if with_channels else replace(chunk, message_index_offsets={}))
        elif opcode == Opcode.METADATA_INDEX:
            summary.metadata_indexes.append(parsed(MetadataIndex.read, content))
        elif opcode == Opcode.ATTACHMENT_INDEX:
            summary.attachment_indexes.append(parsed(AttachmentIndex.read, content))
    summary.schemas, summary.channels = descriptions.schemas, descriptions.channels
    places = [(chunk.chunk_start_offset, chunk.chunk_length) for chunk in summary.chunk_indexes]
    places += [(metadata.offset, metadata.length) for metadata in summary.metadata_indexes]
    places += [(attachment.offset, attachment.length) for attachment in summary.attachment_indexes]
    are_inside = all(len(MAGIC) <= at <= start - length and length >= RECORD.size for at, length in places)
    if not are_inside or not _has_right_counts(summary, spending):
        return None
    for (at, length), (next_at, _) in itertools.pairwise(sorted(places)):
        if at + length > next_at:  # reading them each time would have no end
            raise BudgetError(
                f"{path}: its index lists bytes more than once: {length} bytes at byte {at}, and again at byte "
                f"{next_at}. It is damaged, or made to exhaust who reads it. mcap recover makes a new index."
            )
    spending.check_opened(sum(chunk.uncompressed_size for chunk in summary.chunk_indexes))
    assert summary.statistics is not None
    for channel, count in summary.statistics.channel_message_counts.items():
        spans.setdefault(channel, ChannelSpan()).count = count
    return Index(summary, descriptions, spans)


def _has_right_counts(summary: Summary, spending: Spending) -> bool:
    statistics = summary.statistics
    counts = {} if statistics is None else statistics.channel_message_counts
    return (
        statistics is not None
        and statistics.chunk_count == len(summary.chunk_indexes)
        and set(counts) <= set(summary.channels)
        and bool(summary.chunk_indexes or not statistics.message_count)
        and sum(counts.values()) <= spending.budget.parts
    )


def records_in(data: bytes) -> Iterator[tuple[int, int, int]]:
    """The opcode, and where the content begins and ends, of each record that is whole."""
    at = 0
    while at + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, at)
        start = at + RECORD.size
        at = start + length
        if at > len(data):
            return
        yield opcode, start, at
