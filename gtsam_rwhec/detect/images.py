"""Gray pixels from a log's images: compressed (JPEG, PNG, WebP, TIFF, BMP) or in raw encodings of ROS and Foxglove.

The size in the header is read before OpenCV decodes, to refuse huge images: it is never smaller than what OpenCV
decodes, which of two widths in a TIFF takes the first, and other readers the last.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gtsam_rwhec.cameras.camera import MOST_PIXELS
from gtsam_rwhec.errors import ImageError
from gtsam_rwhec.files.budgets import SCANS, pixel_budget
from gtsam_rwhec.logs.records import ImageRecord

#: Files begin with these bytes.
PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_BMP, _RIFF = b"BM", b"RIFF"
#: These chunks of a PNG make its pixels.
_PIXEL_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
_TIFF = {b"II*\0": "<", b"MM\0*": ">"}
#: TIFF has these tags for width and height, and two types for whole numbers, of 16 and 32 bits.
_WIDTH, _HEIGHT = 256, 257
_UNSIGNED = {3: "H", 4: "I"}

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
    """The canvas size of a VP8X file, or the frame size of a VP8L or VP8 file."""
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
        if tag in found and kind in _UNSIGNED:
            (value,) = struct.unpack_from(order + _UNSIGNED[kind], data, at + 10 + 12 * i)
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


def png_of_pixels(data: bytes) -> bytes | None:
    """A PNG without its text, profiles and further frames, which libpng would decompress at any cost.

    It ends with its first IEND: OpenCV reads on behind it where no pixels came before, and allocates what it finds
    there as a length. None if a chunk, IEND among them, is not whole in the file: OpenCV allocates what a chunk states.
    """
    kept, at, kind = [data[: len(PNG)]], len(PNG), b""
    while kind != b"IEND":
        length, kind = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        end = at + 12 + length
        if end > len(data):
            return None
        if kind in _PIXEL_CHUNKS:
            kept.append(data[at:end])
        at = end
    return b"".join(kept)


Gray = NDArray[np.uint8]

#: Each raw encoding has its channels, the bytes in a channel, and OpenCV's conversion to gray (None for gray images).
_RAW: dict[str, tuple[int, int, int | None]] = {
    "mono8": (1, 1, None), "8uc1": (1, 1, None), "mono16": (1, 2, None), "16uc1": (1, 2, None),
    "rgb8": (3, 1, cv2.COLOR_RGB2GRAY), "8uc3": (3, 1, cv2.COLOR_BGR2GRAY), "bgr8": (3, 1, cv2.COLOR_BGR2GRAY),
    "rgba8": (4, 1, cv2.COLOR_RGBA2GRAY), "bgra8": (4, 1, cv2.COLOR_BGRA2GRAY), "8uc4": (4, 1, cv2.COLOR_BGRA2GRAY),
    # OpenCV names a Bayer pattern by the second row's second and third pixels, ROS by the first row's first two.
    "bayer_rggb8": (1, 1, cv2.COLOR_BayerBG2GRAY), "bayer_bggr8": (1, 1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (1, 1, cv2.COLOR_BayerGR2GRAY), "bayer_grbg8": (1, 1, cv2.COLOR_BayerGB2GRAY),
    "yuv422": (2, 1, cv2.COLOR_YUV2GRAY_UYVY), "uyvy": (2, 1, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422_yuy2": (2, 1, cv2.COLOR_YUV2GRAY_YUY2), "yuyv": (2, 1, cv2.COLOR_YUV2GRAY_YUY2),
}  # fmt: skip
RAW_ENCODINGS = tuple(_RAW)
#: Intrinsics are for the pixels as recorded: EXIF's orientation is ignored. More than 8 bits are kept until they are
#: scaled.
_WHOLE = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
#: Parts of its size at which a JPEG can be decoded.
_REDUCED = {
    8: cv2.IMREAD_REDUCED_GRAYSCALE_8, 4: cv2.IMREAD_REDUCED_GRAYSCALE_4, 2: cv2.IMREAD_REDUCED_GRAYSCALE_2,
}  # fmt: skip
#: Pixels are scaled to 8 bits in pieces of about this many.
_PIECE = 1 << 20


def decode_gray(image: ImageRecord, size: Size | None = None) -> Gray:
    """Pixels (height, width), 8 bits, of a log's image; 16 bits are scaled so that the brightest pixel is 255.

    Parameters
    ----------
    size : (width, height), optional
        The size that the camera's intrinsics are for. An image of another size is refused before it is decoded.

    Raises
    ------
    ImageError
        The image cannot be decoded, has another size, has more pixels than an image of its bytes may have
        (``files/budgets.py``), or has an encoding that is not supported.
    """
    where = f"topic {image.topic}, image at {image.stamp_ns} ns"
    gray = _compressed(image, where, size) if image.is_compressed else _raw(image, where, size)
    _check_size(where, (gray.shape[1], gray.shape[0]), size)
    return gray


#: ROS's compressed depth images have this many bytes before the PNG.
_DEPTH_HEADER = 12
#: Raw encodings of depth, with NumPy's name for a pixel.
_DEPTH = {"16uc1": "u2", "mono16": "u2", "32fc1": "f4"}


def decode_depth(image: ImageRecord, size: Size) -> NDArray[Any]:
    """Pixels (height, width) of a depth image as they were recorded: 16 bits, or 32 of floating point.

    Raises `ImageError` as `decode_gray`; or the pixels are of 8 bits, or quantised, and so no depths.
    """
    where = f"topic {image.topic}, image at {image.stamp_ns} ns"
    encoding = image.encoding.strip().lower()
    if not image.is_compressed:
        if encoding not in _DEPTH:
            raise ImageError(f"{where}: encoding {image.encoding!r} is no depth; depths are {', '.join(_DEPTH)}")
        rows = _rows(image, where, size, np.dtype(_DEPTH[encoding]).itemsize)
        return rows.view((">" if image.is_bigendian else "<") + _DEPTH[encoding])
    if "compresseddepth" in encoding:
        if encoding.startswith("32fc1"):
            raise ImageError(f"{where}: compressed depths of floating point are quantised; record the raw topic")
        image = replace(image, data=image.data[_DEPTH_HEADER:])
    depth = _decoded(image, where, size, _WHOLE)
    if depth.dtype == np.uint8:
        raise ImageError(f"{where}: an image of 8 bits is no depth; give PNG of 16 bits, or TIFF of floating point")
    _check_size(where, (depth.shape[1], depth.shape[0]), size)
    return depth


#: Where nothing is seen depths are 0 or nan, as is at least this share of an image that is not named after depth.
UNSEEN = 0.01


def has_depths(image: ImageRecord, *, is_named: bool) -> bool:
    """Whether an image of a file has depths: more than 8 bits, and its name says so, or some pixels see nothing."""
    size = stated_size(image.data)
    if size is None or bytes_a_pixel(image.data) != _WIDE:
        return False
    try:
        depth = decode_depth(image, size)
    except ImageError:
        return False
    return is_named or float(((depth == 0) | (depth != depth)).mean()) > UNSEEN


def decode_small(image: ImageRecord, width: int) -> Gray:
    """Pixels, 8 bits, of a small picture of so many columns; a JPEG is decoded at a part of its size, which is faster.

    Raises `ImageError` as `decode_gray`.
    """
    where = f"topic {image.topic}, image at {image.stamp_ns} ns"
    size = stated_size(image.data) if image.is_compressed and image.data.startswith(JPEG) else None
    part = 1 if size is None else next((part for part in _REDUCED if size[0] >= part * width), 1)
    gray = decode_gray(image) if part == 1 else _compressed(image, where, None, _REDUCED[part])
    height = max(1, round(gray.shape[0] * width / gray.shape[1]))
    return np.asarray(cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _check_size(where: str, found: Size, wanted: Size | None) -> None:
    if wanted is not None and found != wanted:
        raise ImageError(
            f"{where}: {found[0]} x {found[1]} pixels, but the intrinsics are for {wanted[0]} x {wanted[1]}: "
            "it is of another camera, or of another setting of this one; give it a folder or topic and a sensor of its "
            "own"
        )


def _compressed(image: ImageRecord, where: str, wanted: Size | None, flags: int = _WHOLE) -> Gray:
    gray = _decoded(image, where, wanted, flags)
    return gray.astype(np.uint8, copy=False) if gray.dtype == np.uint8 else _eight_bits(gray)


def _decoded(image: ImageRecord, where: str, wanted: Size | None, flags: int) -> NDArray[Any]:
    if not len(image.data):
        raise ImageError(f"{where}: there are no bytes in it")
    begins, claims = image.data[:8].hex(), image.encoding[:40]
    what = f"{where}: {len(image.data)} bytes that begin with {begins} and claim to be {claims!r}"
    size = stated_size(image.data)
    if size is None:
        raise ImageError(f"{what} are not a JPEG, PNG, WebP, TIFF or BMP file with a size")
    most = min(MOST_PIXELS, pixel_budget(len(image.data), bytes_a_pixel(image.data)))
    if size[0] * size[1] > most:
        raise ImageError(
            f"{where}: {size[0]} x {size[1]} pixels are more than the {most} that are decoded of an image of "
            f"{len(image.data)} bytes"
        )
    _check_size(where, size, wanted)
    pixels = png_of_pixels(image.data) if image.data.startswith(PNG) else image.data
    if pixels is None:  # libpng would print a line for each
        raise ImageError(f"{where}: {len(image.data)} bytes of a PNG file that is cut short")
    if jpeg_scans(image.data) > SCANS:
        raise ImageError(f"{where}: a JPEG of {jpeg_scans(image.data)} scans, more than the {SCANS} that are decoded")
    buffer = np.frombuffer(pixels, dtype=np.uint8)
    try:
        gray = cv2.imdecode(buffer, flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:  # OpenCV 4 and 5 raise for some broken images and return None for others
        gray = None
    if gray is None:
        raise ImageError(f"{what}: OpenCV cannot decode them")
    return np.asarray(gray)


def _eight_bits(wide: NDArray[np.generic]) -> Gray:
    """Pixels scaled so that the brightest pixel is 255; negative and non-finite pixels become black."""
    rows = max(1, _PIECE // max(1, wide.shape[1]))
    pieces = [wide[start : start + rows] for start in range(0, len(wide), rows)]
    brightest = max((float(_finite(piece).max(initial=0.0)) for piece in pieces), default=0.0)
    factor = np.float32(255.0 / brightest if brightest > 0.0 else 0.0)
    gray: Gray = np.empty(wide.shape, dtype=np.uint8)
    for i, piece in enumerate(pieces):
        gray[i * rows : i * rows + rows] = np.rint(np.maximum(_finite(piece), 0.0) * factor)
    return gray


def _finite(wide: NDArray[np.generic]) -> NDArray[np.float32]:
    with np.errstate(over="ignore"):
        return np.nan_to_num(wide.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)


def _rows(image: ImageRecord, where: str, wanted: Size | None, pixel: int) -> NDArray[np.uint8]:
    """The rows (height, width * pixel) of a raw image whose pixels have so many bytes."""
    width, height, step = image.width, image.height, image.step
    if width is None or height is None or step is None:
        raise ImageError(f"{where}: a raw image without width, height or step")
    if width < 1 or height < 1 or step < width * pixel or len(image.data) < step * height:
        raise ImageError(
            f"{where}: {width} x {height} pixels of {image.encoding[:40]} in rows of {step} bytes do not fit "
            f"{len(image.data)} bytes"
        )
    if width * height > MOST_PIXELS:
        raise ImageError(f"{where}: {width} x {height} pixels are more than the {MOST_PIXELS} that are decoded")
    _check_size(where, (width, height), wanted)
    rows = np.frombuffer(image.data, dtype=np.uint8, count=step * height).reshape(height, step)
    return np.ascontiguousarray(rows[:, : width * pixel])


def _raw(image: ImageRecord, where: str, wanted: Size | None) -> Gray:
    encoding = image.encoding.strip().lower()
    if encoding not in _RAW:
        raise ImageError(f"{where}: encoding {image.encoding!r} is not supported; supported are {', '.join(_RAW)}")
    channels, size, code = _RAW[encoding]
    rows = _rows(image, where, wanted, channels * size)
    width, height = rows.shape[1] // (channels * size), rows.shape[0]
    if size == 2:
        return _eight_bits(rows.view(">u2" if image.is_bigendian else "<u2"))
    pixels = rows.reshape(height, width, channels) if channels > 1 else rows
    if code is None:
        return pixels
    try:
        return np.asarray(cv2.cvtColor(pixels, code), dtype=np.uint8)
    except cv2.error as error:
        raise ImageError(f"{where}: {encoding} of {width} x {height} pixels not converted: {error}") from error
