"""One MCAP file: its blocks of messages, opened one at a time. Nothing in the file is trusted.

The `mcap` package reads single records, and its `Summary` holds the index. Its readers are not used, with mcap 1.6.0
measured: 14 of the 40 hostile files in tests/logs take more memory or time of them than `files/budgets.py` allows, they
lose all messages of a file with one damaged chunk or one that breaks off, and a message takes 8 us, here 1 us.
"""

from __future__ import annotations

import os
import zlib
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Chunk, Metadata, MetadataIndex
from numpy.lib.stride_tricks import sliding_window_view

from gtsam_rwhec.errors import BudgetError, FileFormatError, LogError
from gtsam_rwhec.files.budgets import MIB, Spending
from gtsam_rwhec.files.whole_files import opened
from gtsam_rwhec.logs.mcap_index import (
    CHUNK_HEAD,
    FAULTS,
    FOOTER,
    MAGIC,
    RECORD,
    ChannelSpan,
    Descriptions,
    Parsed,
    parsed,
    read_index,
    records_in,
)

#: A message record begins with these fields.
_MESSAGE_HEAD = np.dtype([("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<u8"), ("publish_time", "<u8")])
#: A block of messages outside chunks has about this many bytes.
LOOSE_BLOCK = 4 * MIB
#: Bytes. zstd's decoder may need a window of this size for any content, and else one of the content's size.
_WINDOW = 8 * MIB


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
        read: Callable[[ReadDataStream], Parsed],
        opcode: int,
        places: Sequence[MetadataIndex] | Sequence[AttachmentIndex],
    ) -> Iterator[Parsed]:
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

    def _check_begins(self) -> None:
        first = self._read(0, len(MAGIC))
        if first != MAGIC:
            begins = f"begins with {first!r}" if first else "is empty"
            raise LogError(
                f"{self.path} is not an MCAP file (version 0): it {begins}. ROS 1 bags and db3 bags must be converted "
                "first: gtsam-rwhec convert."
            )

    def _find_blocks(self) -> None:
        self._check_begins()
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

    def _records(self, at: int = len(MAGIC)) -> Iterator[tuple[int, int, int]]:
        """The opcode, place and length of each record from a place on; the last one may not be whole."""
        while at + RECORD.size <= self.size:
            opcode, length = RECORD.unpack(self._read(at, RECORD.size))
            yield opcode, at, RECORD.size + length
            at += RECORD.size + length

    def _stated_size(self, at: int) -> int:
        """The size that a chunk states for its decompressed data; 0 if no chunk can be read there."""
        head = self._read(at, CHUNK_HEAD.size)
        return int(CHUNK_HEAD.unpack(head)[4]) if len(head) == CHUNK_HEAD.size else 0

    def _read_through(self) -> None:
        """Find the blocks of a file without an index, and the place where it ends or is damaged."""
        at, loose_at, is_cut = len(MAGIC), 0, False
        for opcode, begins, length in self._records():
            at = begins
            if opcode == Opcode.DATA_END or (opcode == Opcode.FOOTER and length == FOOTER.size):
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
        for opcode, start, end in records_in(data):
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


class GrowingFile(McapFile):
    """An MCAP file that is still being written; errors as of `McapFile`."""

    is_ended = False  #: whether all was read, and the file ends there as one that its recorder has closed
    _at = len(MAGIC)

    def new_blocks(self) -> Iterator[Block]:
        """What was written since it was asked last, as far as records are whole; `is_ended` at the file's end.

        A file that became shorter raises a LogError: another one took its place.
        """
        self.size = os.fstat(self._stream.fileno()).st_size
        self.spending = Spending(self.path, self.size)
        if (
            self.size < self._at
            or not self.path.exists()
            or not os.path.samestat(os.fstat(self._stream.fileno()), os.stat(self.path))
        ):
            raise LogError(f"{self.path}: another file took its place while it was read")
        for opcode, at, length in self._records(self._at):
            if at + length > self.size:
                return
            self._at, self.is_ended = at + length, opcode in (Opcode.DATA_END, Opcode.FOOTER)
            if self.is_ended:
                return
            if opcode in (Opcode.CHUNK, Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                yield Block(at, length, is_chunk=opcode == Opcode.CHUNK)

    def _find_blocks(self) -> None:
        self._check_begins()


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
