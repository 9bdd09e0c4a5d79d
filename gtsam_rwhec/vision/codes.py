"""Which tag of a family a quadrangle is, for many quadrangles and the whole family at once.

OpenCV compares one candidate with one code after another: in large families this takes most of the time of detection,
with OpenCV 5 nearly all of it. So it is given only the tags that are looked for, and those of no target are found and
read here, once an image for all families and without OpenCV's care for the last of them. (The candidates that OpenCV
rejects will not do: of a tag and the outline of its white margin it hands out one.)

Measured on 2026-11-21 with OpenCV 5.0.0 on the shipped log's images of 640 x 480, two families, one core
(tests/benchmarks/own_code_against_libraries.py): finding and reading every quadrangle takes 6 ms an image as here, 38
ms with ``Dictionary.identify`` for each quadrangle, and 255 ms with ``ArucoDetector`` and whole families. Detection of
the targets takes 13 ms. All three read the same tags.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.dictionaries import dictionary
from gtsam_rwhec.vision.images import Gray

#: A quadrangle's edges: window (pixels) and difference of the threshold, how far a contour may be off as a share of its
#: length, and its shortest side: a tag of 8 modules has 1.5 pixels for each.
WINDOW, DARKER, OFF, LEAST_PX = 23, 7, 0.03, 12.0
#: Looks into a cell along each side, as shares of it.
LOOKS = np.array([0.3, 0.5, 0.7])
#: Below this difference of its darkest and brightest cells a quadrangle is one gray.
LEAST_CONTRAST = 15.0
#: Shares of wrong bits: of the border's, and of those that a family's distances allow to correct (OpenCV's).
BORDER_ERRORS, CORRECTED = 0.35, 0.6
#: Quadrangles whose middles are nearer than this share of the smaller one are one tag.
SAME_TAG = 0.25


@cache
def codes(family: str) -> tuple[Array, int]:
    """Bits of a family's tags, 1 and -1, and how many of a tag's may be wrong: (count, 4, n n), turned by quarters."""
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
    """Ids (N,) of quadrangles (N, 4, 2), pixels, clockwise; -1 for what is no tag of the family."""
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
    """(N, modules, modules) booleans: which cells are white; all of them where there is no contrast."""
    if not len(quads):
        return np.ones((0, modules, modules), dtype=bool)
    along = ((np.arange(modules)[:, None] + LOOKS) / modules).ravel()
    places = np.stack(np.broadcast_arrays(along, along[:, None], 1.0), axis=-1).reshape(-1, 3)
    seen = places @ _from_unit_square(quads).transpose(0, 2, 1)
    x, y = ((seen[..., i] / seen[..., 2]).astype(np.float32) for i in range(2))
    looks = cv2.remap(gray, x, y, cv2.INTER_LINEAR).astype(np.float32)
    cells = looks.reshape(len(quads), modules, len(LOOKS), modules, len(LOOKS)).mean(axis=(2, 4))
    dark, bright = np.percentile(cells, (5, 95), axis=(1, 2))[..., None, None]
    white: np.ndarray = (cells > 0.5 * (dark + bright)) | (bright - dark < LEAST_CONTRAST)
    return white


def _from_unit_square(quads: Array) -> Array:
    """Homographies (N, 3, 3) that take (0, 0), (1, 0), (1, 1), (0, 1) to the corners (N, 4, 2)."""
    first, second, third, fourth = quads.transpose(1, 0, 2)
    bend = first - second + third - fourth
    sides = np.stack([second - third, fourth - third], axis=2)  # bend = sides (g, h), from the corner (1, 1)
    det = np.linalg.det(sides)
    sides[np.abs(det) < 1e-9] = np.eye(2)  # three corners on a line: no tag, whatever is read
    gh = np.linalg.solve(sides, bend[..., None])[..., 0]
    H = np.ones((len(quads), 3, 3))
    H[:, :2, 0] = second - first + gh[:, :1] * second
    H[:, :2, 1] = fourth - first + gh[:, 1:] * fourth
    H[:, :2, 2] = first
    H[:, 2, :2] = gh
    return H


def unlike(quads: Array, others: Array) -> Array:
    """Those of quadrangles (N, 4, 2) that are neither one of others (M, 4, 2) nor a second find of an earlier one."""
    everything = np.concatenate([others, quads])
    middles = everything.mean(axis=1)
    size = np.linalg.norm(everything - middles[:, None], axis=2).mean(axis=1)
    near = np.linalg.norm(middles[:, None] - middles, axis=2) < SAME_TAG * np.minimum(size[:, None], size)
    alone: Array = quads[~np.tril(near, -1).any(axis=1)[len(others) :]]
    return alone
