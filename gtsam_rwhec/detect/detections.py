"""What detection finds: targets in an image, with poses or with the reason why they are not used; its options."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import StrEnum

import numpy as np
from rwhec_factors.se3 import pose

from gtsam_rwhec.cameras.board_turns import turns_about_z
from gtsam_rwhec.cameras.targets import Checkerboard, CircleGrid
from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array


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
    NOT_REGISTERED = "the cloud fits no other where its pose puts it"


@dataclass(frozen=True)
class DetectionOptions:
    """Limits beyond which a detection is not used.

    Rejected detections are counted by reason and stay in the log that is written.

    Attributes
    ----------
    min_side_px : float
        A tag's sides, or a board's bounding box, must be at least this long (pixels): errors of corners are a large
        share of a shorter side.
    min_corners : int
        At least this number of a board's corners must be seen.
    max_blur_px : float
        The blur across a tag's edges may have at most this standard deviation (pixels). Motion and wrong focus blur.
    max_grazing_deg : float
        The line of sight may be at most this far from the target's normal, degrees; 90 is from the side.
    max_reprojection_px : float
        The reprojection errors of a detection's corners may have at most this root mean square, pixels.
    ambiguity_margin : float
        The log-likelihood of a plane's chosen pose must exceed that of its other candidate by at least this, over the
        whole track.
    corner_px : float
        A corner has this standard deviation along each axis (pixels). The poses' covariances follow from it. With
        ``noise: estimate`` only the proportions of the covariances count.
    """

    min_side_px: float = 12.0
    min_corners: int = 6
    max_blur_px: float = 3.0
    max_grazing_deg: float = 78.0
    max_reprojection_px: float = 1.0
    ambiguity_margin: float = 3.0
    corner_px: float = 0.1

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not (0.0 < value < np.inf):
                raise OptionError(f"DetectionOptions.{field.name}={value!r}; give a positive number")
        if self.max_grazing_deg > 90.0:
            raise OptionError(
                f"DetectionOptions.max_grazing_deg={self.max_grazing_deg!r}; give at most 90, which is from the side"
            )


@dataclass(frozen=True, eq=False)
class Detection:
    """A target in an image."""

    target: str  #: Name of the target
    corners_px: Array  #: (n, 2): the corners that were seen, pixels
    indices: np.ndarray  #: (n,): rows of these corners in ``Target.corners``.
    #: (2, 4, 4): T_camera_target, metres: a plane's two candidates, the candidate of smaller reprojection error first;
    #: nan where a candidate is missing
    T: Array
    squared_px: Array  #: (2,): sum of squared reprojection errors, px^2
    reprojection_px: Array  #: (2,): root mean square of the reprojection errors, pixels
    covariance: Array  #: (2, 6, 6): covariance of the right perturbation [omega (rad), v (m)], from corner noise
    side_px: float  #: The shortest side of a tag, or of a board's bounding box, pixels
    blur_px: float  #: Standard deviation of the blur across a tag's edges, pixels; nan for boards
    rejection: Rejection | None = None  #: Why the detection is not used; None if it is used
    note: str = ""  #: More about the rejection (what the rig file would have to say), or about the board

    def reason(self, rejection: Rejection | None) -> str:
        """The words for a reason why this detection is not used, with the note; empty if it is used."""
        return f"{rejection}: {self.note}" if rejection is Rejection.LAYOUT and self.note else rejection or ""


@dataclass(frozen=True)
class ImageDetections:
    """The targets detected in one image, and the number of tags that belong to no target, by family and id."""

    detections: tuple[Detection, ...]
    strangers: dict[tuple[str, int], int]


def layouts_over_track(track: Sequence[Detection]) -> list[Detection]:
    """A target's detections, none used if other images contradict its layout.

    An image with a few tags of one row agrees with many layouts; one contradiction may be a chance, two are not.
    """
    contradicted = [detection for detection in track if detection.rejection is Rejection.LAYOUT]
    notes = Counter(detection.note for detection in contradicted if detection.note)
    note, count = notes.most_common(1)[0] if notes else ("", 0)
    if not (count > 1 or len(contradicted) > 0.5 * len(track)):
        return list(track)
    return [
        replace(detection, rejection=Rejection.LAYOUT, note=note)
        if detection.rejection in (None, Rejection.LAYOUT)
        else detection
        for detection in track
    ]


def turned_detection(detection: Detection, board: Checkerboard | CircleGrid, turn: int) -> Detection:
    """The same corners with the numbers and the pose that they have if the board is turned by `turn` of its ways."""
    if turn == 0:
        return detection
    R = turns_about_z(board.ways)[turn]
    corners = board.corners()
    # A point p of the turned frame is R p in the frame before.
    apart = np.linalg.norm((corners[detection.indices] @ R)[:, None] - corners, axis=2)
    indices = np.argmin(apart, axis=1)
    order = np.argsort(indices)
    T = pose(R, np.zeros(3))
    back = np.kron(np.eye(2), R.T)
    return replace(
        detection,
        indices=indices[order],
        corners_px=detection.corners_px[order],
        T=detection.T @ T,
        covariance=back @ detection.covariance @ back.T,
    )
