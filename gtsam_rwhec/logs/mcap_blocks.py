"""The blocks of an MCAP file that hold messages: this module finds them, opens them and cuts them into messages.

The module trusts nothing in the file: it holds lengths against the file's size, decompresses up to a limit, and
compares checksums. It reads a file once from front to back where the file has no index or a wrong one. It reads a
truncated file as far as the file goes; `losses` says what is missing. ``files/budgets.py`` has the limits.

The `mcap` library reads single records. Finding, opening and cutting blocks stays here: the library is slower and loses
more messages of damaged files. Measured on 2026-11-21 with mcap 1.6.0 (benchmarks/own_code_against_libraries.py):
a message takes 1.0 us, with mcap's reader 8 us. Of 20,000 messages in a file with one damaged chunk mcap's reader loses
all, this module 4,100. In a file that breaks off at 70 % the reader loses all, this module 3,600. mcap opens LZ4 chunks
without a limit on their size.
"""

from __future__ import annotations

import os
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Schema
from numpy.lib.stride_tricks import sliding_window_view

from gtsam_rwhec.errors import BudgetError, FileFormatError, LogError
from gtsam_rwhec.files.budgets import Spending
from gtsam_rwhec.files.whole_files import opened
from gtsam_rwhec.logs.mcap_chunks import ChunkPlace, opened_chunk, stated_size
from gtsam_rwhec.logs.mcap_index import MAGIC, Extra, Seen, read_index
from gtsam_rwhec.logs.mcap_records import FAULTS, RECORD, Descriptions, entries_of, parsed

#: A block of messages outside chunks has about this many bytes.
LOOSE_BLOCK = 1 << 22
#: A message record begins with these fields.
_HEAD = np.dtype([("channel", "<u2"), ("sequence", "<u4"), ("log_time", "<u8"), ("publish_time", "<u8")])


@dataclass(frozen=True)
class Block:
    """The place of messages (the record of a chunk, or records outside chunks), and their first and last log time.

    `is_cut` says that the file ends inside the chunk; `indexed_size` is the opened size that the index states.
    """

    offset: int
    length: int
    is_chunk: bool
    start_ns: int
    is_cut: bool = False
    indexed_size: int | None = None
    end_ns: int = 0


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
class McapFile:
    """An MCAP file's schemas, channels and blocks.

    A file that cannot be opened or is not MCAP raises a LogError; one that asks for more than a file of its size may, a
    BudgetError.
    """

    path: Path
    blocks: list[Block] = field(default_factory=list)
    seen: dict[int, Seen] = field(default_factory=dict)
    extras: list[Extra] = field(default_factory=list)
    losses: list[str] = field(default_factory=list)
    is_indexed: bool = False

    def __post_init__(self) -> None:
        self._stream = self._opened_file()  # read from for as long as the object lives
        self.size = os.fstat(self._stream.fileno()).st_size
        self.spending = Spending(self.path, self.size)
        self._descriptions = Descriptions(self.path)
        try:
            self._find_blocks()
        except LogError:
            self.close()
            raise

    @property
    def schemas(self) -> dict[int, Schema]:
        """By identifier."""
        return self._descriptions.schemas

    @property
    def channels(self) -> dict[int, Channel]:
        """By identifier."""
        return self._descriptions.channels

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def open(self, block: Block) -> Messages:
        """Read, check and decompress a block. A wrong compression, size or checksum raises a LogError."""
        if not block.is_chunk:
            return self._split(self._read(block.offset, block.length), block.offset)
        place = ChunkPlace(block.offset, block.length, block.is_cut, block.indexed_size)
        where = f"{self.path}, chunk at byte {block.offset}"
        return self._split(opened_chunk(self._read, place, where, self.spending), block.offset)

    def metadata(self) -> dict[str, dict[str, str]]:
        """The metadata records by name; the last record of a name counts. Damaged ones are left out."""
        found: dict[str, dict[str, str]] = {}
        for _, content, name in self._extras(Opcode.METADATA):
            entries: dict[str, str] = {}
            try:
                for key, value in entries_of(content):
                    self.spending.take_parts(1)
                    entries[key] = value
                found[name or str(content[4 : 4 + int.from_bytes(content[:4], "little")], "utf-8")] = entries
            except BudgetError:
                raise
            except FAULTS:
                continue  # as for a damaged chunk, the rest counts; `read_metadata` misses what is not there
        return found

    def attachment(self, name: str) -> bytes | None:
        """The content that is attached under a name, or None if there is none; the last one counts."""
        data = None
        for _, content, named in self._extras(Opcode.ATTACHMENT):
            if named not in ("", name):
                continue
            try:
                attached = parsed(Attachment, content)
            except FAULTS:
                continue
            data = attached.data if attached.name == name else data
        return data

    def _extras(self, opcode: int) -> Iterator[tuple[int, bytes, str]]:
        # Opened anew: metadata may be asked for after the log is closed.
        with self._opened_file() as stream:
            for extra in self.extras:
                if extra.opcode == opcode:
                    record = self._read(extra.offset, extra.length, stream)
                    if len(record) >= RECORD.size and record[0] == opcode:
                        yield extra.offset, record[RECORD.size :], extra.name

    def _opened_file(self) -> BinaryIO:
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
            index = read_index(self._read, self.path, self.size, self._descriptions, self.spending)
        except BudgetError:
            raise
        except FAULTS:
            index = None
        if index is not None:
            self.blocks = [
                Block(offset, length, True, start_ns, indexed_size=size, end_ns=end_ns)
                for offset, length, start_ns, end_ns, size in index.chunks
            ]
            self.seen, self.extras, self.is_indexed = index.seen, index.extras, True
            return
        self._descriptions = Descriptions(self.path)
        self.spending.begin_pass()
        self.spending.check_opened(
            sum(stated_size(self._read, at) for opcode, at, _ in self._records() if opcode == Opcode.CHUNK)
        )
        self._read_through()

    def _records(self) -> Iterator[tuple[int, int, int]]:
        """The opcode, place and length of each record, from front to back; the last one may not be whole."""
        at = len(MAGIC)
        while at + RECORD.size <= self.size:
            opcode, length = RECORD.unpack(self._read(at, RECORD.size))
            yield opcode, at, RECORD.size + length
            at += RECORD.size + length

    def _read_through(self) -> None:
        """Find the blocks of a file without an index, and the place where it ends or is damaged."""
        at, loose_at, is_cut = len(MAGIC), 0, False
        for opcode, begins, whole in self._records():
            at, length = begins, whole - RECORD.size
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
            elif opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
                self.extras.append(Extra(opcode, at, whole, ""))
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
            seen = self.seen.setdefault(channel, Seen())
            seen.count += count
            seen.widen(first_ns, last_ns)
        self.blocks.append(replace(block, start_ns=int(log_time.min()), end_ns=int(log_time.max())))
        return len(log_time)

    def _split(self, data: bytes, offset: int) -> Messages:
        starts, ends = array("Q"), array("Q")
        at = count = 0
        unpack, record_bytes, head_bytes = RECORD.unpack_from, RECORD.size, _HEAD.itemsize
        most = self.spending.budget.parts
        while at + record_bytes <= len(data) and count <= most:
            opcode, length = unpack(data, at)
            start = at + record_bytes
            at = start + length
            count += 1
            if at > len(data):
                break
            if opcode == Opcode.MESSAGE and length >= head_bytes:
                starts.append(start + head_bytes)
                ends.append(at)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                try:
                    self._descriptions.note(opcode, data[start:at])
                except BudgetError:
                    raise
                except LogError as error:
                    raise LogError(f"{self.path}, byte {offset}: {error}") from error
        self.spending.take_parts(count)
        if not starts:
            return Messages(data, np.zeros(0, _HEAD), starts, ends)
        windows = sliding_window_view(np.frombuffer(data, np.uint8), head_bytes)
        return Messages(data, windows[np.array(starts) - head_bytes].view(_HEAD)[:, 0], starts, ends)
