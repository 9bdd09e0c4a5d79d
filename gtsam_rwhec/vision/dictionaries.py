"""OpenCV's dictionaries and detectors by the names of families."""

from __future__ import annotations

from functools import cache

import cv2

from gtsam_rwhec.vision.targets import FAMILIES


@cache
def dictionary(family: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a family (a key of `FAMILIES`)."""
    if family.startswith("tag"):
        name = f"DICT_APRILTAG_{family[3:]}"
    else:
        name = "DICT_" + family.removeprefix("aruco_").replace("x", "X")
        name = {"DICT_original": "DICT_ARUCO_ORIGINAL", "DICT_mip_36h12": "DICT_ARUCO_MIP_36h12"}.get(name, name)
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def modules(family: str, border_bits: int = 1) -> int:
    """Along a tag's side, borders included."""
    return int(dictionary(family).markerSize) + 2 * border_bits


def tag_detector(family: str, border_bits: int = 1) -> cv2.aruco.ArucoDetector:
    """A detector of a family's tags. Not safe to use from two threads."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE  # done by us, from the edges
    parameters.markerBorderBits = border_bits
    return cv2.aruco.ArucoDetector(dictionary(family), parameters)


#: One dictionary of each kind, the largest: ArUco's smaller ones are its beginnings.
WIDEST = tuple(
    family for family in FAMILIES if family.startswith("tag") or family.endswith(("_1000", "original", "36h12"))
)
