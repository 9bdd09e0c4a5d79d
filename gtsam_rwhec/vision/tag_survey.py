"""A survey of the tags of all families in an image. Each place counts once: larger tags contain smaller families."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.dictionaries import tag_detector
from gtsam_rwhec.vision.images import Gray

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
    """A tag in an image.

    Attributes
    ----------
    family : str
    id : int
    is_double : bool
        Whether the tag has an AprilGrid's double border.
    middle_px : (2,) array
        Mean of the corners, pixels.
    side_px : float
        Longest side, pixels.
    corners_px : (4, 2) array
        From the top left, clockwise, as printed; pixels.
    """

    family: str
    id: int
    is_double: bool
    middle_px: Array
    side_px: float
    corners_px: Array


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
    corners, ids, _ = tag_detector(family, border_bits).detectMarkers(gray)
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
