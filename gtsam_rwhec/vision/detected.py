"""What detection finds: targets in an image, with poses or with the reason why they are not used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.rejection import Rejection


@dataclass(frozen=True, eq=False)
class Detection:
    """A target in an image.

    Attributes
    ----------
    target : str
        Name of the target.
    corners_px : (n, 2) array
        The corners that were seen, pixels.
    indices : (n,) integers
        Rows of these corners in ``Target.corners``.
    T : (2, 4, 4) array
        T_camera_target, metres: a plane's two candidates, the candidate of smaller reprojection error first; nan where
        a candidate is missing.
    squared_px : (2,) array
        Sum of squared reprojection errors, px^2.
    reprojection_px : (2,) array
        Root mean square of the reprojection errors, pixels.
    covariance : (2, 6, 6) array
        Covariance of the right perturbation [omega (rad), v (m)], from corner noise.
    side_px : float
        The shortest side of a tag, or of a board's bounding box, pixels.
    blur_px : float
        Standard deviation of the blur across a tag's edges, pixels; nan for boards.
    rejection : Rejection or None
        Why the detection is not used; None if it is used.
    note : str
        More about the rejection (what the rig file would have to say), or about the board.
    """

    target: str
    corners_px: Array
    indices: np.ndarray
    T: Array
    squared_px: Array
    reprojection_px: Array
    covariance: Array
    side_px: float
    blur_px: float
    rejection: Rejection | None = None
    note: str = ""

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
