"""Pictures as JPEG files of a limited size."""

from __future__ import annotations

import cv2
import numpy as np

from gtsam_rwhec.vision.picture_text import Picture

#: Qualities that are tried, the best first; where the last is too large the picture is made smaller.
QUALITIES = (85, 70, 55)
#: A picture is made smaller by this factor at a time, down to so many pixels.
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
