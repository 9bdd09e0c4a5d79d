"""Drawings of detections in their images, for people who want to see what was read, and why some was not used.

Used and rejected detections differ in colour (for colour-blind people too) and in form: what is used has upright
crosses and solid lines, what is rejected has oblique crosses and dashed lines.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs.records import DetectionRecord
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.images import Gray
from gtsam_rwhec.vision.picture_text import Colour, Picture, Words, fitted, width_of, written

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
        _draw_order(picture, corners, is_closed=len(corners) == 4, colour=colour, is_dashed=bool(record.reason))
        _draw_corners(picture, corners, mark, colour, is_oblique=bool(record.reason))
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


def dashed_line(picture: Picture, start: Array, end: Array, colour: Colour, width: int = 1) -> None:
    """A line of dashes between two places."""
    length = float(np.linalg.norm(end - start))
    if not np.isfinite(length) or length > 1e5:
        return
    count = max(1, round(0.5 * length / DASH_PX))
    ends = np.linspace(start, end, 2 * count, endpoint=False)
    for a, b in zip(_fixed(ends[::2]), _fixed(ends[1::2]), strict=True):
        cv2.line(picture, tuple(a.tolist()), tuple(b.tolist()), colour, width, cv2.LINE_AA, SHIFT)


def _draw_order(picture: Picture, corners: Array, *, is_closed: bool, colour: Colour, is_dashed: bool) -> None:
    """A thin line through the corners in their order, closed for a tag's four."""
    if is_dashed:
        around = np.vstack([corners, corners[:1]]) if is_closed else corners
        for start, end in pairwise(around):
            dashed_line(picture, start, end, colour)
    else:
        cv2.polylines(picture, [_fixed(corners)], is_closed, colour, 1, cv2.LINE_AA, SHIFT)


def _draw_corners(picture: Picture, corners: Array, mark: float, colour: Colour, *, is_oblique: bool) -> None:
    """A cross at each corner, open in its middle so that the corner is seen, and a ring around the first."""
    if len(corners) > 1:  # crosses of neighbours do not meet
        apart = np.linalg.norm(corners[:, None] - corners, axis=2) + np.diag(np.full(len(corners), np.inf))
        mark = float(np.clip(0.35 * np.median(apart.min(axis=1)), 3.0, mark))
    arms = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    if is_oblique:
        arms = arms @ (np.sqrt(0.5) * np.array([[1.0, 1.0], [-1.0, 1.0]]))
    for width, tone in ((3, WHITE), (1, colour)):
        for arm in arms:
            starts, ends = _fixed(corners + 0.3 * mark * arm), _fixed(corners + mark * arm)
            for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
                cv2.line(picture, start, end, tone, width, cv2.LINE_AA, SHIFT)
        first = tuple(_fixed(corners[:1])[0].tolist())
        cv2.circle(picture, first, round(1.7 * mark * (1 << SHIFT)), tone, width + 1, cv2.LINE_AA, SHIFT)


def _draw_axes(picture: Picture, T: Array, camera: Camera, scale: float, letters: int) -> list[Words]:
    """The axes of a target's frame; their letters."""
    length = AXIS * float(np.linalg.norm(T[:3, 3]))
    points = np.vstack([np.zeros(3), length * np.eye(3)]) @ T[:3, :3].T + T[:3, 3]
    pixels = camera.project(points)
    if not np.isfinite(pixels).all():
        return []
    start, *ends = _fixed(scaled(pixels, scale))
    words = []
    for end, colour, name in zip(ends, AXES, "xyz", strict=True):
        cv2.line(picture, tuple(start.tolist()), tuple(end.tolist()), colour, 2, cv2.LINE_AA, SHIFT)
        place = np.clip(end / (1 << SHIFT) + 2.0, 0.0, np.array(picture.shape[1::-1]) - 1.0)
        words.append(Words((float(place[0]), float(place[1])), name, letters, colour, is_bold=True, outline=WHITE))
    return words


def _fixed(pixels: Array) -> NDArray[np.int32]:
    """OpenCV's fixed-point places. They are clipped, since places far outside do not fit."""
    return np.rint(np.clip(pixels, -1e4, 1e5) * (1 << SHIFT)).astype(np.int32)
