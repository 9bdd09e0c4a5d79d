"""What the noise of the poses adds to the covariance of a refinement from the same images' corners.

The corners' own model has errors of A that are independent from instant to instant. Where the poses show more (errors
that are alike in neighbours in time, that vary with the configuration of the arm, or stay the same), N instants are
worth W of independent ones, and the poses' covariances grow by N / W. A constant error of A changes no residual, of
poses or of corners: it moves the frames of one carrier together.
"""

from __future__ import annotations

from collections.abc import Mapping

import gtsam
import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.noise_model.found import NoiseInData
from gtsam_rwhec.reprojection.refined import CornersRefined


def beyond_independent_errors(
    corners: CornersRefined, found: NoiseInData | None, wider: Mapping[tuple[str, str], float]
) -> Array:
    """The covariance (d, d) to add to that of the corners' unknowns.

    Parameters
    ----------
    corners : CornersRefined
    found : NoiseInData or None
        What the poses say of their noise. Where A counts as exact its errors are in intrinsics and boards too: these
        widen as the poses do.
    wider : dict of (letter, name) to float
        By how much the deviations of each unknown of `corners` are widened, since images that were left out show that
        the model lacks something that nothing else tells of.
    """
    size = len(corners.joint)
    scale = np.ones(size)
    for slot, factor in wider.items():
        scale[corners.slots[slot]] = max(factor, 1.0)
    if found is not None:
        letters = "xyt" if corners.noise.carrier is not None else "xytkbp"
        of_poses = np.sqrt(max(found.instants / max(found.worth, 1e-300), 1.0))
        for (letter, _), rows in corners.slots.items():
            if letter in letters:
                scale[rows] *= of_poses
    more: Array = corners.joint * (np.outer(scale, scale) - 1.0)
    if found is None:
        return more
    carriers: tuple[tuple[str, dict[str, gtsam.Pose3]], ...] = (("x", corners.X), ("y", corners.Y))
    for (letter, poses), deviations in zip(carriers, found.constant_deviations, strict=True):
        shift = np.zeros((size, 6))
        for name, pose in poses.items():
            shift[corners.slots[letter, name]] = pose.inverse().AdjointMap() * np.array(deviations)
        more = more + shift @ shift.T
    return more
