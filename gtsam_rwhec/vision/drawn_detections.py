"""Drawings of detections in their images: used and rejected detections have different colours."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs.records import DetectionRecord
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.images import Gray

#: A used detection has this colour (blue, green, red), a blue of Okabe and Ito's palette for colour-blind people.
USED = (178, 114, 0)
#: A detection that is not used has this colour, the vermilion of the same palette.
NOT_USED = (0, 94, 213)
#: The axes x, y, z have these colours.
AXES = (NOT_USED, (115, 158, 0), USED)
#: OpenCV draws at places with this number of bits below the pixel, so to 1/16 of a pixel.
SHIFT = 4
#: An axis is this long, as a share of the target's distance.
AXIS = 0.08


def draw(gray: Gray, detections: Iterable[DetectionRecord], camera: Camera) -> NDArray[np.uint8]:
    """Draw outlines of tags, corners of boards, axes of used detections, and names with reasons, on an image.

    The picture (height, width, 3) has the colours (blue, green, red), as OpenCV writes them.
    """
    picture = np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    for record in detections:
        if record.corners_px is None or not len(record.corners_px):
            continue
        colour = NOT_USED if record.reason else USED
        corners = record.corners_px
        if len(corners) == 4:
            cv2.polylines(picture, [_fixed(corners)], True, colour, 1, cv2.LINE_AA, SHIFT)
        else:
            for corner in _fixed(corners):
                cv2.circle(picture, tuple(corner.tolist()), 3 << SHIFT, colour, 1, cv2.LINE_AA, SHIFT)
        if record.T_camera_tag is not None and not record.reason:
            _draw_axes(picture, record.T_camera_tag, camera)
        place = np.rint(corners[np.argmin(corners[:, 1])] + [0.0, -6.0]).astype(int).tolist()
        cv2.putText(picture, record.label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 3, cv2.LINE_AA)
        cv2.putText(picture, record.label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
    return picture


def _draw_axes(picture: NDArray[np.uint8], T: Array, camera: Camera) -> None:
    length = AXIS * float(np.linalg.norm(T[:3, 3]))
    points = np.vstack([np.zeros(3), length * np.eye(3)]) @ T[:3, :3].T + T[:3, 3]
    pixels = camera.project(points)
    if not np.isfinite(pixels).all():
        return
    start, *ends = _fixed(pixels)
    for end, colour in zip(ends, AXES, strict=True):
        cv2.line(picture, tuple(start.tolist()), tuple(end.tolist()), colour, 2, cv2.LINE_AA, SHIFT)


def _fixed(pixels: Array) -> NDArray[np.int32]:
    """OpenCV's fixed-point places. They are clipped, since places far outside do not fit."""
    return np.rint(np.clip(pixels, -1e4, 1e5) * (1 << SHIFT)).astype(np.int32)
