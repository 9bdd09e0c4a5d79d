"""Width and height of compressed images from their headers, to refuse huge images before OpenCV decodes them.

The stated size must not be smaller than the size that OpenCV decodes. Measured on 2026-11-22
(benchmarks/own_code_against_libraries.py): if a TIFF gives its width twice, imagesize 2.0.1 takes the last
width and OpenCV the first. Of 771 damaged images that OpenCV 5 decodes, Pillow 13.0.0 refuses 5 and this module none.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

#: Files begin with these bytes.
PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_BMP, _RIFF = b"BM", b"RIFF"
#: These chunks of a PNG make its pixels.
_PIXEL_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
_TIFF = {b"II*\0": "<", b"MM\0*": ">"}
#: TIFF has these tags for width and height, and two types for whole numbers, of 16 and 32 bits.
_WIDTH, _HEIGHT = 256, 257
_WHOLE = {3: "H", 4: "I"}

#: Decoding takes about this many bytes for each pixel: gray of 8 bits, and what the decoder itself needs.
_LEAN = 3
#: WebP is decoded in colour, and converted.
_WEBP_BYTES = 6
#: TIFF and PNG of 16 bits are decoded to up to 8 bytes for each pixel.
_WIDE = 9

Size = tuple[int, int]


def stated_size(data: bytes) -> Size | None:
    """(width, height) in pixels of a PNG, JPEG, WebP, TIFF or BMP file; None for another file or a broken header."""
    readers: list[tuple[bool, Callable[[bytes], Size | None]]] = [
        (data.startswith(PNG), _png),
        (data.startswith(JPEG), _jpeg),
        (data.startswith(_RIFF) and data[8:12] == b"WEBP", _webp),
        (data[:4] in _TIFF, _tiff),
        (data.startswith(_BMP), _bmp),
    ]
    try:
        return next((read(data) for begins, read in readers if begins), None)
    except struct.error:
        return None  # the file ends before its size


def _png(data: bytes) -> Size:
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def _jpeg(data: bytes) -> Size | None:
    at = 2
    while at + 9 <= len(data):
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if data[at] != 0xFF:
            return None
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # start of frame
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        at += 2 + length
    return None


def _webp(data: bytes) -> Size | None:
    """The canvas of the extended format, or the frame of the other two."""
    if len(data) < 30:
        return None
    kind = data[12:16]
    if kind == b"VP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if kind == b"VP8L" and data[20] == 0x2F:
        bits = int.from_bytes(data[21:25], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8 " and data[23:26] == b"\x9d\x01\x2a":
        width, height = struct.unpack_from("<HH", data, 26)
        return width & 0x3FFF, height & 0x3FFF
    return None


def _tiff(data: bytes) -> Size | None:
    """The size in the first directory. If a tag is given twice, the larger value counts."""
    order = _TIFF[data[:4]]
    (at,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, at)
    found = {_WIDTH: 0, _HEIGHT: 0}
    for i in range(count):
        tag, kind = struct.unpack_from(order + "HH", data, at + 2 + 12 * i)
        if tag in found and kind in _WHOLE:
            (value,) = struct.unpack_from(order + _WHOLE[kind], data, at + 10 + 12 * i)
            found[tag] = max(found[tag], value)
    return (found[_WIDTH], found[_HEIGHT]) if all(found.values()) else None


def _bmp(data: bytes) -> Size:
    (header,) = struct.unpack_from("<I", data, 14)
    width, height = struct.unpack_from("<HH" if header == 12 else "<ii", data, 18)
    return abs(width), abs(height)


def bytes_a_pixel(data: bytes) -> int:
    """About how many bytes decoding takes for each pixel."""
    if data[:4] in _TIFF or (data.startswith(PNG) and data[24:25] == b"\x10"):
        return _WIDE
    return _WEBP_BYTES if data.startswith(_RIFF) else _LEAN


def jpeg_scans(data: bytes) -> int:
    """How many scans a JPEG has, with those of its thumbnails; none for another file."""
    return data.count(b"\xff\xda") if data.startswith(JPEG) else 0


def is_whole_png(data: bytes) -> bool:
    """Whether the chunks of a PNG, IEND among them, lie inside the file: OpenCV allocates what a chunk states."""
    at = len(PNG)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind = data[at + 4 : at + 8]
        at += 12 + length
        if kind == b"IEND":
            return bool(at <= len(data))
    return False


def with_pixels_only(data: bytes) -> bytes:
    """A PNG without its text, profiles and further frames, which libpng would decompress at any cost.

    It ends with its first IEND: OpenCV reads on behind it where no pixels came before, and allocates what it finds
    there as a length. A file that is not a PNG, or that has nothing to leave out, comes back as it is.
    """
    if not data.startswith(PNG):
        return data
    kept, at, kind = [data[: len(PNG)]], len(PNG), b""
    while kind != b"IEND" and at + 8 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        end, kind = at + 12 + length, data[at + 4 : at + 8]
        if kind in _PIXEL_CHUNKS or end > len(data):
            kept.append(data[at:end])
        at = end
    pixels = b"".join(kept)
    return pixels if len(pixels) < len(data) else data
