"""Pictures for people: detections drawn in their images, errors of corners, text, JPEG files of a limited size.

Used and rejected detections differ in colour (for colour-blind people too) and in form: what is used has upright
crosses and solid lines, what is rejected has oblique crosses and dashed lines.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise, product
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs.records import DetectionRecord

#: Blue, green, red, as OpenCV orders them.
Colour = tuple[int, int, int]
Picture = NDArray[np.uint8]
#: Characters of a text that are looked at: more do not fit any picture.
MOST_READ = 400


@dataclass(frozen=True)
class Words:
    """A line of text in a picture."""

    place: tuple[float, float]  #: Left end and top of its letters, pixels
    text: str
    size: int  #: Height of its letters with their gaps, pixels
    colour: Colour = (0, 0, 0)  #: Blue, green, red
    is_bold: bool = False
    outline: Colour | None = None  #: A line of this colour around each letter, for text over an image


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
    for each in words:
        pen.text(
            each.place, shown(each.text, MOST_READ), fill=each.colour, font=font(each.size, is_bold=each.is_bold),
            stroke_width=0 if each.outline is None else max(1, each.size // 8), stroke_fill=each.outline,
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


#: Qualities that are tried, the best first; where the last is too large the picture is made smaller.
QUALITIES = (85, 70, 55)
#: The scale of each reduction, and the fewest pixels of the shorter side.
SMALLER, LEAST = 0.75, 64


def jpeg_of(picture: Picture, most_bytes: int) -> bytes:
    """A picture as JPEG of at most so many bytes: of less quality, or smaller, where it must be."""
    while True:
        for quality in QUALITIES:
            is_written, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
            assert is_written
            if len(data) <= most_bytes:
                return data.tobytes()
        if min(picture.shape[:2]) * SMALLER < LEAST:
            return data.tobytes()
        size = (round(picture.shape[1] * SMALLER), round(picture.shape[0] * SMALLER))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


#: A used detection has this colour (blue, green, red), a blue of Okabe and Ito's palette for colour-blind people.
USED = (178, 114, 0)
#: A detection that is not used has this colour, the vermilion of the same palette.
NOT_USED = (0, 94, 213)
#: The axes x, y, z have these colours, and their letters at their ends.
AXES = (NOT_USED, (115, 158, 0), USED)
WHITE = (255, 255, 255)
#: OpenCV draws at places with this number of bits below the pixel, so to 1/16 of a pixel.
SHIFT = 4
#: An axis is this long, as a share of the target's distance.
AXIS = 0.08
#: A picture whose longer side is below this (pixels) is drawn at twice its size, so that marks do not hide pixels.
SMALL_PX = 1100
#: A picture of this width has letters of `LETTERS` pixels, and marks of `MARK` pixels to each side.
WIDE_PX, LETTERS, MARK = 1280, 17, 7
#: Dashes and their gaps, pixels.
DASH_PX = 6.0


def draw(gray: Gray, detections: Iterable[DetectionRecord], camera: Camera, caption: str = "") -> Picture:
    """Draw what was detected in an image: corners where they were measured, their order, axes, names with reasons.

    The first corner has a ring, and a thin line goes through the corners in their order. The picture (height, width, 3)
    has the colours (blue, green, red), as OpenCV writes them; one of a small image is twice as large. The caption is
    below the image.
    """
    scale = 2 if max(gray.shape) < SMALL_PX else 1
    large = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST) if scale > 1 else gray
    picture = np.asarray(cv2.cvtColor(large, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    letters = max(11, round(LETTERS * picture.shape[1] / WIDE_PX))
    mark = max(4.0, MARK * picture.shape[1] / WIDE_PX)
    words: list[Words] = []
    for record in detections:
        if record.corners_px is None or not len(record.corners_px) or not np.isfinite(record.corners_px).all():
            continue
        colour = NOT_USED if record.reason else USED
        corners = scaled(record.corners_px, scale)
        _draw_corners(picture, corners, mark, colour, is_used=not record.reason)
        if record.T_camera_tag is not None and not record.reason:
            words += _draw_axes(picture, record.T_camera_tag, camera, scale, letters)
        label = f"{record.id}: rejected, {record.reason}" if record.reason else record.id
        top = corners[np.argmin(corners[:, 1])]
        most = np.array([picture.shape[1] - width_of(label, letters), picture.shape[0] - 1.5 * letters]) - 2.0
        beside = top - [0.5 * width_of(label, letters), mark + 1.6 * letters]
        place = tuple(np.maximum(np.minimum(beside, most), 2.0).tolist())
        words.append(Words(place, label, letters, colour, is_bold=True, outline=WHITE))
    if caption:
        height = round(1.8 * letters)
        below = picture.shape[0] + 0.3 * letters
        picture = cv2.copyMakeBorder(picture, 0, height, 0, 0, cv2.BORDER_CONSTANT, value=WHITE).astype(np.uint8)
        words.append(Words((0.5 * letters, below), fitted(caption, letters, picture.shape[1] - letters), letters))
    return written(picture, words)


def scaled(pixels: Array, scale: float) -> Array:
    """Places in a picture that is `scale` times as large: pixel centres are at whole numbers in both."""
    return np.asarray(scale * (pixels + 0.5) - 0.5)


def line(
    picture: Picture, start: Array, end: Array, colour: Colour, width: int = 1, *, is_dashed: bool = False
) -> None:
    """A line between two places, which may be of dashes."""
    ends = np.stack([start, end])[None]
    length = float(np.linalg.norm(end - start))
    if is_dashed:
        if not np.isfinite(length) or length > 1e5:
            return
        count = max(1, round(0.5 * length / DASH_PX))
        ends = np.linspace(start, end, 2 * count, endpoint=False).reshape(count, 2, 2)
    for a, b in _fixed(ends).tolist():
        cv2.line(picture, a, b, colour, width, cv2.LINE_AA, SHIFT)


def circle(picture: Picture, middle: Array, radius: float, colour: Colour, width: int = -1) -> None:
    """A circle about a place; a disc without a width."""
    cv2.circle(picture, _fixed(middle).tolist(), round(radius * (1 << SHIFT)), colour, width, cv2.LINE_AA, SHIFT)


def radius_between(places: Array, share: float, most: float) -> float:
    """The radius of marks at places (n, 2): at most this share of the usual distance of neighbours, and `most`."""
    if len(places) < 2:
        return most
    apart = np.linalg.norm(places[:, None] - places, axis=2) + np.diag(np.full(len(places), np.inf))
    return float(np.clip(share * np.median(apart.min(axis=1)), 3.0, most))


def _draw_corners(picture: Picture, corners: Array, mark: float, colour: Colour, *, is_used: bool) -> None:
    """A thin line through the corners in their order, closed for a tag's four; a cross at each corner, open in its
    middle so that the corner is seen, and a ring around the first.
    """
    around = np.vstack([corners, corners[:1]]) if len(corners) == 4 else corners
    for start, end in pairwise(around):
        line(picture, start, end, colour, is_dashed=not is_used)
    mark = radius_between(corners, 0.35, mark)  # crosses of neighbours do not meet
    arms = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    if not is_used:
        arms = arms @ (np.sqrt(0.5) * np.array([[1.0, 1.0], [-1.0, 1.0]]))
    for width, tone in ((3, WHITE), (1, colour)):
        for corner, arm in product(corners, arms):
            line(picture, corner + 0.3 * mark * arm, corner + mark * arm, tone, width)
        circle(picture, corners[0], 1.7 * mark, tone, width + 1)


def _draw_axes(picture: Picture, T: Array, camera: Camera, scale: float, letters: int) -> list[Words]:
    """The axes of a target's frame; their letters."""
    length = AXIS * float(np.linalg.norm(T[:3, 3]))
    points = np.vstack([np.zeros(3), length * np.eye(3)]) @ T[:3, :3].T + T[:3, 3]
    pixels = camera.project(points)
    if not np.isfinite(pixels).all():
        return []
    start, *ends = scaled(pixels, scale)
    words = []
    for end, colour, name in zip(ends, AXES, "xyz", strict=True):
        line(picture, start, end, colour, 2)
        place = np.clip(end + 2.0, 0.0, np.array(picture.shape[1::-1]) - 1.0)
        words.append(Words((float(place[0]), float(place[1])), name, letters, colour, is_bold=True, outline=WHITE))
    return words


def _fixed(pixels: Array) -> NDArray[np.int32]:
    """OpenCV's fixed-point places. They are clipped, since places far outside do not fit."""
    return np.rint(np.clip(pixels, -1e4, 1e5) * (1 << SHIFT)).astype(np.int32)


#: The picture's longer side, pixels, and the part of the target's size that is around it.
SIDE_PX, AROUND = 720, 0.25
#: Width over height of the part of the image.
SHAPE = 4.0 / 3.0
#: Pixels: a circle's radius, a cross's arm.
RADIUS, ARM = 7, 5
#: So many of the largest errors have a number, 1 for the largest.
NUMBERED = 5
#: The longest error is drawn with about this length, pixels, and errors are magnified so many times at most.
LONGEST_PX, MOST_TIMES = 60.0, 1000.0


class DrawnErrors(NamedTuple):
    """The picture (height, width, 3), blue, green, red; and how many times as long the errors are in it."""

    picture: Picture
    magnified: float


def draw_errors(gray: Gray, seen: Array, errors: Array) -> DrawnErrors:
    """Draw the part of an image with a target: circles where corners were seen, crosses where they are predicted.

    ``errors`` (n, 2) are seen (n, 2) minus predicted, pixels. A line goes from each circle towards its cross,
    magnified; the largest errors have numbers, 1 for the largest.
    """
    left, top, right, bottom = _window(gray, seen)
    scale = SIDE_PX / max(right - left, bottom - top)
    size = (max(1, round(scale * (right - left))), max(1, round(scale * (bottom - top))))
    how = cv2.INTER_CUBIC if scale > 1.0 else cv2.INTER_AREA
    large = cv2.resize(gray[top:bottom, left:right], size, interpolation=how)
    picture = np.asarray(cv2.cvtColor(large, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    finite = np.isfinite(errors).all(axis=1)
    at, off = scaled(seen[finite] - [left, top], scale), -errors[finite]
    times = magnification(off, scale)
    ends, crosses = at + scale * times * off, at + scale * off
    mark = radius_between(at, 0.3, RADIUS)
    for start, end in zip(at, ends, strict=True):
        line(picture, start, end, WHITE, 4)
        line(picture, start, end, NOT_USED, 2)
    arms = mark * (ARM / RADIUS) * np.sqrt(0.5) * np.array([[1.0, 1.0], [1.0, -1.0]])
    for width, of_circle, of_cross in ((4, WHITE, WHITE), (2, USED, NOT_USED)):
        for place in at:
            circle(picture, place, mark, of_circle, width)
        for cross, arm in product(crosses, arms):
            line(picture, cross - arm, cross + arm, of_cross, width)
    order = np.argsort(-np.linalg.norm(off, axis=1), kind="stable")[:NUMBERED]
    most = np.array(picture.shape[1::-1]) - 1.5 * LETTERS
    words = []
    for number, i in enumerate(order.tolist(), start=1):
        x, y = np.clip(at[i] + [mark + 1.0, -mark - LETTERS], 1.0, most).tolist()
        words.append(Words((x, y), str(number), LETTERS, is_bold=True, outline=WHITE))
    return DrawnErrors(written(picture, words), times)


def magnification(errors: Array, scale: float) -> float:
    """How many times as long errors (n, 2), pixels, are drawn in a picture of a scale: 1, 2, 5, 10, 20, ..."""
    longest = scale * float(np.linalg.norm(errors, axis=1).max(initial=0.0))
    if longest <= 0.0:
        return 1.0
    times = LONGEST_PX / longest
    power = 10.0 ** np.floor(np.log10(times))
    return float(np.clip(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= times), 1.0, MOST_TIMES))


def _window(gray: Gray, seen: Array) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of a part of the image with the corners, of the shape `SHAPE` if the image allows it."""
    low, high = seen.min(axis=0), seen.max(axis=0)
    half = 0.5 * (high - low) + AROUND * float((high - low).max()) + 4.0
    limit = np.array(gray.shape[::-1], dtype=float)
    half = np.minimum(max(half[0], SHAPE * half[1]) * np.array([1.0, 1.0 / SHAPE]), 0.5 * limit)
    middle = np.clip(0.5 * (low + high), half, limit - half)
    left, top = np.floor(middle - half).astype(int).tolist()
    right, bottom = np.ceil(middle + half).astype(int).tolist()
    return max(left, 0), max(top, 0), right, bottom
