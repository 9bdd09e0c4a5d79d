"""The records of an MCAP file: where each stands in its bytes, and what describes the messages (schemas, channels).

A record's length never leads out of the bytes that hold it, and a description is held once: an identifier that is
described twice, differently, would give messages another meaning.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, ChunkIndex, MetadataIndex, Schema, Statistics

from gtsam_rwhec.errors import BudgetError, LogError
from gtsam_rwhec.files.budgets import CHANNELS, SCHEMAS

#: Every record begins with its opcode and its length.
RECORD = struct.Struct("<BQ")
#: The readers of records raise these errors for bytes that are not a record.
FAULTS = (McapError, struct.error, UnicodeDecodeError, ValueError, OverflowError)

_Parsed = TypeVar("_Parsed", Attachment, AttachmentIndex, Channel, ChunkIndex, MetadataIndex, Schema, Statistics)


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


def parsed(kind: type[_Parsed], content: bytes) -> _Parsed:
    """A record from its content; one of `FAULTS` if it is not one. No length in it leads beyond the content."""
    record: _Parsed = kind.read(ReadDataStream(io.BytesIO(content)))
    return record


def entries_of(content: bytes) -> Iterator[tuple[str, str]]:
    """The entries of a metadata record, one by one: millions of them must not become a dict before they are counted.

    They raise one of `FAULTS` if the record is damaged.
    """
    _, at = _text(content, 0)  # its name
    (length,) = struct.unpack_from("<I", content, at)
    at, end = at + 4, at + 4 + length
    if end > len(content):
        raise ValueError(f"entries of {length} bytes in a record of {len(content)}")
    while at < end:
        key, at = _text(content, at)
        value, at = _text(content, at)
        yield key, value


def _text(content: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, at)
    end = at + 4 + length
    if end > len(content):
        raise ValueError(f"a text of {length} bytes in a record of {len(content)}")
    return str(content[at + 4 : end], "utf-8"), end


@dataclass
class Descriptions:
    """The schemas and channels of a file, each noted once."""

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    #: The bytes of each record that was noted, by opcode and identifier.
    _noted: dict[tuple[int, int], bytes] = field(default_factory=dict)
    #: How many bytes schemas and channels have, by opcode.
    _bytes: dict[int, int] = field(default_factory=dict)

    def note(self, opcode: int, content: bytes) -> None:
        """Take a schema or a channel.

        Raises a BudgetError if there are too many; a LogError if it cannot be read, or if its identifier has another
        description already.
        """
        what = "schema" if opcode == Opcode.SCHEMA else "channel"
        key = opcode, int.from_bytes(content[:2], "little")
        before = self._noted.get(key)
        if before == content:
            return
        most = SCHEMAS if opcode == Opcode.SCHEMA else CHANNELS
        size = self._bytes.get(opcode, 0) + len(content)
        if size > most:
            raise BudgetError(
                f"{self.path}: its {what}s have more than {most} bytes. It is damaged, or made to exhaust who reads it."
            )
        of_kind: dict[int, Schema] | dict[int, Channel] = self.schemas if opcode == Opcode.SCHEMA else self.channels
        try:
            made = parsed(Schema, content) if opcode == Opcode.SCHEMA else parsed(Channel, content)
        except FAULTS as error:
            raise LogError(f"a {what} cannot be read: {error}") from error
        if before is None:
            self._noted[key], self._bytes[opcode] = content, size
            of_kind[made.id] = made  # type: ignore[assignment]
        elif of_kind[made.id] != made:  # entries of a channel may come in another order
            raise LogError(f"{what} {made.id} is described twice, and differently")
