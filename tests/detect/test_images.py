"""Gray pixels from every encoding, and damaged or malicious images."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gtsam_rwhec.detect.images import RAW_ENCODINGS, decode_gray
from gtsam_rwhec.errors import ImageError
from gtsam_rwhec.logs.records import ImageRecord

WIDTH, HEIGHT = 24, 18
#: Smooth, so that Bayer patterns and half the colour's resolution lose little.
GRAY = (60 + 6 * np.arange(WIDTH)[None] + 2 * np.arange(HEIGHT)[:, None]).astype(np.uint8)
RED, GREEN, BLUE = 200, 100, 40
LUMINANCE = 0.299 * RED + 0.587 * GREEN + 0.114 * BLUE


def compressed(data: bytes, encoding: str = "jpeg") -> ImageRecord:
    return ImageRecord(5, 1234, "/cam", "cam", encoding, data)


def raw(
    pixels: np.ndarray, encoding: str, *, padding: int = 0, is_bigendian: bool = False, width: int | None = None
) -> ImageRecord:
    """A raw image from rows of bytes or of 16-bit numbers."""
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xEE)
    columns = pixels.shape[1] if width is None else width
    return ImageRecord(
        5, 1234, "/cam", "cam", encoding, rows.tobytes(), columns, len(pixels), rows.shape[1], is_bigendian
    )


def encoded(pixels: np.ndarray, ending: str) -> bytes:
    ok, buffer = cv2.imencode(ending, pixels)
    assert ok
    return buffer.tobytes()


def one_colour(*channels: int) -> np.ndarray:
    return np.broadcast_to(np.array(channels, dtype=np.uint8), (HEIGHT, WIDTH, len(channels)))


@pytest.mark.parametrize("padding", [0, 7])
@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_gray(encoding: str, padding: int) -> None:
    np.testing.assert_array_equal(decode_gray(raw(GRAY, encoding, padding=padding)), GRAY)


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize(
    ("encoding", "channels"),
    [
        ("rgb8", (RED, GREEN, BLUE)),
        ("bgr8", (BLUE, GREEN, RED)),
        ("8UC3", (BLUE, GREEN, RED)),
        ("rgba8", (RED, GREEN, BLUE, 9)),
        ("bgra8", (BLUE, GREEN, RED, 9)),
        ("8UC4", (BLUE, GREEN, RED, 9)),
    ],
)
def test_colours(encoding: str, channels: tuple[int, ...], padding: int) -> None:
    gray = decode_gray(raw(one_colour(*channels), encoding, padding=padding))
    assert gray.shape == (HEIGHT, WIDTH)
    np.testing.assert_allclose(gray, LUMINANCE, atol=1.0)
    ramp = np.repeat(GRAY[..., None], len(channels), axis=2)
    np.testing.assert_allclose(decode_gray(raw(ramp, encoding, padding=padding)).astype(int), GRAY, atol=1.0)


@pytest.mark.parametrize("padding", [0, 4])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns(pattern: str, padding: int) -> None:
    values = {"r": RED, "g": GREEN, "b": BLUE}
    cell = np.array([values[letter] for letter in pattern], dtype=np.uint8).reshape(2, 2)
    gray = decode_gray(raw(np.tile(cell, (HEIGHT // 2, WIDTH // 2)), f"bayer_{pattern}8", padding=padding))
    np.testing.assert_allclose(gray, LUMINANCE, atol=1.0)
    # What is gray in the scene is so in the mosaic, and stays where it is.
    ramp = decode_gray(raw(GRAY, f"bayer_{pattern}8", padding=padding)).astype(int)
    np.testing.assert_allclose(ramp[1:-1, 1:-1], GRAY[1:-1, 1:-1], atol=1.0)


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv"])
def test_yuv(encoding: str, padding: int) -> None:
    luma_first = encoding in ("yuv422_yuy2", "yuyv")
    chroma = np.full_like(GRAY, 30)
    pixels = np.stack([GRAY, chroma] if luma_first else [chroma, GRAY], axis=2)
    np.testing.assert_array_equal(decode_gray(raw(pixels, encoding, padding=padding)), GRAY)


@pytest.mark.parametrize("is_bigendian", [False, True])
@pytest.mark.parametrize("encoding", ["mono16", "16UC1"])
def test_sixteen_bits_are_scaled_to_the_brightest(encoding: str, is_bigendian: bool) -> None:
    twelve_bits = np.linspace(0, 4095, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH).astype(">u2" if is_bigendian else "<u2")
    gray = decode_gray(raw(twelve_bits, encoding, padding=6, is_bigendian=is_bigendian, width=WIDTH))
    np.testing.assert_allclose(gray, twelve_bits * (255.0 / 4095.0), atol=0.51)
    assert not decode_gray(raw(np.zeros((HEIGHT, WIDTH), "<u2"), encoding)).any()


@pytest.mark.parametrize(("ending", "off"), [(".png", 0), (".jpg", 3), (".bmp", 0), (".webp", 4), (".tiff", 0)])
def test_compressed(ending: str, off: int) -> None:
    # Whatever the message calls it: the bytes say what it is.
    np.testing.assert_allclose(decode_gray(compressed(encoded(GRAY, ending))).astype(int), GRAY, atol=off)
    colour = decode_gray(compressed(encoded(one_colour(BLUE, GREEN, RED), ending), "png"))
    np.testing.assert_allclose(colour, LUMINANCE, atol=off + 1)


def test_sixteen_bits_compressed_are_scaled_alike() -> None:
    twelve_bits = np.linspace(0, 4095, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH).astype(np.uint16)
    for ending in (".png", ".tiff"):
        np.testing.assert_array_equal(
            decode_gray(compressed(encoded(twelve_bits, ending), "png")), decode_gray(raw(twelve_bits, "mono16"))
        )


def test_floating_point_is_scaled_and_nan_is_black() -> None:
    pixels = (GRAY / 1000.0).astype(np.float32)
    pixels[0, :3] = np.nan, np.inf, -1.0
    gray = decode_gray(compressed(encoded(pixels, ".tiff"), "tiff"))
    expected = GRAY * (255.0 / GRAY.max())
    expected[0, :3] = 0.0
    np.testing.assert_allclose(gray, expected, atol=0.51)


def test_exif_orientation_is_ignored() -> None:
    jpeg = encoded(GRAY, ".jpg")
    # TIFF header, one entry: orientation (0x0112), short, 6: turned by 90 degrees.
    exif = b"Exif\0\0" + b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)
    turned = jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_GRAYSCALE).shape == (WIDTH, HEIGHT)  # it is there
    np.testing.assert_array_equal(decode_gray(compressed(turned)), decode_gray(compressed(jpeg)))


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_that_claims(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def jpeg_that_claims(width: int, height: int, before: bytes = b"") -> bytes:
    jpeg = encoded(GRAY, ".jpg")
    at = jpeg.index(b"\xff\xc0")
    return jpeg[:at] + before + jpeg[at : at + 5] + struct.pack(">HH", height, width) + jpeg[at + 9 :]


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (compressed(b""), "there are no bytes in it"),
        (compressed(encoded(GRAY, ".png")[:-40] + b"IEND", "png"), "of a PNG file that is cut short"),
        (compressed(b"\xff\xd8"), "2 bytes that begin with ffd8 and claim to be 'jpeg'"),
        (compressed(b"not an image at all", "png"), "19 bytes that begin with 6e6f7420616e2069 and claim to be 'png'"),
        (compressed(encoded(GRAY, ".jpg")[:-60]), "OpenCV cannot decode them"),
        (compressed(encoded(GRAY, ".png")[:-40], "png"), "of a PNG file that is cut short"),
        # a chunk that states 4 GB, which OpenCV would allocate
        (compressed(encoded(GRAY, ".png")[:33] + b"\xf0\0\0\0IDATxIEND", "png"), "of a PNG file that is cut short"),
        (compressed(png_that_claims(60_000, 60_000), "png"), "60000 x 60000 pixels are more than"),
        (compressed(png_that_claims(0, 5), "png"), "OpenCV cannot decode them"),
        (compressed(jpeg_that_claims(60_000, 60_000)), "60000 x 60000 pixels are more than"),
        (compressed(jpeg_that_claims(60_000, 60_000, b"\xff\xff\xff")), "60000 x 60000 pixels are more than"),
        (raw(GRAY, "mono12"), "'mono12' is not supported; supported are mono8, "),
        (raw(GRAY, ""), "'' is not supported"),
        (ImageRecord(5, 1234, "/cam", "cam", "mono8", bytes(100), 10, 11, 10), "10 x 11 pixels of mono8 in rows of 10"),
        (ImageRecord(5, 1234, "/cam", "cam", "mono8", bytes(100), 10, 10, 9), "in rows of 9 bytes do not fit 100"),
        (ImageRecord(5, 1234, "/cam", "cam", "rgb8", bytes(100), 10, 10, 10), "of rgb8 in rows of 10"),
        (ImageRecord(5, 1234, "/cam", "cam", "mono16", bytes(100), 10, 10, 10), "of mono16 in rows of 10"),
        (ImageRecord(5, 1234, "/cam", "cam", "mono8", b"", 0, 0, 0), "0 x 0 pixels"),
        (ImageRecord(5, 1234, "/cam", "cam", "mono8", bytes(9), -3, 3, 3), "-3 x 3 pixels"),
        (ImageRecord(5, 1234, "/cam", "cam", "mono8", bytes(9), 3, -3, 3), "3 x -3 pixels"),
        (ImageRecord(5, 1234, "/cam", "cam", "mono8", bytes(9), None, 3, 3), "without width, height or step"),
    ],
)  # fmt: skip
def test_wrong_images_are_refused(image: ImageRecord, words: str) -> None:
    with pytest.raises(ImageError, match=words) as caught:
        decode_gray(image)
    assert str(caught.value).startswith("topic /cam, image at 1234 ns: ")


def an_array_or_words(image: ImageRecord) -> None:
    try:
        gray = decode_gray(image)
    except ImageError:
        return
    assert gray.dtype == np.uint8
    assert gray.ndim == 2
    assert gray.size > 0
    if not image.is_compressed:
        assert gray.shape == (image.height, image.width)


SMALL = [encoded(GRAY, ending) for ending in (".png", ".jpg", ".bmp", ".webp", ".tiff", ".pgm")]


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(SMALL), st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=4), st.floats(0.1, 1))
def test_mutated_bytes(data: bytes, changes: list[tuple[float, int]], kept: float) -> None:
    mutated = bytearray(data)
    for where, value in changes:
        mutated[min(int(where * len(mutated)), len(mutated) - 1)] = value
    an_array_or_words(compressed(bytes(mutated[: max(1, int(kept * len(mutated)))])))


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200))
def test_random_bytes(data: bytes) -> None:
    an_array_or_words(compressed(data))
    an_array_or_words(compressed(b"\xff\xd8\xff" + data))
    an_array_or_words(compressed(b"\x89PNG\r\n\x1a\n" + data))


SIZE = st.integers(-2, 12)


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(RAW_ENCODINGS), SIZE, SIZE, st.integers(-2, 50), st.booleans(), st.binary(max_size=600))
def test_random_raw_images(encoding: str, width: int, height: int, step: int, is_bigendian: bool, data: bytes) -> None:
    an_array_or_words(ImageRecord(0, 0, "/cam", "cam", encoding, data, width, height, step, is_bigendian))
