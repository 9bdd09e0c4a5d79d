"""Options of detection."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from gtsam_rwhec.errors import OptionError


@dataclass(frozen=True)
class DetectionOptions:
    """When a detection is not used. What is rejected is counted by reason, and stays in the log that is written.

    Attributes
    ----------
    min_side_px : float
        Shortest side of a tag (of a board's bounding box): below it corners move by large shares of it.
    min_corners : int
        Corners of a board.
    max_blur_px : float
        Standard deviation of the blur across a tag's edges: motion or focus.
    max_grazing_deg : float
        Between the line of sight and the target's normal.
    max_reprojection_px : float
        Root mean square over a detection's corners.
    ambiguity_margin : float
        How much less likely (difference of log-likelihoods) the other one of a plane's two poses must be, after the
        whole track has been looked at.
    corner_px : float
        Standard deviation of a corner along each axis, from which covariances are propagated; with ``noise: estimate``
        only their proportions count.
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
            raise OptionError(f"DetectionOptions.max_grazing_deg={self.max_grazing_deg!r}; 90 is from the side")
