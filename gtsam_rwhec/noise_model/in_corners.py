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


def beyond_independent_errors(corners: CornersRefined, found: NoiseInData | None, unexplained: float = 1.0) -> Array:
    """The covariance (d, d) to add to that of the corners' unknowns.

    Parameters
    ----------
    corners : CornersRefined
    found : NoiseInData or None
        What the poses say of their noise. Where A counts as exact its errors are in intrinsics and boards too: these
        widen as the poses do.
    unexplained : float
        How many times as far off images are that were left out as the corners' covariances say: where the model lacks
        something that nothing else tells of, all deviations are too small by as much.
    """
    size = len(corners.joint)
    wider = np.full(size, max(unexplained, 1.0))
    if found is not None:
        letters = "xyt" if corners.noise.carrier is not None else "xytkbp"
        factor = np.sqrt(max(found.instants / max(found.worth, 1e-300), 1.0))
        for (letter, _), rows in corners.slots.items():
            if letter in letters:
                wider[rows] *= factor
    more: Array = corners.joint * (np.outer(wider, wider) - 1.0)
    if found is None:
        return more
    carriers: tuple[tuple[str, dict[str, gtsam.Pose3]], ...] = (("x", corners.X), ("y", corners.Y))
    for (letter, poses), deviations in zip(carriers, found.constant_deviations, strict=True):
        shift = np.zeros((size, 6))
        for name, pose in poses.items():
            shift[corners.slots[letter, name]] = pose.inverse().AdjointMap() * np.array(deviations)
        more = more + shift @ shift.T
    return more
