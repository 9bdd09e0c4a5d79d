"""Tables of poses beside a folder of images: the first byte names the order of the columns and the images' names."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from typing import get_args

from harness import Harness, scratch
from mutations import words_and_lines

from gtsam_rwhec.logs import image_folder

FOLDER = scratch()
COLUMNS = get_args(image_folder.Columns)
BY_NAME, BY_STAMP = FOLDER / "named", FOLDER / "stamped"
IMAGES = [
    BY_NAME / "im_1.png",
    BY_NAME / "im_2.jpg",
    BY_STAMP / "1700000000300000000.png",
    BY_STAMP / "1700000001.5.png",
]
for _image in IMAGES:
    _image.parent.mkdir(exist_ok=True)
    _image.write_bytes(b"x")


def read(data: bytes) -> None:
    """A log of two images and of the table's poses."""
    kind = data[0] if data else 0
    table = FOLDER / "poses.txt"
    table.write_bytes(data[1:])
    images = BY_STAMP if kind & 8 else BY_NAME
    image_folder.write_image_folder(images, table, FOLDER / "out.mcap", columns=COLUMNS[kind % len(COLUMNS)])


def mutate(data: bytes, chance: random.Random, plain: Callable[[bytes], bytes]) -> bytes:
    """Change words and lines, and leave the first byte."""
    return data[:1] + words_and_lines(data[1:], chance, plain)


def seeds() -> Iterable[bytes]:
    """Poses by name and by stamp, with commas and with blanks."""
    yield b"\0" + b"image,tx,ty,tz,qx,qy,qz,qw\n# first\nim_1.png,1,2,3,0,0,0.6,0.8\nim_2, 4,2,3,0,0,0,1\n"
    yield b"\x09" + b"1700000000.25 1 2 3 0.8 0 0 0.6\n1700000001000000001 1 2 3 1 0 0 0\n"
    yield b"\x02" + b"im_1 1 0 0 0 1e-3 -2 .5\n"


HARNESS = Harness(read, seeds, mutate)
