"""The index at the end of an MCAP file: its chunks, counts, metadata and attachments.

The index is believed only where the file bears it out: what it lists lies inside the file, in order, and nothing twice.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, ChunkIndex, MetadataIndex, Statistics

from gtsam_rwhec.errors import BudgetError
from gtsam_rwhec.files.budgets import Spending
from gtsam_rwhec.logs.mcap_chunks import LEAST_BYTES
from gtsam_rwhec.logs.mcap_records import RECORD, Descriptions, parsed, records_in

MAGIC = b"\x89MCAP0\r\n"
_FOOTER = struct.Struct("<BQQQI")


@dataclass
class Seen:
    """How many messages a channel has, and their first and last log time."""

    count: int = 0
    first_ns: int | None = None
    last_ns: int | None = None

    def widen(self, first_ns: int, last_ns: int) -> None:
        """Take a span of times."""
        self.first_ns = first_ns if self.first_ns is None else min(self.first_ns, first_ns)
        self.last_ns = last_ns if self.last_ns is None else max(self.last_ns, last_ns)


@dataclass(frozen=True)
class Extra:
    """Where a metadata record or an attachment is, and its name; the name is empty where no index tells it."""

    opcode: int
    offset: int
    length: int
    name: str


@dataclass
class Index:
    """What the index says: spans by channel, extras, chunks (offset, length, first and last log time, opened size)."""

    chunks: list[tuple[int, int, int, int, int]] = field(default_factory=list)
    seen: dict[int, Seen] = field(default_factory=dict)
    extras: list[Extra] = field(default_factory=list)


def read_index(
    read: Callable[[int, int], bytes], path: Path, size: int, descriptions: Descriptions, spending: Spending
) -> Index | None:
    """The index of a file of `size` bytes; None if there is none, or if it does not fit the file.

    Damage may raise one of ``mcap_records.FAULTS``. A BudgetError says that it lists bytes of the file more than once,
    or that its chunks yield more than a file of this size may.
    """
    footer_at = size - len(MAGIC) - _FOOTER.size
    if footer_at < len(MAGIC):
        return None
    opcode, length, start, _, _ = _FOOTER.unpack(read(footer_at, _FOOTER.size))
    if opcode != Opcode.FOOTER or length != _FOOTER.size - RECORD.size or not len(MAGIC) <= start < footer_at:
        return None
    data = read(start, footer_at - start)
    index, statistics, opened = Index(), None, 0
    # One record after another, and what is not needed is not kept: a list of them takes many times the file's bytes.
    for opcode, begins, ends in records_in(data):
        spending.take_parts(1)
        content = data[begins:ends]
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            descriptions.note(opcode, content)
        elif opcode == Opcode.STATISTICS:
            statistics = parsed(Statistics, content)
        elif opcode == Opcode.CHUNK_INDEX:
            chunk = parsed(ChunkIndex, content)
            span = chunk.message_start_time, chunk.message_end_time
            place = chunk.chunk_start_offset, chunk.chunk_length, *span, chunk.uncompressed_size
            if chunk.chunk_length < LEAST_BYTES or chunk.message_start_time > chunk.message_end_time:
                return None
            index.chunks.append(place)
            opened += chunk.uncompressed_size
            # A channel's span is the span of its chunks: the indexes of single messages are not read.
            for channel in chunk.message_index_offsets:
                index.seen.setdefault(channel, Seen()).widen(chunk.message_start_time, chunk.message_end_time)
        elif opcode == Opcode.METADATA_INDEX:
            entry = parsed(MetadataIndex, content)
            index.extras.append(Extra(Opcode.METADATA, entry.offset, entry.length, entry.name))
        elif opcode == Opcode.ATTACHMENT_INDEX:
            attached = parsed(AttachmentIndex, content)
            index.extras.append(Extra(Opcode.ATTACHMENT, attached.offset, attached.length, attached.name))
    places = [(offset, length) for offset, length, _, _, _ in index.chunks]
    places += [(extra.offset, extra.length) for extra in index.extras]
    if not _are_inside(places, start) or not _fits(statistics, index, descriptions, spending):
        return None
    _refuse_overlaps(places, path)
    spending.check_opened(opened)
    assert statistics is not None
    for channel, count in statistics.channel_message_counts.items():
        index.seen.setdefault(channel, Seen()).count = count
    return index


def _are_inside(places: list[tuple[int, int]], end: int) -> bool:
    return all(len(MAGIC) <= offset <= end - length and length >= RECORD.size for offset, length in places)


def _fits(statistics: Statistics | None, index: Index, descriptions: Descriptions, spending: Spending) -> bool:
    if statistics is None:
        return False
    counts = statistics.channel_message_counts
    return (
        statistics.chunk_count == len(index.chunks)
        and set(counts) <= set(descriptions.channels)
        and bool(index.chunks or not statistics.message_count)
        and sum(counts.values()) <= spending.budget.parts
    )


def _refuse_overlaps(places: list[tuple[int, int]], path: Path) -> None:
    """Refuse an index that lists bytes of the file more than once: reading them each time would have no end."""
    in_order = sorted(places)
    for (offset, length), (next_offset, _) in itertools.pairwise(in_order):
        if offset + length > next_offset:
            raise BudgetError(
                f"{path}: its index lists bytes more than once: {length} bytes at byte {offset}, and again at byte "
                f"{next_offset}. It is damaged, or made to exhaust who reads it. mcap recover makes a new index."
            )
