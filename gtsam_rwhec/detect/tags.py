"""OpenCV's dictionaries and detectors of tags by the names of families, tags of no target, and surveys of all families.

OpenCV compares each candidate with one code after another, which takes most of the time of detection in large
families. So OpenCV searches only for the targets' tags; tags of no target are found and read here, once in each image
for all families, 40 times as fast.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from gtsam_rwhec.detect.images import Gray
from gtsam_rwhec.detect.tag_edges import from_unit_square
from gtsam_rwhec.geometry.poses import Array

#: Tags of sides of this many pixels are looked for: OpenCV's limit, a share of the image, is 14 pixels at 1080p.
LEAST_PX = 10.0


@cache
def dictionary(family: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a family (a key of `targets.FAMILIES`)."""
    if family.startswith("tag"):
        name = f"DICT_APRILTAG_{family[3:]}"
    else:
        name = "DICT_" + family.removeprefix("aruco_").replace("x", "X")
        name = {"DICT_original": "DICT_ARUCO_ORIGINAL", "DICT_mip_36h12": "DICT_ARUCO_MIP_36h12"}.get(name, name)
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def modules(family: str, border_bits: int = 1) -> int:
    """The number of modules along a tag's side, with both borders."""
    return int(dictionary(family).markerSize) + 2 * border_bits


def detector_of(
    ids: Mapping[str, Sequence[int]], border_bits: int = 1, *, larger_side_px: int = 640
) -> cv2.aruco.ArucoDetector:
    """A detector of some tags of several families, for ``detectMarkersMultiDict``.

    The smallest tag that it finds in images of this larger side has sides of `LEAST_PX`, or of OpenCV's share of it.

    The detector returns an id as an index into the family's `ids`, and a family as an index into the families. Two
    threads must not use one detector at once.
    """
    some = []
    for family, wanted in ids.items():
        tags = dictionary(family)
        some.append(cv2.aruco.Dictionary(tags.bytesList[list(wanted)], tags.markerSize, tags.maxCorrectionBits))
    parameters = _parameters(border_bits)
    parameters.minMarkerPerimeterRate = min(parameters.minMarkerPerimeterRate, 4.0 * LEAST_PX / larger_side_px)
    return cv2.aruco.ArucoDetector(some, parameters)


def _parameters(border_bits: int) -> cv2.aruco.DetectorParameters:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE  # we refine the corners from the edges
    parameters.markerBorderBits = border_bits
    return parameters


#: The window of the adaptive threshold has this side (pixels).
WINDOW = 23
#: A dark pixel is darker than the mean of its window by this gray value.
DARKER = 7
#: A contour may be this far from its quadrangle, as a share of the contour's length.
OFF = 0.03
#: A quadrangle's sides must be this long (pixels): 1.5 pixels for each of a tag's 8 modules.
LEAST_SIDE_PX = 12.0
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
        if len(contour) < 4 * LEAST_SIDE_PX:
            continue
        corners = cv2.approxPolyDP(contour, OFF * len(contour), True)
        if len(corners) == 4 and cv2.isContourConvex(corners):
            found.append(corners[:, 0])
    quads = np.array(found, dtype=float).reshape(-1, 4, 2)
    first, second = quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]
    backwards = first[:, 0] * second[:, 1] < first[:, 1] * second[:, 0]
    quads[backwards] = quads[backwards, ::-1]
    sides = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2)
    large: Array = quads[sides.min(axis=1) >= LEAST_SIDE_PX]
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


#: Families are in the order of trust: the first one's codes (many bits, few tags, far apart) arise by chance least.
BY_TRUST = (
    "tag36h11", "aruco_mip_36h12", "aruco_7x7_1000", "aruco_6x6_1000", "tag36h10", "tag25h9", "aruco_5x5_1000",
    "aruco_original", "tag16h5", "aruco_4x4_1000",
)  # fmt: skip
#: The family of Kalibr's AprilGrids, which have a double border.
DOUBLE = "tag36h11"
#: A flattened tag has this side, in pixels.
SIDE = 50


@dataclass(frozen=True, eq=False)
class SeenTag:
    """A tag in an image."""

    family: str
    id: int
    is_double: bool  #: Whether the tag has an AprilGrid's double border
    middle_px: Array  #: (2,): mean of the corners, pixels
    side_px: float  #: Longest side, pixels
    corners_px: Array  #: (4, 2): from the top left, clockwise, as printed; pixels


def tags_in_image(gray: Gray, families: Iterable[str] = BY_TRUST) -> list[SeenTag]:
    """Tags of some of the families in `BY_TRUST`.

    Where two families are read at one place (middles less than half a side apart), the more trustworthy family counts.
    """
    wanted = set(families)
    found: list[SeenTag] = []
    for family in BY_TRUST:
        if family in wanted:
            for border_bits in (2, 1) if family == DOUBLE else (1,):
                tags = _of_family(gray, family, border_bits)
                found += [tag for tag in tags if not any(_overlap(tag, other) for other in found)]
    return found


def _of_family(gray: Gray, family: str, border_bits: int) -> list[SeenTag]:
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary(family), _parameters(border_bits)).detectMarkers(gray)
    if ids is None:
        return []
    quads = np.reshape(corners, (-1, 4, 2)).astype(np.float32)
    sides = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2).max(axis=1)
    return [
        SeenTag(
            family, int(i), family == DOUBLE and _has_double_border(gray, quad), quad.mean(axis=0), float(side), quad
        )
        for i, quad, side in zip(np.ravel(ids), quads, sides, strict=True)
    ]


def _has_double_border(gray: Gray, quad: Array) -> bool:
    """Whether a tag is black in its first and second tenth from the edge, all around.

    A double border (10 modules along the side) is black to 0.2 of the side. A single border (8 modules) ends at 0.125,
    where the code's outer ring begins; no tag of the family has an all black ring. OpenCV's detector cannot tell: its
    error correction reads either tag with either border.
    """
    square = np.array([[0, 0], [SIDE, 0], [SIDE, SIDE], [0, SIDE]], dtype=np.float32) - 0.5
    flat = cv2.warpPerspective(gray, cv2.getPerspectiveTransform(quad.astype(np.float32), square), (SIDE, SIDE))
    dark = cv2.threshold(flat, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)[1] == 0
    for depth in (0.06, 0.16):
        near, far = round(depth * SIDE), SIDE - 1 - round(depth * SIDE)
        ring = [*dark[near, near:far], *dark[far, near:far], *dark[near:far, near], *dark[near:far, far]]
        if np.mean(ring) < 0.9:
            return False
    return True


def _overlap(first: SeenTag, second: SeenTag) -> bool:
    distance = float(np.linalg.norm(first.middle_px - second.middle_px))
    return distance < 0.5 * max(first.side_px, second.side_px)
