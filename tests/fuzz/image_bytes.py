"""Images: the first byte says that the rest is a compressed file, or which raw encoding it has."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable

import cv2
import numpy as np
from harness import Harness
from mutations import numbers_in_bytes

from gtsam_rwhec.detect import images
from gtsam_rwhec.logs.records import ImageRecord

COMPRESSED = 0xFF
RAW = images.RAW_ENCODINGS


def read(data: bytes) -> None:
    """Gray pixels; of a raw image the width, height and step are the three bytes after the first."""
    if len(data) < 5:
        return
    if data[0] == COMPRESSED:
        record = ImageRecord(0, 0, "/image", "cam", "jpeg", data[1:])
    else:
        sizes = {"width": data[1], "height": data[2], "step": data[3]}
        record = ImageRecord(0, 0, "/image", "cam", RAW[data[0] % len(RAW)], data[4:], **sizes)
    gray = images.decode_gray(record)
    assert gray.dtype == np.uint8
    assert gray.ndim == 2


def mutate(data: bytes, chance: random.Random, plain: Callable[[bytes], bytes]) -> bytes:
    """Change sizes, lengths and bytes, and leave the first byte."""
    return data[:1] + numbers_in_bytes(data[1:], chance, plain)


def seeds() -> Iterable[bytes]:
    """A gradient in every format that is decoded, with 8 and 16 bits, in gray and colour."""
    gray = np.outer(np.arange(12), np.arange(16)).astype(np.uint8)
    colour = np.stack([gray, gray.T.reshape(gray.shape), 255 - gray], axis=2)
    for ending in (".png", ".jpg", ".webp", ".tiff", ".bmp"):
        for pixels in (gray, colour):
            yield bytes([COMPRESSED]) + cv2.imencode(ending, pixels)[1].tobytes()
    yield bytes([COMPRESSED]) + cv2.imencode(".png", gray.astype(np.uint16) * 200)[1].tobytes()
    yield bytes([COMPRESSED]) + cv2.imencode(".tiff", gray.astype(np.float32) / 7)[1].tobytes()
    yield bytes([COMPRESSED]) + cv2.imencode(".jpg", gray, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    for i in range(len(RAW)):
        yield bytes([i, 4, 2, 16]) + bytes(range(32))


HARNESS = Harness(read, seeds, mutate)
