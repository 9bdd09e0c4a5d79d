"""The ids of tags in many quadrangles, read against a whole family at once.

OpenCV compares each candidate with one code after another: in large families this takes most of the time of detection,
with OpenCV 5 nearly all of it. Therefore OpenCV searches only for the targets' tags. Tags of no target are found and
read here, once in each image for all families; a few of them may be missed. OpenCV's rejected candidates cannot serve:
of a tag and the outline of its white margin OpenCV returns only one.

Measured on 2026-11-21 with OpenCV 5.0.0 on the shipped log's images of 640 x 480, two families, one core
(benchmarks/own_code_against_libraries.py): finding and reading every quadrangle takes 6 ms an image as here, 38
ms with ``Dictionary.identify`` for each quadrangle, and 255 ms with ``ArucoDetector`` and whole families. Detection of
the targets takes 13 ms. All three ways read the same tags.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.dictionaries import dictionary
from gtsam_rwhec.vision.edge_geometry import from_unit_square
from gtsam_rwhec.vision.images import Gray

#: The window of the adaptive threshold has this side (pixels).
WINDOW = 23
#: A dark pixel is darker than the mean of its window by this gray value.
DARKER = 7
#: A contour may be this far from its quadrangle, as a share of the contour's length.
OFF = 0.03
#: A quadrangle's sides must be this long (pixels): 1.5 pixels for each of a tag's 8 modules.
LEAST_PX = 12.0
#: A cell is sampled at these places along each of its sides, as shares of the side.
LOOKS = np.array([0.3, 0.5, 0.7])
#: The brightest and the darkest cells of a tag must differ by at least this gray value.
LEAST_CONTRAST = 15.0
#: At most this share of a border's bits may be wrong (OpenCV's value).
BORDER_ERRORS = 0.35
#: Of the bits that a family's distances allow to correct, this share is corrected (OpenCV's value).
CORRECTED = 0.6
#: Two quadrangles are one tag if their middles are nearer than this share of the smaller quadrangle's size.
SAME_TAG = 0.25


@cache
def codes(family: str) -> tuple[Array, int]:
    """Bits (count, 4, n n) of a family's tags in four quarter turns, 1 and -1, and how many bits may be wrong."""
    tags = dictionary(family)
    n = int(tags.markerSize)
    bits = np.array([cv2.aruco.Dictionary.getBitsFromByteList(row[None], n) for row in tags.bytesList])
    turned = np.stack([np.rot90(bits, turn, axes=(1, 2)) for turn in range(4)], axis=1)
    signs: Array = 2.0 * turned.reshape(len(bits), 4, n * n) - 1.0
    return signs, int(tags.maxCorrectionBits * CORRECTED)


def quadrangles(gray: Gray) -> Array:
    """Dark quadrangles (N, 4, 2) of an image, pixels, clockwise."""
    dark = cv2.adaptiveThreshold(gray, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, WINDOW, DARKER)
    contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    found = []
    for contour in contours:
        if len(contour) < 4 * LEAST_PX:
            continue
        corners = cv2.approxPolyDP(contour, OFF * len(contour), True)
        if len(corners) == 4 and cv2.isContourConvex(corners):
            found.append(corners[:, 0])
    quads = np.array(found, dtype=float).reshape(-1, 4, 2)
    first, second = quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]
    backwards = first[:, 0] * second[:, 1] < first[:, 1] * second[:, 0]
    quads[backwards] = quads[backwards, ::-1]
    sides = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2)
    large: Array = quads[sides.min(axis=1) >= LEAST_PX]
    return large


def identified(gray: Gray, quads: Array, family: str, border_bits: int = 1) -> np.ndarray:
    """Ids (N,) of clockwise quadrangles (N, 4, 2) in pixels; an id is -1 if the quadrangle is no tag of the family."""
    signs, correctable = codes(family)
    n = round(np.sqrt(signs.shape[2]))
    white = _white_cells(gray, quads, n + 2 * border_bits)
    inside = white[:, border_bits : border_bits + n, border_bits : border_bits + n]
    wrong_border = white.sum(axis=(1, 2)) - inside.sum(axis=(1, 2))
    ids = np.full(len(quads), -1)
    some = np.flatnonzero(wrong_border <= BORDER_ERRORS * (white[0].size - n * n)) if len(quads) else ids
    if not len(some):
        return ids
    read = 2.0 * inside[some].reshape(len(some), n * n) - 1.0
    distance = 0.5 * (n * n - read @ signs.reshape(-1, n * n).T)
    nearest = np.argmin(distance, axis=1)
    good = distance[np.arange(len(some)), nearest] <= correctable
    ids[some[good]] = nearest[good] // 4
    return ids


def _white_cells(gray: Gray, quads: Array, modules: int) -> np.ndarray:
    """Say which cells are white, as (N, modules, modules) booleans; all are true where there is no contrast."""
    if not len(quads):
        return np.ones((0, modules, modules), dtype=bool)
    along = ((np.arange(modules)[:, None] + LOOKS) / modules).ravel()
    places = np.stack(np.broadcast_arrays(along, along[:, None], 1.0), axis=-1).reshape(-1, 3)
    # Three corners on a line give no finite homography and no tag.
    H = np.nan_to_num(from_unit_square(quads), posinf=0.0, neginf=0.0)
    seen = places @ H.transpose(0, 2, 1)
    x, y = ((seen[..., i] / seen[..., 2]).astype(np.float32) for i in range(2))
    looks = cv2.remap(gray, x, y, cv2.INTER_LINEAR).astype(np.float32)
    cells = looks.reshape(len(quads), modules, len(LOOKS), modules, len(LOOKS)).mean(axis=(2, 4))
    dark, bright = np.percentile(cells, (5, 95), axis=(1, 2))[..., None, None]
    white: np.ndarray = (cells > 0.5 * (dark + bright)) | (bright - dark < LEAST_CONTRAST)
    return white


def unlike(quads: Array, others: Array) -> Array:
    """The quadrangles (N, 4, 2) that are neither among others (M, 4, 2) nor the same tag as an earlier quadrangle."""
    everything = np.concatenate([others, quads])
    middles = everything.mean(axis=1)
    size = np.linalg.norm(everything - middles[:, None], axis=2).mean(axis=1)
    near = np.linalg.norm(middles[:, None] - middles, axis=2) < SAME_TAG * np.minimum(size[:, None], size)
    alone: Array = quads[~np.tril(near, -1).any(axis=1)[len(others) :]]
    return alone
