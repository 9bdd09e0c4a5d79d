"""OpenCV's dictionaries and detectors of tags, by the names of families."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

import cv2

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


def tag_detector(family: str, border_bits: int = 1) -> cv2.aruco.ArucoDetector:
    """A detector of a family's tags. Two threads must not use one detector at once."""
    return cv2.aruco.ArucoDetector(dictionary(family), _parameters(border_bits))


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
