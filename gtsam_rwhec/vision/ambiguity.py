"""The choice between a plane's two poses, over a whole track.

A far or nearly frontal plane looks almost the same in two poses, mirror images of each other about the line of sight.
The reprojection errors of one image hardly tell them apart. A track tells more: between two images the target turns
relative to the camera by the same angle as the target carrier relative to the sensor carrier, for any extrinsics
(A_i^-1 A_j and B_i B_j^-1 are conjugate). A wrong choice changes that angle. Dynamic programming finds the most likely
choice of the whole track, a chain with two states for each image; the cost of the best chain through the other state
says how sure each choice is. Where the carriers' poses are known in enough images, one extrinsic rotation for all
images tells more than the angles between neighbours do (`agreement`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.agreement import LEAST_IMAGES, choose_by_agreement

#: Time offsets and arm errors give the angle between two images this standard deviation (rad). Corner noise adds to it.
SIGMA_TURN_RAD = float(np.radians(3.0))
#: A target's angular velocity against the camera has this standard deviation (rad/s) where carriers' poses are unknown.
SIGMA_RATE_RAD_S = float(np.radians(60.0))
#: Two images are not compared if they are further apart in time than this (seconds).
LONGEST_LINK_S = 3.0
#: The comparison of two images costs at most this (log-likelihood), so that it cannot outweigh the others.
MOST_OF_A_LINK = 8.0
#: One image costs at most this (log-likelihood), so that it cannot outweigh the others.
MOST_OF_AN_IMAGE = 30.0
#: Two candidates are one pose if their rotations differ by less than this (rad).
SAME_RAD = float(np.radians(0.2))


@dataclass(frozen=True, eq=False)
class Choice:
    """The candidates chosen in n images of a track.

    Attributes
    ----------
    which : (n,) array of int
        The chosen candidate, 0 or 1.
    margin : (n,) array
        By how much the chosen track's log-likelihood exceeds that of the best track with this image's other candidate.
    """

    which: np.ndarray
    margin: Array


def choose_over_time(
    stamps_ns: np.ndarray,
    T: Array,
    squared_px: Array,
    covariance: Array,
    corner_px: float,
    carrier: Array | None = None,
) -> Choice:
    """Choose one candidate for each image of a track.

    Parameters
    ----------
    stamps_ns : (n,) integers
        Increasing.
    T : (n, 2, 4, 4) array
        Candidates T_camera_target; the second is nan where there is only one.
    squared_px : (n, 2) array
        Sums of squared reprojection errors.
    covariance : (n, 2, 6, 6) array
        Covariances of the candidates.
    corner_px : float
        Standard deviation of a corner along each axis, pixels.
    carrier : (n, 4, 4) array, optional
        A = T_sensorcarrier_targetcarrier at the stamps; nan where it is not known.
    """
    n = len(stamps_ns)
    image = np.nan_to_num(0.5 * squared_px / corner_px**2, nan=np.inf)
    if n == 0:
        return Choice(np.zeros(0, dtype=int), np.zeros(0))
    image = np.minimum(image - image.min(axis=1, keepdims=True), MOST_OF_AN_IMAGE)
    image[~np.isfinite(T).all(axis=(2, 3))] = np.inf
    link = _links(stamps_ns, T, covariance, carrier)
    # forward[i, a]: cost of the best chain up to image i in state a; backward[i, a]: of the best chain after it.
    forward, backward = image.copy(), np.zeros((n, 2))
    for i in range(1, n):
        forward[i] += (forward[i - 1][:, None] + link[i - 1]).min(axis=0)
    for i in range(n - 2, -1, -1):
        backward[i] = (link[i] + (image[i + 1] + backward[i + 1])[None, :]).min(axis=1)
    through = forward + backward
    which = np.argmin(through, axis=1)
    with np.errstate(invalid="ignore"):
        margin = np.abs(through[:, 1] - through[:, 0])
    known = np.zeros(n, dtype=bool) if carrier is None else np.asarray(np.isfinite(carrier).all(axis=(1, 2)))
    known &= np.isfinite(image).any(axis=1)
    if carrier is not None and known.sum() >= LEAST_IMAGES:
        of_rotation = np.nan_to_num(covariance[known, :, :3, :3]) + SIGMA_TURN_RAD**2 * np.eye(3)
        which[known], margin[known] = choose_by_agreement(
            T[known], carrier[known], of_rotation, image[known], which[known], most=MOST_OF_A_LINK
        )
    with np.errstate(invalid="ignore"):
        R = T[..., :3, :3]
        apart = np.linalg.norm(se3.so3_logmap(np.nan_to_num(np.swapaxes(R[:, 0], 1, 2) @ R[:, 1])), axis=1)
    margin[(apart < SAME_RAD) | ~np.isfinite(T[:, 1]).all(axis=(1, 2))] = np.inf
    return Choice(which, margin)


def _links(stamps_ns: np.ndarray, T: Array, covariance: Array, carrier: Array | None) -> Array:
    """Costs (n - 1, 2, 2) of each state after each: they say how far their angle is from the carriers' angle."""
    seconds = np.diff(stamps_ns) * 1e-9
    R = np.nan_to_num(T[..., :3, :3])
    between = R[:-1, :, None] @ np.swapaxes(R[1:, None], -1, -2)  # B_i B_j^-1
    angle = np.linalg.norm(se3.so3_logmap(between.reshape(-1, 3, 3)), axis=1).reshape(-1, 2, 2)
    of_pose = np.nan_to_num(np.trace(covariance[..., :3, :3], axis1=-2, axis2=-1)) / 3.0
    variance = of_pose[:-1, :, None] + of_pose[1:, None] + SIGMA_TURN_RAD**2
    off = angle
    spread = variance + (SIGMA_RATE_RAD_S * seconds[:, None, None]) ** 2
    if carrier is not None:
        C = carrier[:, :3, :3]
        known = np.asarray(np.isfinite(C).all(axis=(1, 2)))
        turned = np.linalg.norm(se3.so3_logmap(np.nan_to_num(np.swapaxes(C[:-1], 1, 2) @ C[1:])), axis=1)
        both = (known[:-1] & known[1:])[:, None, None]
        off = np.where(both, angle - turned[:, None, None], angle)
        spread = np.where(both, variance, spread)
    cost: Array = np.minimum(0.5 * off**2 / spread, MOST_OF_A_LINK)
    cost[seconds > LONGEST_LINK_S] = 0.0
    return cost
