"""Text in pictures, in any script of DejaVu Sans, which comes with matplotlib: OpenCV's own letters are ASCII only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from gtsam_rwhec.files.terminal_text import shown

#: Blue, green, red, as OpenCV orders them.
Colour = tuple[int, int, int]
Picture = NDArray[np.uint8]
#: Characters of a text that are looked at: more do not fit any picture.
MOST_READ = 400


@dataclass(frozen=True)
class Words:
    """A line of text in a picture.

    Attributes
    ----------
    place : (float, float)
        Left end and top of its letters, pixels.
    text : str
    size : int
        Height of its letters with their gaps, pixels.
    colour : (int, int, int)
        Blue, green, red.
    is_bold : bool
    outline : Colour or None
        A line of this colour around each letter, for text over an image.
    """

    place: tuple[float, float]
    text: str
    size: int
    colour: Colour = (0, 0, 0)
    is_bold: bool = False
    outline: Colour | None = None


@cache
def font(size: int, *, is_bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans of a size in pixels."""
    import matplotlib

    name = "DejaVuSans-Bold.ttf" if is_bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name, size)


def written(picture: Picture, words: Sequence[Words]) -> Picture:
    """A picture (height, width, 3), blue, green, red, with lines of text."""
    if not words:
        return picture
    image = Image.fromarray(picture)
    pen = ImageDraw.Draw(image)
    for line in words:
        pen.text(
            line.place, shown(line.text, MOST_READ), fill=line.colour, font=font(line.size, is_bold=line.is_bold),
            stroke_width=0 if line.outline is None else max(1, line.size // 8), stroke_fill=line.outline,
        )  # fmt: skip
    return np.asarray(image, dtype=np.uint8)


def width_of(text: str, size: int, *, is_bold: bool = False) -> float:
    """The width of a line of text, pixels."""
    return float(font(size, is_bold=is_bold).getlength(shown(text, MOST_READ)))


def fitted(text: str, size: int, width: float, *, is_bold: bool = False) -> str:
    """The text, cut in its middle so that it is at most so many pixels wide: a name's end tells it from others."""
    text = shown(text, MOST_READ)
    kept = len(text)
    cut = text
    while kept > 1 and width_of(cut, size, is_bold=is_bold) > width:
        kept -= 1
        cut = f"{text[: (kept + 1) // 2]}…{text[len(text) - kept // 2 :]}"
    return cut


def wrapped(text: str, size: int, width: float, most: int) -> list[str]:
    """The text in at most so many lines of a width in pixels; the last one ends in an ellipsis where more is said."""
    lines = [""]
    words = shown(text, MOST_READ).split()
    for i, word in enumerate(words):
        longer = f"{lines[-1]} {word}".strip()
        if width_of(longer, size) <= width or not lines[-1]:
            lines[-1] = fitted(longer, size, width)
        elif len(lines) == most:
            rest = " ".join([lines[-1], *words[i:]])
            while rest and width_of(f"{rest}…", size) > width:
                rest = rest[:-1]
            lines[-1] = f"{rest}…"
            break
        else:
            lines.append(fitted(word, size, width))
    return lines
