"""An MCAP file made of chunks and metadata of another one, byte for byte, with an index of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import BinaryIO

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex, DataEnd, Footer, Header, McapRecord, MetadataIndex, Statistics

from gtsam_rwhec.logs.mcap_file import MAGIC


class McapCopy:
    """Writes to a stream, from front to back."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._at = stream, 0
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._write(MAGIC)
        self._write_record(Header(profile="", library="gtsam-rwhec"))

    def chunk(self, index: ChunkIndex, record: bytes) -> None:
        """Write a chunk. Its index of messages is not copied: readers that need it find that there is none."""
        # The numbers of its channels stay, as they say what is in it.
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
