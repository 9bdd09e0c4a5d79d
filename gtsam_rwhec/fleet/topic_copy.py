"""Copy the part of a log that a rig needs to this machine's disk: only chunks with its topics are read.

The index at the end of an MCAP file lists the channels of each chunk. A log without an index (unfinished or damaged)
is read whole, and a `LogWarning` gives the reason.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, TypeAlias

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, DataEnd, Footer, Header, McapRecord, MetadataIndex, Schema, Statistics

from gtsam_rwhec.errors import BudgetError, LogError, LogWarning, StoreError
from gtsam_rwhec.files.budgets import Spending
from gtsam_rwhec.files.whole_files import atomic_stream
from gtsam_rwhec.fleet.stores import count_bytes, local_path, read_ranges, shown, size_of
from gtsam_rwhec.logs.mcap_index import FAULTS, MAGIC, RECORD, read_index
from gtsam_rwhec.logs.records import TF_TOPICS, Topic

#: Bytes. A smaller file on disk is never copied.
SMALL = 64 << 20
#: A file on disk is copied only if its needed chunks are less than this share of it. A copy saves time since the
#: stages read a log several times and open every chunk each time.
SHARE = 0.5
#: A gap between two chunks is read with them in one request if it is less than this share of the bytes before it.
GAP_SHARE = 0.05
#: The most bytes of one request, and of all requests at the same time.
REQUEST, TOGETHER = 8 << 20, 32 << 20
#: The names of this library's metadata begin with this word; other metadata are not read.
_OWN = "gtsam_rwhec."
#: The stages write these files beside the log.
_OF_STAGES = ("detected.mcap", "calibration.mcap")


#: First byte, end, and the places (offset, length) that it holds.
_Request: TypeAlias = tuple[int, int, list[tuple[int, int]]]


@dataclass(frozen=True)
class Needed:
    """The needed parts of a log, from its index: schemas and channels, statistics, chunks and metadata."""

    descriptions: tuple[McapRecord, ...]
    statistics: Statistics
    chunks: tuple[ChunkIndex, ...]
    metadata: tuple[MetadataIndex, ...]

    @property
    def chunk_bytes(self) -> int:
        """Bytes of the chunks as stored (compressed)."""
        return sum(chunk.chunk_length for chunk in self.chunks)


def local_copy_of_topics(url: str, topics: Collection[str], folder: Path) -> Path:
    """A log on this machine's disk (the file itself or a copy) with all messages of some topics, and possibly others.

    ``/tf`` or ``/tf_static`` stand for all topics of transforms. A copy is made in `folder`. Raises `StoreError` if the
    store refuses, `StoreInterruptedError` if it breaks off, `LogError` if the copy cannot be written.
    """
    path = local_path(url)
    size = size_of(url)
    if path is not None and size < SMALL:
        count_bytes(size)
        return path
    needed = needed_of(url, size, topics)
    if path is not None and (isinstance(needed, str) or needed.chunk_bytes >= SHARE * size):
        count_bytes(size)
        return path
    name = shown(url).removesuffix("?...").rpartition("/")[2]
    copy = folder / (f"log_{name}" if name in _OF_STAGES else name)
    fault = needed if isinstance(needed, str) else _copied(url, needed, copy)
    if fault:
        warnings.warn(f"{shown(url)}: {fault}; all of its {size} bytes are read", LogWarning, stacklevel=2)
        _copied_whole(url, size, copy)
    return copy


def needed_of(url: str, size: int, topics: Collection[str]) -> Needed | str:
    """The parts of a log of `size` bytes with some topics, from its index; or why the index cannot be used."""

    def read(offset: int, length: int) -> bytes:
        return read_ranges(url, [(offset, min(size, offset + length))])[0]

    place = Path(shown(url))
    try:
        index = read_index(read, place, size, Spending(place, size), with_channels=True)
    except BudgetError as error:
        raise BudgetError(str(error).replace(str(place), shown(url))) from None
    except FAULTS as error:
        return f"its index is damaged ({error})"
    if index is None:
        return "it has no index, or one that does not fit (recording broke off?); mcap recover makes one"
    summary = index.summary
    with_tf = any(topic.rpartition("/")[2] in TF_TOPICS for topic in topics)
    wanted = {
        number
        for number, channel in summary.channels.items()
        if channel.topic in topics or (with_tf and _is_tf(channel, summary.schemas.get(channel.schema_id)))
    }
    # Without an index of messages nothing says which channels a chunk has.
    chunks = [
        chunk
        for chunk in summary.chunk_indexes
        if not chunk.message_index_offsets or wanted & set(chunk.message_index_offsets)
    ]
    chunks.sort(key=lambda chunk: chunk.chunk_start_offset)
    assert summary.statistics is not None  # read_index asks for it
    counts = summary.statistics.channel_message_counts
    statistics = replace(
        summary.statistics, channel_message_counts={key: counts[key] for key in counts if key in wanted}
    )
    own = (metadata for metadata in summary.metadata_indexes if metadata.name.startswith(_OWN))
    descriptions = (*summary.schemas.values(), *summary.channels.values())
    return Needed(descriptions, statistics, tuple(chunks), tuple(own))


def _is_tf(channel: Channel, schema: Schema | None) -> bool:
    return Topic(channel.topic, schema.name if schema else "", "", 0, None, None, "").is_tf


def _copied(url: str, needed: Needed, copy: Path) -> str:
    """Write the needed part; if the index is wrong, return the reason."""
    places = [(chunk.chunk_start_offset, chunk.chunk_length) for chunk in needed.chunks]
    extras = [(extra.offset, extra.length) for extra in needed.metadata]
    with _written(copy) as stream:
        out = McapCopy(stream)
        for chunk, data in zip(needed.chunks, _parts(url, places), strict=True):
            opcode, length = RECORD.unpack_from(data)
            if opcode != Opcode.CHUNK or RECORD.size + length != chunk.chunk_length:
                return f"its index says that a chunk is at byte {chunk.chunk_start_offset}, and none is there"
            out.chunk(chunk, data)
        for extra, data in zip(needed.metadata, _parts(url, extras), strict=True):
            out.metadata(extra.name, data)
        out.finish(needed.descriptions, needed.statistics)
    return ""


@contextmanager
def _written(copy: Path) -> Iterator[BinaryIO]:
    try:
        with atomic_stream(copy) as stream:
            yield stream
    except StoreError:
        raise
    except OSError as error:
        raise LogError(f"{copy} cannot be written: {error.strerror}.") from error


def _copied_whole(url: str, size: int, copy: Path) -> None:
    places = [(at, min(REQUEST, size - at)) for at in range(0, size, REQUEST)]
    with _written(copy) as stream:
        for data in _parts(url, places):
            stream.write(data)


def _parts(url: str, places: list[tuple[int, int]]) -> Iterator[bytes]:
    """The bytes of places (offset, length), in their order, with few requests."""
    for group in _together(_joined(places)):
        for (start, _, members), data in zip(group, read_ranges(url, [each[:2] for each in group]), strict=True):
            for offset, length in members:
                yield data[offset - start : offset - start + length]


def _joined(places: list[tuple[int, int]]) -> list[_Request]:
    """Requests for places; places close together share one request."""
    found: list[_Request] = []
    for offset, length in places:
        if found:
            start, end, members = found[-1]
            gap = offset - end
            if 0 <= gap <= GAP_SHARE * (end - start) and offset + length - start <= REQUEST:
                found[-1] = start, offset + length, [*members, (offset, length)]
                continue
        found.append((offset, offset + length, [(offset, length)]))
    return found


def _together(requests: list[_Request]) -> Iterator[list[_Request]]:
    """Groups of requests to send together; their size is limited, so that memory is limited."""
    group: list[_Request] = []
    size = 0
    for request in requests:
        if group and size + request[1] - request[0] > TOGETHER:
            yield group
            group, size = [], 0
        group.append(request)
        size += request[1] - request[0]
    if group:
        yield group


class McapCopy:
    """Writes an MCAP file of chunks and metadata copied byte for byte from another file, with a new index."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._at = stream, 0
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._write(MAGIC)
        self._write_record(Header(profile="", library="gtsam-rwhec"))

    def chunk(self, index: ChunkIndex, record: bytes) -> None:
        """Write a chunk without its index of messages."""
        # Keep the channels' numbers: they say which channels the chunk has.
        offsets = dict.fromkeys(index.message_index_offsets, 0)
        self._chunks.append(
            replace(index, chunk_start_offset=self._at, message_index_offsets=offsets, message_index_length=0)
        )
        self._write(record)

    def metadata(self, name: str, record: bytes) -> None:
        """Write a record of metadata."""
        self._metadata.append(MetadataIndex(offset=self._at, length=len(record), name=name))
        self._write(record)

    def finish(self, descriptions: Sequence[McapRecord], statistics: Statistics) -> None:
        """Write the index: schemas and channels, and the counts of the channels that are whole."""
        self._write_record(DataEnd(data_section_crc=0))
        begins = self._at
        counted = replace(
            statistics,
            chunk_count=len(self._chunks),
            attachment_count=0,
            metadata_count=len(self._metadata),
            message_count=sum(statistics.channel_message_counts.values()),
        )
        for entry in (*descriptions, counted, *self._chunks, *self._metadata):
            self._write_record(entry)
        self._write_record(Footer(summary_start=begins, summary_offset_start=0, summary_crc=0))
        self._write(MAGIC)

    def _write_record(self, record: McapRecord) -> None:
        builder = RecordBuilder()
        record.write(builder)
        content: bytes = builder.end()  # type: ignore[no-untyped-call]
        self._write(content)

    def _write(self, data: bytes) -> None:
        self._stream.write(data)
        self._at += len(data)
