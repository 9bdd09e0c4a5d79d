"""The options of detection: limits, and the noise of corners."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from gtsam_rwhec.errors import OptionError


@dataclass(frozen=True)
class DetectionOptions:
    """Limits beyond which a detection is not used.

    Rejected detections are counted by reason and stay in the log that is written.

    Attributes
    ----------
    min_side_px : float
        Least length of a tag's sides, or of a board's bounding box, pixels: errors of corners are a large share of a
        shorter side.
    min_corners : int
        Least number of a board's corners.
    max_blur_px : float
        Largest standard deviation of the blur across a tag's edges, pixels. Motion and wrong focus blur.
    max_grazing_deg : float
        Largest angle between the line of sight and the target's normal, degrees; 90 is from the side.
    max_reprojection_px : float
        Largest root mean square of the reprojection errors of a detection's corners, pixels.
    ambiguity_margin : float
        Least difference of log-likelihoods between the chosen pose of a plane and its other candidate, over the whole
        track.
    corner_px : float
        Standard deviation of a corner along each axis, pixels: it gives the poses' covariances. With ``noise:
        estimate`` only the proportions of the covariances count.
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
