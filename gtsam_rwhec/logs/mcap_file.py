"""One MCAP file: its index, and its blocks of messages, opened one at a time. Nothing in the file is trusted.

The `mcap` package reads single records, and its `Summary` holds the index. Its readers are not used, with mcap 1.6.0
measured: 14 of the 40 hostile files in tests/logs take more memory or time of them than `files/budgets.py` allows, they
lose all messages of a file with one damaged chunk or one that breaks off, and a message takes 8 us, here 1 us.
"""

from __future__ import annotations

import io
import itertools
import os
import struct
import zlib
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO, TypeVar

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.summary import Summary
from numpy.lib.stride_tricks import sliding_window_view

from gtsam_rwhec.errors import BudgetError, FileFormatError, LogError
from gtsam_rwhec.files.budgets import CHANNELS, MIB, SCHEMAS, Spending
from gtsam_rwhec.files.whole_files import opened

MAGIC = b"\x89MCAP0\r\n"
#: Every record begins with its opcode and its length.
RECORD = struct.Struct("<BQ")
#: Reading a record raises these errors if the bytes are no record.
FAULTS = (McapError, struct.error, UnicodeDecodeError, ValueError, OverflowError)
_FOOTER = struct.Struct("<BQQQI")
#: A chunk's record begins with opcode, length, first and last log time, and the size that it states for its data.
_CHUNK_HEAD = struct.Struct("<BQQQQ")
#: The shortest record of a chunk has this number of bytes.
_SHORTEST_CHUNK = _CHUNK_HEAD.size + 4 + 4 + 8
#: A message record begins with these fields.
_MESSAGE_HEAD = np.dtype([("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<u8"), ("publish_time", "<u8")])
#: A block of messages outside chunks has about this many bytes.
LOOSE_BLOCK = 4 * MIB
#: Bytes. zstd's decoder may need a window of this size for any content, and else one of the content's size.
_WINDOW = 8 * MIB

#: Bytes of a file, by offset and length; fewer where the file ends.
Read = Callable[[int, int], bytes]
_Parsed = TypeVar("_Parsed")


def parsed(read: Callable[[ReadDataStream], _Parsed], content: bytes, begins: int = 0) -> _Parsed:
    """A record from its content; one of `FAULTS` if it is not one. No length in it leads beyond the content."""
    stream = io.BytesIO(content)
    stream.seek(begins)
    return read(ReadDataStream(stream))


@dataclass(frozen=True)
class Block:
    """The place of messages (a chunk's record, or records outside chunks), and their first and last log time.

    `is_cut` says that the file ends inside the chunk; `indexed_size` is the opened size that the index states.
    """

    offset: int
    length: int
    start_ns: int = 0
    end_ns: int = 0
    is_chunk: bool = True
    is_cut: bool = False
    indexed_size: int | None = None


@dataclass(frozen=True)
class Messages:
    """The messages of an opened block: message i is ``data[start[i]:end[i]]``.

    `heads` (N,) has each message's channel, sequence, log_time and publish_time.
    """

    data: bytes
    heads: np.ndarray
    start: array[int]
    end: array[int]


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
    twelve times the bytes of the index.

    Raises
    ------
    BudgetError
        It lists bytes of the file more than once, or its chunks yield more than a file of this size may.
    LogError, or one of `FAULTS`
        It is damaged.
    """
    footer_at = size - len(MAGIC) - _FOOTER.size
    if footer_at < len(MAGIC):
        return None
    opcode, length, start, _, _ = _FOOTER.unpack(read(footer_at, _FOOTER.size))
    if opcode != Opcode.FOOTER or length != _FOOTER.size - RECORD.size or not len(MAGIC) <= start < footer_at:
        return None
    data = read(start, footer_at - start)
    summary, descriptions, spans = Summary(), Descriptions(path), dict[int, ChannelSpan]()
    for opcode, begins, ends in _records_in(data):
        spending.take_parts(1)
        content = data[begins:ends]
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            descriptions.note(opcode, content)
        elif opcode == Opcode.STATISTICS:
            summary.statistics = parsed(Statistics.read, content)
        elif opcode == Opcode.CHUNK_INDEX:
            chunk = parsed(ChunkIndex.read, content)
            if chunk.chunk_length < _SHORTEST_CHUNK or chunk.message_start_time > chunk.message_end_time:
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


def _records_in(data: bytes) -> Iterator[tuple[int, int, int]]:
    """The opcode, and where the content begins and ends, of each record that is whole."""
    at = 0
    while at + RECORD.size <= len(data):
        opcode, length = RECORD.unpack_from(data, at)
        start = at + RECORD.size
        at = start + length
        if at > len(data):
            return
        yield opcode, start, at


class McapFile:
    """An MCAP file's schemas, channels and blocks.

    A file without an index, or with a wrong one, is gone through once from front to back; one that breaks off, as far
    as it goes. `losses` says what is missing. A file that cannot be opened or is not MCAP raises a LogError; one that
    asks for more than a file of its size may, a BudgetError.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.blocks: list[Block] = []
        self.spans: dict[int, ChannelSpan] = {}
        self.metadata_places: list[MetadataIndex] = []
        self.attachment_places: list[AttachmentIndex] = []
        self.losses: list[str] = []
        self._stream = self._opened()  # read from for as long as the object lives
        self.size = os.fstat(self._stream.fileno()).st_size
        self.spending = Spending(path, self.size)
        self._descriptions = Descriptions(path)
        try:
            self._find_blocks()
        except LogError:
            self.close()
            raise
        self.schemas, self.channels = self._descriptions.schemas, self._descriptions.channels  # by identifier

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def open(self, block: Block) -> Messages:
        """Read, check and decompress a block. A wrong compression, size or checksum raises a LogError."""
        data = self._chunk_data(block) if block.is_chunk else self._read(block.offset, block.length)
        return self._split(data, block.offset)

    def metadata(self) -> dict[str, dict[str, str]]:
        """The metadata records by name; the last record of a name counts. Damaged ones are left out."""
        found: dict[str, dict[str, str]] = {}
        for record in self._found(Metadata.read, Opcode.METADATA, self.metadata_places):
            self.spending.take_parts(len(record.metadata))
            found[record.name] = record.metadata
        return found

    def attachment(self, name: str) -> bytes | None:
        """The content that is attached under a name, or None if there is none; the last one counts."""
        places = [place for place in self.attachment_places if place.name in ("", name)]
        data = None
        for record in self._found(Attachment.read, Opcode.ATTACHMENT, places):
            data = record.data if record.name == name else data
        return data

    def _found(
        self,
        read: Callable[[ReadDataStream], _Parsed],
        opcode: int,
        places: Sequence[MetadataIndex] | Sequence[AttachmentIndex],
    ) -> Iterator[_Parsed]:
        """The records at some places; damaged ones are left out, as who needs what is not there says so."""
        with self._opened() as stream:  # opened anew: they may be asked for after the log is closed
            for place in places:
                record = self._read(place.offset, place.length, stream)
                try:
                    if record[:1] == bytes([opcode]):
                        yield parsed(read, record, RECORD.size)
                except FAULTS:
                    continue

    def _opened(self) -> BinaryIO:
        try:
            return opened(self.path)
        except FileFormatError as error:
            raise LogError(str(error)) from error

    def _read(self, offset: int, length: int, stream: BinaryIO | None = None) -> bytes:
        stream = self._stream if stream is None else stream
        try:
            stream.seek(offset)
            return stream.read(max(0, min(length, self.size - offset)))
        except OSError as error:
            raise LogError(f"{self.path}, byte {offset}: {error.strerror}") from error

    def _find_blocks(self) -> None:
        first = self._read(0, len(MAGIC))
        if first != MAGIC:
            begins = f"begins with {first!r}" if first else "is empty"
            raise LogError(
                f"{self.path} is not an MCAP file (version 0): it {begins}. ROS 1 bags and db3 bags must be converted "
                "first: gtsam-rwhec convert."
            )
        try:
            index = read_index(self._read, self.path, self.size, self.spending)
        except BudgetError:
            raise
        except FAULTS:
            index = None
        if index is not None:
            summary = index.summary
            self.blocks = [
                Block(
                    chunk.chunk_start_offset, chunk.chunk_length, chunk.message_start_time, chunk.message_end_time,
                    indexed_size=chunk.uncompressed_size,
                )
                for chunk in summary.chunk_indexes
            ]  # fmt: skip
            self._descriptions = index.descriptions
            self.metadata_places, self.attachment_places = summary.metadata_indexes, summary.attachment_indexes
            self.spans = index.spans
            return
        self.spending.begin_pass()
        chunks = [at for opcode, at, _ in self._records() if opcode == Opcode.CHUNK]
        self.spending.check_opened(sum(self._stated_size(at) for at in chunks))
        self._read_through()

    def _records(self) -> Iterator[tuple[int, int, int]]:
        """The opcode, place and length of each record, from front to back; the last one may not be whole."""
        at = len(MAGIC)
        while at + RECORD.size <= self.size:
            opcode, length = RECORD.unpack(self._read(at, RECORD.size))
            yield opcode, at, RECORD.size + length
            at += RECORD.size + length

    def _stated_size(self, at: int) -> int:
        """The size that a chunk states for its decompressed data; 0 if no chunk can be read there."""
        head = self._read(at, _CHUNK_HEAD.size)
        return int(_CHUNK_HEAD.unpack(head)[4]) if len(head) == _CHUNK_HEAD.size else 0

    def _read_through(self) -> None:
        """Find the blocks of a file without an index, and the place where it ends or is damaged."""
        at, loose_at, is_cut = len(MAGIC), 0, False
        for opcode, begins, length in self._records():
            at = begins
            if opcode == Opcode.DATA_END or (opcode == Opcode.FOOTER and length == _FOOTER.size):
                self._count_loose(loose_at, at)
                return
            if at + length > self.size:
                is_cut = opcode == Opcode.CHUNK
                break
            is_loose = opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)
            if is_loose and not loose_at:
                loose_at = at
            elif loose_at and (not is_loose or at - loose_at >= LOOSE_BLOCK):
                self._count_loose(loose_at, at)
                loose_at = at if is_loose else 0
            if opcode == Opcode.CHUNK:
                self._count(Block(at, length))
            elif opcode == Opcode.METADATA:
                self.metadata_places.append(MetadataIndex(length=length, name="", offset=at))
            elif opcode == Opcode.ATTACHMENT:
                self.attachment_places.append(AttachmentIndex(at, length, 0, 0, 0, "", ""))
            at += length
        self._count_loose(loose_at, at)
        saved = self._count(Block(at, self.size - at, is_cut=True)) if is_cut else 0
        self.losses.append(
            f"{self.path} ends too early, or is damaged, at byte {at} of {self.size}: the last {self.size - at} bytes "
            f"and all that should follow are lost, but for {saved} messages of the chunk that breaks off"
        )

    def _count_loose(self, start: int, end: int) -> None:
        if start:
            self._count(Block(start, end - start, is_chunk=False))

    def _count(self, block: Block) -> int:
        """Open a block once, for its schemas, channels, counts and span; return how many messages it has."""
        try:
            messages = self.open(block)
        except BudgetError:
            raise
        except LogError as error:
            self.losses.append(str(error))
            return 0
        log_time = messages.heads["log_time"]
        if not len(log_time):
            return 0
        order = np.argsort(messages.heads["channel"], kind="stable")
        channels, times = messages.heads["channel"][order], log_time[order]
        # All channels at once: a block may have thousands.
        firsts = np.flatnonzero(np.append(True, np.diff(channels) != 0))
        counts = np.diff(np.append(firsts, len(channels)))
        earliest, latest = np.minimum.reduceat(times, firsts), np.maximum.reduceat(times, firsts)
        columns = (channels[firsts], counts, earliest, latest)
        for channel, count, first_ns, last_ns in zip(*(column.tolist() for column in columns), strict=True):
            span = self.spans.setdefault(channel, ChannelSpan())
            span.count += count
            span.widen(first_ns, last_ns)
        self.blocks.append(replace(block, start_ns=int(log_time.min()), end_ns=int(log_time.max())))
        return len(log_time)

    def _chunk_data(self, block: Block) -> bytes:
        """The records in a chunk; of one that is cut, as many as there are. Nothing is opened beyond what is stated."""
        where, spending = f"{self.path}, chunk at byte {block.offset}", self.spending
        size = self._stated_size(block.offset)
        if size > spending.budget.chunk or block.length > spending.budget.chunk + MIB:
            raise LogError(
                f"{where}: {size} bytes when opened, beyond the limit of {spending.budget.chunk} for a log of "
                f"{spending.budget.size} bytes; not opened, and its messages are lost. If the log is honest, write it "
                "anew with smaller chunks (mcap compress --chunk-size)"
            )
        if block.indexed_size is not None and size > block.indexed_size:
            raise LogError(f"{where}: states {size} bytes when opened, and the index {block.indexed_size}; not opened")
        record = self._read(block.offset, block.length)
        try:
            opcode, length = RECORD.unpack_from(record)
            if opcode != Opcode.CHUNK or (RECORD.size + length != block.length and not block.is_cut):
                raise ValueError("another record")
            chunk = parsed(Chunk.read, record, RECORD.size)
        except FAULTS as error:
            raise LogError(f"{where}: no whole chunk is there ({error}); its messages are lost") from error
        if chunk.compression not in _DECOMPRESS:
            raise LogError(f"{where}: compression {chunk.compression[:32]!r} is not supported; its messages are lost")
        del record
        spending.take_opened(size)
        try:
            data = _DECOMPRESS[chunk.compression](chunk.data, size + 1)
        except (zstandard.ZstdError, RuntimeError, EOFError) as error:
            raise LogError(f"{where}: does not decompress ({error}); its messages are lost") from error
        if block.is_cut:
            return data
        if len(data) != size:
            raise LogError(
                f"{where}: has {len(data)} bytes after decompression, and states {size}; its messages are lost"
            )
        if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
            raise LogError(f"{where}: wrong checksum; its messages are lost")
        return data

    def _split(self, data: bytes, offset: int) -> Messages:
        starts, ends = array("Q"), array("Q")
        count, most, head_bytes = 0, self.spending.budget.parts, _MESSAGE_HEAD.itemsize
        for opcode, start, end in _records_in(data):
            count += 1
            if count > most:
                break
            if opcode == Opcode.MESSAGE and end - start >= head_bytes:
                starts.append(start + head_bytes)
                ends.append(end)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                try:
                    self._descriptions.note(opcode, data[start:end])
                except BudgetError:
                    raise
                except LogError as error:
                    raise LogError(f"{self.path}, byte {offset}: {error}") from error
        self.spending.take_parts(count)
        if not starts:
            return Messages(data, np.zeros(0, _MESSAGE_HEAD), starts, ends)
        windows = sliding_window_view(np.frombuffer(data, np.uint8), head_bytes)
        return Messages(data, windows[np.array(starts) - head_bytes].view(_MESSAGE_HEAD)[:, 0], starts, ends)


def _zstd(content: bytes, most: int) -> bytes:
    window = max(_WINDOW, 1 << (most - 1).bit_length())
    with zstandard.ZstdDecompressor(max_window_size=window).stream_reader(content, read_across_frames=True) as stream:
        return bytes(stream.read(most))


def _lz4(content: bytes, most: int) -> bytes:
    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(content, max_length=most))


#: By the name of the compression: from the content to at most this many bytes of data.
_DECOMPRESS: dict[str, Callable[[bytes, int], bytes]] = {
    "zstd": _zstd,
    "lz4": _lz4,
    "": lambda content, most: content,
    "none": lambda content, most: content,
}
