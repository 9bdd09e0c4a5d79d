"""Chunks of an MCAP file opened within a budget: nothing is decompressed beyond what the chunk states and may have."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass

import lz4.frame
import zstandard
from mcap.opcode import Opcode

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.files.budgets import Spending
from gtsam_rwhec.logs.mcap_records import RECORD

#: A chunk's record begins with opcode, length, first and last time, opened size, checksum, and the length of its
#: compression's name.
_HEAD = struct.Struct("<BQQQQII")
#: The name of a compression is followed by the length of what is compressed.
_LENGTH = struct.Struct("<Q")
#: The record of a chunk has at least this many bytes.
LEAST_BYTES = _HEAD.size + _LENGTH.size
#: Bytes. The name of a compression is not longer.
_LONGEST_NAME = 32
#: Bytes. zstd's decoder may need a window of this size for any content, and else one of the content's size.
_WINDOW = 1 << 23


@dataclass(frozen=True)
class ChunkPlace:
    """Where the record of a chunk is in a file, and the opened size in the index, if there is one.

    `is_cut` says that the file ends inside the chunk.
    """

    offset: int
    length: int
    is_cut: bool
    indexed_size: int | None


def opened_chunk(read: Callable[[int, int], bytes], place: ChunkPlace, where: str, spending: Spending) -> bytes:
    """The records in a chunk. A chunk that is cut gives as many records as there are.

    `read` gives bytes of the file, by offset and length. A wrong compression, size or checksum raises a LogError; more
    than the whole log may yield, a BudgetError.
    """
    head = read(place.offset, _HEAD.size + _LONGEST_NAME + _LENGTH.size)
    try:
        opcode, length, _, _, size, checksum, name_length = _HEAD.unpack_from(head)
        name_ends = _HEAD.size + min(name_length, _LONGEST_NAME)
        name = str(head[_HEAD.size : name_ends], "utf-8")
        (compressed,) = _LENGTH.unpack_from(head, name_ends)
    except (struct.error, UnicodeDecodeError) as error:
        raise LogError(f"{where}: no chunk can be read there ({error}); its messages are lost") from error
    begins = name_ends + _LENGTH.size
    is_whole = RECORD.size + length == place.length and begins + compressed <= place.length
    if opcode != Opcode.CHUNK or (not is_whole and not place.is_cut):
        raise LogError(f"{where}: no whole chunk is there; its messages are lost")
    if name_length > _LONGEST_NAME or name not in _DECOMPRESS:
        raise LogError(f"{where}: compression {name!r} is not supported; its messages are lost")
    if size > spending.budget.chunk:
        raise LogError(
            f"{where}: {size} bytes when opened, beyond the limit of {spending.budget.chunk} for a log of "
            f"{spending.budget.size} bytes; not opened, and its messages are lost. If the log is honest, write it anew "
            "with smaller chunks (mcap compress --chunk-size)"
        )
    if place.indexed_size is not None and size > place.indexed_size:
        raise LogError(f"{where}: states {size} bytes when opened, and the index {place.indexed_size}; not opened")
    spending.take_opened(size)
    content = read(place.offset + begins, min(compressed, place.length - begins))
    try:
        data = _DECOMPRESS[name](content, size + 1)
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise LogError(f"{where}: does not decompress ({error}); its messages are lost") from error
    if place.is_cut:
        return data
    if len(data) != size:
        raise LogError(f"{where}: has {len(data)} bytes after decompression, and states {size}; its messages are lost")
    if checksum not in (0, zlib.crc32(data)):
        raise LogError(f"{where}: wrong checksum; its messages are lost")
    return data


def stated_size(read: Callable[[int, int], bytes], offset: int) -> int:
    """The size that a chunk states for its opened data; 0 if no chunk can be read there."""
    head = read(offset, _HEAD.size)
    return int(_HEAD.unpack(head)[4]) if len(head) == _HEAD.size else 0


def _zstd(content: bytes, most: int) -> bytes:
    window = max(_WINDOW, 1 << (most - 1).bit_length())
    decompressor = zstandard.ZstdDecompressor(max_window_size=window)
    with decompressor.stream_reader(content, read_across_frames=True) as stream:
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
