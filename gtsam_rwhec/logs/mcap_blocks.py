"""The blocks of an MCAP file that hold messages: this module finds them, opens them and cuts them into messages.

The module trusts nothing in the file: it holds lengths against the file's size, decompresses up to a limit, and
compares checksums. It reads a file once from front to back where the file has no index or a wrong one. It reads a
truncated file as far as the file goes; `losses` says what is missing.

The `mcap` library reads single records. Finding, opening and cutting blocks stays here: the library is slower and loses
more messages of damaged files. Measured on 2026-11-21 with mcap 1.6.0 (tests/benchmarks/own_code_against_libraries.py):
a message takes 1.0 us, with mcap's reader 8 us. Of 20,000 messages in a file with one damaged chunk mcap's reader loses
all, this module 4,100. In a file that breaks off at 70 % the reader loses all, this module 3,600. mcap opens LZ4 chunks
without a limit on their size.
"""

from __future__ import annotations

import io
import struct
import zlib
from array import array
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Footer, McapRecord, Schema, Statistics
from mcap.stream_reader import StreamReader
from numpy.lib.stride_tricks import sliding_window_view

from gtsam_rwhec.errors import LogError

MAGIC = b"\x89MCAP0\r\n"
#: A chunk is opened only if it has at most this many bytes, both those that it states and those that it yields.
LARGEST_CHUNK = 1 << 29
#: A block of messages outside chunks has about this many bytes.
LOOSE_BLOCK = 1 << 22
#: Every record begins with its opcode and its length.
_RECORD = struct.Struct("<BQ")
#: A message record begins with these fields.
_HEAD = np.dtype([("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<u8"), ("publish_time", "<u8")])
_FOOTER_BYTES = _RECORD.size + 20
#: The readers of records raise these errors for bytes that are not a record.
_FAULTS = (McapError, struct.error, UnicodeDecodeError, ValueError, OverflowError)


@dataclass(frozen=True)
class Block:
    """The place of messages (the record of a chunk, or records outside chunks), and their first log time.

    `is_cut` says that the file ends inside the chunk.
    """

    offset: int
    length: int
    is_chunk: bool
    start_ns: int
    is_cut: bool = False


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
class Seen:
    """How many messages a channel has, and their first and last log time."""

    count: int = 0
    first_ns: int | None = None
    last_ns: int | None = None


@dataclass
class McapFile:
    """An MCAP file's schemas, channels and blocks. A file that cannot be opened or is not MCAP raises a LogError."""

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    blocks: list[Block] = field(default_factory=list)
    seen: dict[int, Seen] = field(default_factory=dict)
    losses: list[str] = field(default_factory=list)
    is_indexed: bool = False

    def __post_init__(self) -> None:
        try:
            self.size = self.path.stat().st_size
            self._stream = open(self.path, "rb")  # noqa: SIM115  (read from for as long as the object lives)
        except OSError as error:
            raise LogError(f"{self.path} cannot be read: {error.strerror}.") from error
        first = self._read(0, len(MAGIC))
        if first != MAGIC:
            self.close()
            begins = f"begins with {first!r}" if first else "is empty"
            raise LogError(
                f"{self.path} is not an MCAP file (version 0): it {begins}. ROS 1 bags and db3 bags must be converted "
                "first: gtsam-rwhec convert."
            )
        with suppress(*_FAULTS):
            self.is_indexed = self._read_summary()
        if not self.is_indexed:
            self.schemas, self.channels, self.blocks, self.seen = {}, {}, [], {}
            self._read_through()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def open(self, block: Block) -> Messages:
        """Read, check and decompress a block. A wrong compression, size or checksum raises a LogError."""
        raw = self._read(block.offset, block.length)
        return self._split(self._opened(raw, block) if block.is_chunk else raw, block.offset)

    def _read(self, offset: int, length: int) -> bytes:
        try:
            self._stream.seek(offset)
            return self._stream.read(length)
        except OSError as error:
            raise LogError(f"{self.path}, byte {offset}: {error.strerror}") from error

    def _read_summary(self) -> bool:
        """Take schemas, channels, chunks and counts from the index; return whether the index fits the file."""
        footer_at = self.size - len(MAGIC) - _FOOTER_BYTES
        if footer_at < len(MAGIC):
            return False
        footer = self._records(footer_at)[0]
        start = footer.summary_start if isinstance(footer, Footer) else 0
        if not len(MAGIC) <= start < footer_at:
            return False
        records = self._records(start)
        for record in records:
            self._note(record)
        statistics = next((record for record in records if isinstance(record, Statistics)), None)
        chunks = [record for record in records if isinstance(record, ChunkIndex)]
        if (
            statistics is None
            or statistics.chunk_count != len(chunks)
            or not set(statistics.channel_message_counts) <= set(self.channels)
            or (statistics.message_count and not chunks)
        ):
            return False
        self.seen = {channel: Seen(count) for channel, count in statistics.channel_message_counts.items()}
        for chunk in chunks:
            inside = len(MAGIC) <= chunk.chunk_start_offset <= start - chunk.chunk_length
            if not inside or chunk.message_start_time > chunk.message_end_time:
                return False
            self.blocks.append(Block(chunk.chunk_start_offset, chunk.chunk_length, True, chunk.message_start_time))
            # A channel's span is the span of its chunks: the indexes of single messages are not read.
            for channel in chunk.message_index_offsets:
                _widen(self.seen.setdefault(channel, Seen()), chunk.message_start_time, chunk.message_end_time)
        return True

    def _records(self, start: int) -> list[McapRecord]:
        """The records from a place in the file to its end. They come from memory: a wrong length allocates nothing."""
        stream = io.BytesIO(self._read(start, self.size - start))
        return list(StreamReader(stream, skip_magic=True, emit_chunks=True).records)

    def _note(self, record: McapRecord) -> None:
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, Channel):
            self.channels[record.id] = record

    def _read_through(self) -> None:
        """Find the blocks of a file without an index, and the place where it ends or is damaged."""
        at, loose_at, is_cut = len(MAGIC), 0, False
        while at + _RECORD.size <= self.size:
            opcode, length = _RECORD.unpack(self._read(at, _RECORD.size))
            whole = _RECORD.size + length
            if opcode == Opcode.DATA_END or (opcode == Opcode.FOOTER and length == 20):
                self._count_loose(loose_at, at)
                return
            if at + whole > self.size:
                is_cut = opcode == Opcode.CHUNK
                break
            is_loose = opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)
            if is_loose and not loose_at:
                loose_at = at
            elif loose_at and (not is_loose or at - loose_at >= LOOSE_BLOCK):
                self._count_loose(loose_at, at)
                loose_at = at if is_loose else 0
            if opcode == Opcode.CHUNK:
                self._count(Block(at, whole, True, 0))
            at += whole
        self._count_loose(loose_at, at)
        saved = self._count(Block(at, self.size - at, True, 0, is_cut=True)) if is_cut else 0
        self.losses.append(
            f"{self.path} ends too early, or is damaged, at byte {at} of {self.size}: the last {self.size - at} bytes "
            f"and all that should follow are lost, but for {saved} messages of the chunk that breaks off"
        )

    def _count_loose(self, start: int, end: int) -> None:
        if start:
            self._count(Block(start, end - start, False, 0))

    def _count(self, block: Block) -> int:
        """Open a block once, for its schemas, channels, counts and span; return how many messages it has."""
        try:
            messages = self.open(block)
        except LogError as error:
            self.losses.append(str(error))
            return 0
        channels, log_time = messages.heads["channel"], messages.heads["log_time"]
        for channel in np.unique(channels).tolist():
            times = log_time[channels == channel]
            seen = self.seen.setdefault(channel, Seen())
            seen.count += len(times)
            _widen(seen, int(times.min()), int(times.max()))
        if len(log_time):
            self.blocks.append(replace(block, start_ns=int(log_time.min())))
        return len(log_time)

    def _opened(self, raw: bytes, block: Block) -> bytes:
        """The records in a chunk. A chunk that is cut gives as many records as there are."""
        where = f"{self.path}, chunk at byte {block.offset}"
        stream = ReadDataStream(io.BytesIO(raw))
        try:
            opcode, length = _RECORD.unpack(stream.read(_RECORD.size))
            chunk = Chunk.read(stream)
        except _FAULTS as error:
            raise LogError(f"{where}: no chunk can be read there ({error}); its messages are lost") from error
        if opcode != Opcode.CHUNK or (_RECORD.size + length != len(raw) and not block.is_cut):
            raise LogError(f"{where}: no whole chunk is there; its messages are lost")
        size = chunk.uncompressed_size
        if size > LARGEST_CHUNK:
            raise LogError(f"{where}: {size} bytes when opened, beyond the limit of {LARGEST_CHUNK}; not opened")
        try:
            data = _decompressed(chunk)
        except (zstandard.ZstdError, RuntimeError, EOFError) as error:
            raise LogError(f"{where}: does not decompress ({error}); its messages are lost") from error
        except KeyError as error:
            raise LogError(f"{where}: compression {error} is not supported; its messages are lost") from error
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
        at = 0
        unpack, record_bytes, head_bytes = _RECORD.unpack_from, _RECORD.size, _HEAD.itemsize
        while at + record_bytes <= len(data):
            opcode, length = unpack(data, at)
            start = at + record_bytes
            at = start + length
            if at > len(data):
                break
            if opcode == Opcode.MESSAGE and length >= head_bytes:
                starts.append(start + head_bytes)
                ends.append(at)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                kind = Schema if opcode == Opcode.SCHEMA else Channel
                try:
                    self._note(kind.read(ReadDataStream(io.BytesIO(data[start:at]))))
                except _FAULTS as error:
                    what = f"a schema or channel cannot be read: {error}"
                    raise LogError(f"{self.path}, byte {offset}: {what}") from error
        if not starts:
            return Messages(data, np.zeros(0, _HEAD), starts, ends)
        windows = sliding_window_view(np.frombuffer(data, np.uint8), head_bytes)
        return Messages(data, windows[np.array(starts) - head_bytes].view(_HEAD)[:, 0], starts, ends)


def _decompressed(chunk: Chunk) -> bytes:
    """The chunk's data, which has at most one byte more than the chunk states."""
    most = chunk.uncompressed_size + 1
    if chunk.compression == "zstd":
        decompressor = zstandard.ZstdDecompressor(max_window_size=1 << 27)
        with decompressor.stream_reader(chunk.data, read_across_frames=True) as stream:
            return bytes(stream.read(most))
    if chunk.compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=most))
    return {"": chunk.data, "none": chunk.data}[chunk.compression]


def _widen(seen: Seen, first_ns: int, last_ns: int) -> None:
    seen.first_ns = first_ns if seen.first_ns is None else min(seen.first_ns, first_ns)
    seen.last_ns = last_ns if seen.last_ns is None else max(seen.last_ns, last_ns)
