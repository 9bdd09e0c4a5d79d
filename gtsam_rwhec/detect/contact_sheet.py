"""A contact sheet: small pictures of some of each sensor's images, with what became of each.

What became of an image is told by a mark, by the kind of frame, and in words; the colours (of Okabe and Ito's palette
for colour-blind people) only help.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np

from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.detect.pictures import (
    NOT_USED,
    USED,
    WHITE,
    Colour,
    Picture,
    Words,
    circle,
    fitted,
    line,
    wrapped,
    written,
)
from gtsam_rwhec.geometry.poses import Array

#: Pixels: the width of a small picture, the gap between two, the height of a sensor's header and of a line of text.
WIDTH, GAP, HEADER, LINE = 232, 14, 40, 16
#: Small pictures in a row.
ACROSS = 6
#: Heights of letters, pixels.
TITLE, SMALL = 17, 12
#: Lines of text below a small picture, its name among them.
LINES = 3
#: A small picture is at most this many times as high as wide.
TALLEST = 1.4
#: A target that is narrower and lower than this share of the image's width is shown larger in a corner, so many pixels
#: wide and high, with this share of its size around it.
SMALL_SHARE, DETAIL, AROUND = 0.3, 84, 0.4
INK, GRAY, PAPER = (40, 40, 40), (150, 150, 150), (225, 225, 225)


class Outcome(Enum):
    """What became of an image: its mark, its words, its colour."""

    FOUND = ("✓", "found", USED)
    REJECTED = ("✗", "rejected", NOT_USED)
    NOTHING = ("–", "nothing seen", GRAY)
    FAILED = ("!", "not usable", INK)

    def __init__(self, mark: str, word: str, colour: Colour) -> None:
        self.mark, self.word, self.colour = mark, word, colour


@dataclass(frozen=True, eq=False)
class Outline:
    """A detection in a small picture."""

    corners: Array  #: (n, 2): its corners, as shares of the image's width
    is_used: bool


@dataclass(frozen=True, eq=False)
class Detail:
    """A target, larger: its pixels (DETAIL, DETAIL), and its corners (n, 2) in them."""

    gray: Gray
    corners: Array


@dataclass(frozen=True, eq=False)
class Tile:
    """An image of the sheet."""

    outcome: Outcome
    name: str  #: The image's file name, or its stamp
    words: str  #: What is to be said: targets and reasons
    gray: Gray | None  #: (height, WIDTH): the small picture; None where the image cannot be decoded
    outlines: tuple[Outline, ...] = ()
    detail: Detail | None = None  #: The first target, enlarged; None if it is large in the image or missing


@dataclass(frozen=True, eq=False)
class Band:
    """The part of a sheet for one sensor: its name in bold, its counts in words, its images."""

    sensor: str
    counts: str
    tiles: tuple[Tile, ...]


def contact_sheet(bands: Sequence[Band]) -> Picture:
    """A picture (height, width, 3), blue, green, red, with a band for each sensor."""
    width = GAP + ACROSS * (WIDTH + GAP)
    return np.concatenate([_band(band, width) for band in bands] or [np.full((GAP, width, 3), 255, np.uint8)])


def detail_of(gray: Gray, outline: Outline) -> Detail | None:
    """Cut a square around a target, resized to `DETAIL` pixels; None if the target is not small in the image."""
    corners = outline.corners * gray.shape[1] - 0.5
    if not np.isfinite(corners).all() or float(np.ptp(outline.corners, axis=0).max()) > SMALL_SHARE:
        return None
    low, high = corners.min(axis=0), corners.max(axis=0)
    half = 0.5 * (1.0 + 2.0 * AROUND) * float((high - low).max()) + 2.0
    middle = np.clip(0.5 * (low + high), half, np.maximum(np.array(gray.shape[::-1]) - 1.0 - half, half))
    left, top = np.maximum(np.rint(middle - half), 0).astype(int)
    part = gray[top : top + round(2 * half), left : left + round(2 * half)]
    if not part.size or min(part.shape) < 0.8 * max(part.shape):
        return None
    large = np.asarray(cv2.resize(part, (DETAIL, DETAIL), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    places = (corners - [left, top] + 0.5) * DETAIL / np.array(part.shape[::-1]) - 0.5
    return Detail(large, np.asarray(places))


def _band(band: Band, width: int) -> Picture:
    heights = [tile.gray.shape[0] for tile in band.tiles if tile.gray is not None]
    most = round(TALLEST * WIDTH)
    height = min(int(np.median(heights)) if heights else round(0.6 * WIDTH), most)
    step = height + LINES * LINE + GAP + 6
    rows = -(-len(band.tiles) // ACROSS)
    counts = wrapped(band.counts, TITLE - 3, width - 2 * GAP, 3)
    header = HEADER + len(counts) * (TITLE + 4)
    picture: Picture = np.full((header + rows * step, width, 3), 255, np.uint8)
    cv2.rectangle(picture, (0, 0), (width, header - GAP), PAPER, -1)
    words = [Words((GAP, 8), fitted(band.sensor, TITLE + 2, width - 2 * GAP, is_bold=True), TITLE + 2, is_bold=True)]
    words += [Words((GAP, 12 + (i + 1) * (TITLE + 4)), said, TITLE - 3, INK) for i, said in enumerate(counts)]
    for i, tile in enumerate(band.tiles):
        left, top = GAP + (i % ACROSS) * (WIDTH + GAP), header + (i // ACROSS) * step
        picture[top : top + height, left : left + WIDTH] = _small_picture(tile, height)
        _frame(picture, left, top, height, tile.outcome)
        words += _caption(tile, left, top + height + 6)
        if tile.gray is None:
            words.append(Words((left + 0.42 * WIDTH, top + 0.3 * height), tile.outcome.mark, 44, INK, is_bold=True))
    return written(picture, words)


def _small_picture(tile: Tile, height: int) -> Picture:
    """The image with its outlines, cut or filled up to a height; hatched where there is none."""
    picture: Picture = np.full((height, WIDTH, 3), PAPER, np.uint8)
    if tile.gray is None:
        for x in range(-height, WIDTH, 14):
            cv2.line(picture, (x, height), (x + height, 0), WHITE, 4, cv2.LINE_AA)
        return picture
    gray = tile.gray[:height]
    picture[: len(gray)] = cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR)
    for outline in tile.outlines:
        corners = outline.corners * WIDTH - 0.5
        if not np.isfinite(corners).all() or np.abs(corners).max() > 10 * WIDTH:
            continue
        around = cv2.convexHull(corners.astype(np.float32))[:, 0].astype(float)
        colour = USED if outline.is_used else NOT_USED
        for start, end in zip(around, np.roll(around, -1, axis=0), strict=True):
            line(picture, start, end, WHITE, 4, is_dashed=not outline.is_used)
            line(picture, start, end, colour, 2, is_dashed=not outline.is_used)
        circle(picture, corners[0], 4, WHITE)
        circle(picture, corners[0], 3, colour)
    if tile.detail is not None and min(height, len(gray)) > DETAIL + 4:
        _draw_detail(picture, tile.detail, tile.outlines[0], min(height, len(gray)))
    return picture


def _draw_detail(picture: Picture, detail: Detail, outline: Outline, height: int) -> None:
    """Put a target's larger picture into the corner that is farthest from it, with a thin frame."""
    middle = outline.corners.mean(axis=0) * WIDTH
    left = 2 if middle[0] > 0.5 * WIDTH else WIDTH - DETAIL - 2
    top = 2 if middle[1] > 0.5 * height else height - DETAIL - 2
    cv2.rectangle(picture, (left - 2, top - 2), (left + DETAIL + 1, top + DETAIL + 1), WHITE, -1)
    inside: Picture = np.asarray(cv2.cvtColor(detail.gray, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    colour = USED if outline.is_used else NOT_USED
    for i, place in enumerate(detail.corners):
        circle(inside, place, 5 if i == 0 else 3, WHITE)
        circle(inside, place, 4 if i == 0 else 2, colour)
    picture[top : top + DETAIL, left : left + DETAIL] = inside


def _frame(picture: Picture, left: int, top: int, height: int, outcome: Outcome) -> None:
    """Found: a solid line. Rejected: dashes. Nothing seen: thin and gray. Not usable: a double line."""
    box = np.array([[left, top], [left + WIDTH, top], [left + WIDTH, top + height], [left, top + height]], dtype=float)
    box += np.array([[-2.0, -2.0], [1.0, -2.0], [1.0, 1.0], [-2.0, 1.0]])
    width = {Outcome.FOUND: 2, Outcome.REJECTED: 4, Outcome.NOTHING: 1, Outcome.FAILED: 3}[outcome]
    for start, end in zip(box, np.roll(box, -1, axis=0), strict=True):
        line(picture, start, end, outcome.colour, width, is_dashed=outcome is Outcome.REJECTED)
        if outcome is Outcome.FAILED:
            line(picture, start, end, WHITE)


def _caption(tile: Tile, left: int, top: int) -> list[Words]:
    colour = INK if tile.outcome in (Outcome.NOTHING, Outcome.FAILED) else tile.outcome.colour
    mark = Words((left, top - 2), tile.outcome.mark, SMALL + 4, colour, is_bold=True)
    name = Words((left + 20, top), fitted(tile.name, SMALL, WIDTH - 20, is_bold=True), SMALL, INK, is_bold=True)
    said = tile.outcome.word if not tile.words else f"{tile.outcome.word}: {tile.words}"
    lines = wrapped(said, SMALL, WIDTH, LINES - 1)
    return [mark, name] + [Words((left, top + (i + 1) * LINE), words, SMALL, INK) for i, words in enumerate(lines)]
