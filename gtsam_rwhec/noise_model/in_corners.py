"""What the noise of the poses adds to the covariance of a refinement from the same images' corners.

The corners' own model has errors of A that are independent from instant to instant. Where the poses show more (errors
that are alike in neighbours in time, that vary with the configuration of the arm, or stay the same), N instants are
worth W of independent ones, and the poses' covariances grow by N / W. A constant error of A changes no residual, of
poses or of corners: it moves the frames of one carrier together.
"""

from __future__ import annotations

import gtsam
import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.found import NoiseInData
from gtsam_rwhec.reprojection.refined import CornersRefined


def beyond_independent_errors(corners: CornersRefined, found: NoiseInData) -> Array:
    """The covariance (d, d) to add to that of the corners' unknowns."""
    size = len(corners.joint)
    wider = np.ones(size)
    factor = np.sqrt(max(found.instants / max(found.worth, 1e-300), 1.0))
    for (letter, _), rows in corners.slots.items():
        if letter in "xyt":
            wider[rows] = factor
    more: Array = corners.joint * (np.outer(wider, wider) - 1.0)
    carriers: tuple[tuple[str, dict[str, gtsam.Pose3]], ...] = (("x", corners.X), ("y", corners.Y))
    for (letter, poses), deviations in zip(carriers, found.constant_deviations, strict=True):
        shift = np.zeros((size, 6))
        for name, pose in poses.items():
            shift[corners.slots[letter, name]] = pose.inverse().AdjointMap() * np.array(deviations)
        more = more + shift @ shift.T
    return more
