"""Images that were made to exhaust their reader: each is refused, with a reason; honest ones are decoded."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from limited_process import MEMORY, SECONDS, Reader

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.detect.detector import Detector
from gtsam_rwhec.detect.images import decode_gray, stated_size
from gtsam_rwhec.detect.many_images import BATCH, detect_in_images
from gtsam_rwhec.logs.records import ImageRecord

PNG = b"\x89PNG\r\n\x1a\n"
SIDE = 16_384


def part(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(width: int, height: int, *, depth: int = 8, colour: int = 0, before: bytes = b"", after: bytes = b"") -> bytes:
    """Black, compressed as far as it goes; with other chunks around its pixels."""
    row = 1 + (width * depth * {0: 1, 2: 3, 6: 4}[colour] + 7) // 8
    compressor = zlib.compressobj(9)
    pixels = b"".join(compressor.compress(bytes(row * min(256, height - y))) for y in range(0, height, 256))
    head = part(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    return PNG + head + before + part(b"IDAT", pixels + compressor.flush()) + after + part(b"IEND", b"")


def texts(count: int, kind: bytes = b"zTXt", head: bytes = b"k\0\0") -> bytes:
    """Texts of 8 MB each, of which libpng opens every one."""
    return part(kind, head + zlib.compress(bytes(7_900_000), 9)) * count


def encoded(pixels: np.ndarray, ending: str, *options: int) -> bytes:
    ok, buffer = cv2.imencode(ending, pixels, options)
    assert ok
    return buffer.tobytes()


def black(width: int, height: int, ending: str, *options: int, dtype: type = np.uint8) -> bytes:
    return encoded(np.zeros((height, width), dtype), ending, *options)


def jpeg_of(width: int, height: int) -> bytes:
    """A small JPEG whose header says another size."""
    jpeg = black(64, 64, ".jpg")
    at = jpeg.index(b"\xff\xc0")
    return jpeg[: at + 5] + struct.pack(">HH", height, width) + jpeg[at + 9 :]


def jpeg_of_many_scans(count: int) -> bytes:
    """A progressive JPEG, its last scan again and again: each takes a pass over all pixels."""
    jpeg = black(4096, 4096, ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
    at, end = jpeg.rindex(b"\xff\xda"), jpeg.rindex(b"\xff\xd9")
    return jpeg[:end] + jpeg[at:end] * count + jpeg[end:]


def tiff_of(width: int, height: int, *, samples: int = 1, bits: int = 8) -> bytes:
    """A TIFF with one strip of a few bytes."""
    tags = [
        (256, 4, width),
        (257, 4, height),
        (258, 3, bits),
        (259, 3, 1),
        (262, 3, 1),
        (273, 4, 200),
        (277, 3, samples),
    ]
    tags += [(278, 4, height), (279, 4, 2**32 - 1)]
    entries = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    return (b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4)).ljust(300, b"\0")


def bmp_of(width: int, height: int) -> bytes:
    """A BMP, compressed run by run, of a few bytes."""
    head = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 8, 1, 9, 0, 0, 2, 0)
    return b"BM" + struct.pack("<IHHI", 100, 0, 0, 62) + head + bytes(8) + b"\xff\0" * 20 + b"\0\1"


def webp_of(width: int, height: int, kind: bytes) -> bytes:
    """A WebP of a few bytes that states a size, in each of the three ways."""
    if kind == b"VP8L":
        content = b"\x2f" + struct.pack("<I", (width - 1) | (height - 1) << 14)
    elif kind == b"VP8X":
        content = bytes(4) + (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    else:
        content = b"\x10\0\0\x9d\x01\x2a" + struct.pack("<HH", width, height)
    content = content.ljust(40, b"\0")
    return b"RIFF" + struct.pack("<I", 12 + len(content)) + b"WEBP" + kind + struct.pack("<I", len(content)) + content


def animated_png(frames: int) -> bytes:
    control = [struct.pack(">IIIIIHHBB", n, 4096, 4096, 0, 0, 1, 1, 0, 0) for n in range(0, 2 * frames, 2)]
    pixels = zlib.compress(bytes(4097 * 4096), 9)
    rest = b"".join(
        part(b"fcTL", head) + part(b"fdAT", struct.pack(">I", 2 * i + 2) + pixels) for i, head in enumerate(control[1:])
    )
    before = part(b"acTL", struct.pack(">II", frames, 0)) + part(b"fcTL", control[0])
    return png(4096, 4096, before=before, after=rest)


MORE = "pixels are more than the"
HOSTILE: dict[str, tuple[Callable[[], bytes], str]] = {
    "png": (lambda: png(SIDE, SIDE), MORE),
    "png of one bit": (lambda: png(SIDE, SIDE, depth=1), MORE),
    "png of 16 bits and four channels": (lambda: png(5000, 5000, depth=16, colour=6), MORE),
    "jpeg": (lambda: jpeg_of(SIDE, SIDE), MORE),
    "webp, lossy header": (lambda: webp_of(16_383, 16_383, b"VP8 "), MORE),
    "webp, lossless header": (lambda: webp_of(SIDE, SIDE, b"VP8L"), MORE),
    "webp, canvas": (lambda: webp_of(1 << 24, 1 << 24, b"VP8X"), MORE),
    "tiff": (lambda: black(SIDE, SIDE, ".tiff"), MORE),
    "tiff of nothing": (lambda: tiff_of(SIDE, SIDE), MORE),
    "tiff of many samples": (lambda: tiff_of(4000, 4000, samples=65_535, bits=64), "cannot decode"),
    "tiff that lacks its strip": (lambda: tiff_of(4000, 4000), "cannot decode"),
    "bmp": (lambda: bmp_of(SIDE, SIDE), MORE),
    "bmp of runs": (lambda: bmp_of(4000, -4000), ""),
    "scans of a jpeg": (lambda: jpeg_of_many_scans(5_000), "scans, more than the 64"),
    "compressed depth": (lambda: struct.pack("<iff", 0, 1, 1) + png(9, 9), "are not a JPEG, PNG, WebP, TIFF or BMP"),
    "png of no pixels, and a chunk of 4 GB behind its end": (
        lambda: PNG + part(b"IHDR", struct.pack(">IIBBBBB", 16, 12, 8, 0, 0, 0, 0)) + part(b"IEND", b"")
        + b"\xf5\x28\xf0\x3fIEND\xaeB`\x82", "cannot decode",
    ),
    "gif": (lambda: b"GIF89a" + struct.pack("<HH", 65_535, 65_535) + bytes(100), "are not a JPEG, PNG"),
    "jpeg 2000": (lambda: b"\0\0\0\x0cjP  \r\n\x87\n" + bytes(100), "are not a JPEG, PNG"),
}  # fmt: skip
#: Hostile content around a small or honest image: it costs nothing, and the image is read.
HARMLESS: dict[str, tuple[Callable[[], bytes], tuple[int, int]]] = {
    "texts": (lambda: png(30, 20, before=texts(100), after=texts(100)), (20, 30)),
    "international texts": (lambda: png(30, 20, before=texts(100, b"iTXt", b"k\0\1\0\0\0")), (20, 30)),
    "profile": (lambda: png(30, 20, before=texts(1, b"iCCP")), (20, 30)),
    "frames": (lambda: animated_png(60), (4096, 4096)),
}
#: What is honest, and large or compressed as far as it goes.
HONEST: dict[str, tuple[Callable[[], bytes], tuple[int, int]]] = {
    "black jpeg of 24 megapixels": (lambda: black(6000, 4000, ".jpg"), (4000, 6000)),
    "black png of 20 megapixels": (lambda: png(5472, 3648), (3648, 5472)),
    "black webp of 16 megapixels": (lambda: black(4608, 3456, ".webp"), (3456, 4608)),
    "black png of 12 megapixels, 16 bits": (lambda: black(4000, 3000, ".png", dtype=np.uint16), (3000, 4000)),
    "tiff of 24 megapixels": (
        lambda: black(6000, 4000, ".tiff", cv2.IMWRITE_TIFF_COMPRESSION, 1), (4000, 6000),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE | HARMLESS | HONEST)
def test_an_image_is_read_or_refused_within_its_budget(reader: Reader, tmp_path: Path, name: str) -> None:
    make, expected = {**HOSTILE, **HARMLESS, **HONEST}[name]
    path = tmp_path / "image"
    path.write_bytes(make())
    reading = reader("image", path)
    if name in HOSTILE:
        assert reading.error == "ImageError" or not expected, (reading.error, reading.message)
        assert expected in reading.message
    else:
        assert (reading.error, reading.result) == ("", list(expected)), reading.message
    assert reading.peak_bytes <= MEMORY + path.stat().st_size
    assert reading.seconds <= SECONDS


@pytest.mark.parametrize("make", [lambda: png(4000, 3000), lambda: black(4000, 3000, ".jpg")])
def test_an_image_of_another_size_than_the_intrinsics_is_refused_before_it_is_decoded(
    reader: Reader, tmp_path: Path, make: Callable[[], bytes]
) -> None:
    path = tmp_path / "image"
    path.write_bytes(make())
    reading = reader("image", path, size=[640, 480])
    assert reading.error == "ImageError"
    assert "4000 x 3000 pixels, but the intrinsics are for 640 x 480" in reading.message
    assert reading.peak_bytes < 4_000_000  # a decoded image has 12


def test_what_a_png_has_beside_its_pixels_does_not_change_them() -> None:
    pixels = (np.arange(30)[None] * 5 + np.arange(20)[:, None]).astype(np.uint8)
    plain = encoded(pixels, ".png")
    at = plain.index(b"IDAT") - 4
    others = part(b"gAMA", struct.pack(">I", 45_455)) + part(b"tEXt", b"k\0v") + part(b"pHYs", bytes(9))
    for data in (plain, plain[:at] + others + plain[at:]):
        np.testing.assert_array_equal(decode_gray(ImageRecord(0, 0, "/cam", "cam", "png", data)), pixels)


@pytest.mark.parametrize("options", [(), (cv2.IMWRITE_WEBP_QUALITY, 50), (cv2.IMWRITE_WEBP_QUALITY, 101)])
@pytest.mark.parametrize("size", [(37, 21), (300, 1), (1, 9)])
def test_the_size_that_a_webp_states(size: tuple[int, int], options: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    for channels in ((), (3,), (4,)):
        pixels = rng.integers(0, 255, (size[1], size[0], *channels)).astype(np.uint8)
        assert stated_size(encoded(pixels, ".webp", *options)) == size


def test_few_large_images_are_decoded_together() -> None:
    """Memory holds the pixels of a batch: each is black, has 4 megapixels and few bytes."""
    camera = Camera.of(2048, 2048, "", [[1500.0, 0, 1024], [0, 1500, 1024], [0, 0, 1]], [], "test")
    data = png(2048, 2048, depth=1)
    images = [ImageRecord(i, i, "/cam", "cam", "png", data) for i in range(12)]
    together: list[int] = []

    class Counting(Detector):
        def __call__(self, grays: list[np.ndarray]) -> list[object]:  # type: ignore[override]
            together.append(len(grays))
            return [None] * len(grays)

    list(detect_in_images(images, {"/cam": lambda: Counting(camera, [])}, workers=1))
    assert sum(together) == 12
    assert max(together) == 2 < BATCH
