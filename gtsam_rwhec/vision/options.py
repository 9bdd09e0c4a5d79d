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
