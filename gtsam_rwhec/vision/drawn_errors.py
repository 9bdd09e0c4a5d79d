"""A drawing of corners in their image: where they were seen, where an answer has them, and the errors, magnified."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.drawn_detections import NOT_USED, SHIFT, USED, WHITE, scaled
from gtsam_rwhec.vision.images import Gray
from gtsam_rwhec.vision.picture_text import Picture, Words, written

#: The picture's longer side, pixels, and the part of the target's size that is around it.
SIDE_PX, AROUND = 720, 0.25
#: Width over height of the part of the image.
SHAPE = 4.0 / 3.0
#: Pixels: a circle's radius, a cross's arm, letters.
RADIUS, ARM, LETTERS = 7, 5, 17
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

    Parameters
    ----------
    gray : (height, width) array
    seen : (n, 2) array
        Pixels.
    errors : (n, 2) array
        Seen minus predicted, pixels. A line goes from each circle towards its cross, magnified; the largest errors have
        numbers, 1 for the largest.
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
    mark = _mark(at)
    for start, end in zip(_fixed(at).tolist(), _fixed(ends).tolist(), strict=True):
        cv2.line(picture, start, end, WHITE, 4, cv2.LINE_AA, SHIFT)
        cv2.line(picture, start, end, NOT_USED, 2, cv2.LINE_AA, SHIFT)
    arms = mark * (ARM / RADIUS) * np.sqrt(0.5) * np.array([[1.0, 1.0], [1.0, -1.0]])
    for width, is_outline in ((4, True), (2, False)):
        for place in _fixed(at).tolist():
            colour = WHITE if is_outline else USED
            cv2.circle(picture, place, round(mark * (1 << SHIFT)), colour, width, cv2.LINE_AA, SHIFT)
        for arm in arms:
            for start, end in zip(_fixed(crosses - arm).tolist(), _fixed(crosses + arm).tolist(), strict=True):
                cv2.line(picture, start, end, WHITE if is_outline else NOT_USED, width, cv2.LINE_AA, SHIFT)
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


def _mark(at: Array) -> float:
    """The radius of circles: those of neighbours do not meet."""
    if len(at) < 2:
        return float(RADIUS)
    apart = np.linalg.norm(at[:, None] - at, axis=2) + np.diag(np.full(len(at), np.inf))
    return float(np.clip(0.3 * np.median(apart.min(axis=1)), 3.0, RADIUS))


def _fixed(pixels: Array) -> NDArray[np.int32]:
    """OpenCV's fixed-point places. They are clipped, since places far outside do not fit."""
    return np.rint(np.clip(pixels, -1e4, 1e5) * (1 << SHIFT)).astype(np.int32)
