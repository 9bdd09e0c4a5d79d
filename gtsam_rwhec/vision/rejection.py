"""The reasons why a detection is not used."""

from __future__ import annotations

from enum import StrEnum


class Rejection(StrEnum):
    """Why a detection is not used. The values are the words in logs, reports and pictures.

    `DetectionOptions` has the limits.
    """

    SMALL = "small"
    BLURRED = "blurred"
    GRAZING = "grazing"
    FEW_CORNERS = "too few corners"
    SEEN_TWICE = "seen twice in one image"
    NO_EDGES = "edges not found"
    NO_POSE = "no pose"
    NO_RAY = "the intrinsics have no ray for a corner: their distortion folds back"
    REPROJECTION = "reprojection error"
    AMBIGUOUS = "ambiguous"
    NOT_A_GRID = "corners not on one plane's grid"
    LAYOUT = "tags are not where the rig file has them"
    NOT_WHOLE = "board not whole in the image"
    SQUARES = "squares do not alternate as printed"
    CIRCLES = "circles not of the sizes as printed, or the larger dot not at its corner"
    OTHER_SIZE = "board goes on: other columns or rows"
