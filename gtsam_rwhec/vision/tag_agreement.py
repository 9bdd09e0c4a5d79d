"""Which tags of a board are where the board says: all of them must agree with one homography, or with one pose.

A tag that was read wrongly, or a board that is not the stated one, is off by a tag's side and more. Errors of corners
and of intrinsics are far smaller than that, so that `LARGEST_OFF` tells them apart.
"""

from __future__ import annotations

import cv2
import numpy as np

from gtsam_rwhec.geometry.poses import Array

#: A tag's corners are off their places by at most this share of the tag's shorter side, or by `LEAST_PX`.
LARGEST_OFF = 0.25
LEAST_PX = 2.0
#: Points are in one plane if they are nearer to it than this share of their extent.
FLAT = 1e-4
#: RANSAC for a pose tries this number of samples.
SAMPLES = 200


def agreeing(places: Array, flat: Array, off_px: Array | None = None) -> np.ndarray:
    """Say which (m,) of a board's tags agree with the largest set of them that agrees. One tag agrees with itself.

    Parameters
    ----------
    places : (m, 4, 3) array
        The tags' corners in the board's frame, any unit.
    flat : (m, 4, 2) array
        Where they were seen, pixels of a camera without distortion, from its principal point; nan agrees with nothing.
    off_px : (m,) array, optional
        By how much a corner may be off; by default `LARGEST_OFF` of the tag's side.
    """
    seen = np.asarray(np.isfinite(flat).all(axis=(1, 2)))
    if seen.sum() < 2:
        return seen
    largest = largest_off(flat) if off_px is None else off_px
    in_plane = plane_coordinates(places)
    agrees = np.zeros(len(places), dtype=bool)
    if in_plane is not None:
        agrees[seen] = _by_homography(in_plane[seen], flat[seen], largest[seen])
    return agrees


def largest_off(flat: Array) -> Array:
    """By how much (m,) corners of tags (m, 4, 2) may be off, pixels: a share of the shorter side, area / longest."""
    longest = np.linalg.norm(np.roll(flat, -1, axis=1) - flat, axis=2).max(axis=1)
    first, second = flat[:, 2] - flat[:, 0], flat[:, 3] - flat[:, 1]
    area = 0.5 * np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    return np.asarray(np.maximum(LARGEST_OFF * area / np.maximum(longest, 1e-9), LEAST_PX))


def agreeing_in_space(places: Array, x: Array, off: Array) -> np.ndarray:
    """Do as `agreeing` for tags of several planes, with x (m, 4, 2) and off (m,) in normalised coordinates."""
    seen = np.asarray(np.isfinite(x).all(axis=(1, 2)))
    agrees = np.zeros(len(places), dtype=bool)
    if seen.sum() < 2:
        return seen
    points, pixels, largest = places[seen].reshape(-1, 3), x[seen].reshape(-1, 2), off[seen]
    try:
        found, turn, t, inliers = cv2.solvePnPRansac(
            points[:, None], pixels[:, None], np.eye(3), None,
            iterationsCount=SAMPLES, reprojectionError=float(np.median(largest)), flags=cv2.SOLVEPNP_SQPNP,
        )  # fmt: skip
        if not found or inliers is None or len(inliers) < 6:
            return agrees
        good = np.ravel(inliers)
        found, turn, t = cv2.solvePnP(
            points[good][:, None], pixels[good][:, None], np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:
        return agrees  # degenerate samples only
    predicted = cv2.projectPoints(points, turn, t, np.eye(3), None)[0].reshape(-1, 4, 2)
    error = np.linalg.norm(predicted - pixels.reshape(-1, 4, 2), axis=2).max(axis=1)
    agrees[seen] = (error <= largest) & bool(found)
    return agrees


def all_agree(plane: Array, flat: Array) -> bool:
    """Whether all tags, in their plane (m, 4, 2) and seen at `flat` (m, 4, 2), agree with the least squares of all."""
    H, _ = cv2.findHomography(plane.reshape(-1, 2), flat.reshape(-1, 2), 0)
    return bool(_near(np.asarray(H), plane, flat, largest_off(flat)).all())


def spans_a_plane(plane: Array) -> bool:
    """Whether the middles of tags (m, 4, 2) are not all on one line."""
    if len(plane) < 3:
        return False
    off = plane.mean(axis=1) - plane.mean(axis=(0, 1))
    return int(np.linalg.matrix_rank(off, tol=1e-6 * float(np.abs(plane).max()))) == 2


def plane_coordinates(places: Array) -> Array | None:
    """Coordinates (m, 4, 2) of corners (m, 4, 3) in their plane, with the side that is seen towards the viewer.

    None where they are not in one plane.
    """
    points = places.reshape(-1, 3)
    if not points[:, 2].any():
        return places[..., :2]
    middle = points.mean(axis=0)
    _, extent, axes = np.linalg.svd(points - middle, full_matrices=False)
    if extent[2] > FLAT * extent[0]:
        return None
    across, down = places[0, 1] - places[0, 0], places[0, 2] - places[0, 1]
    # A tag's normal is the cross product of its right and its up, the latter minus its third corner minus its second.
    up = -down
    sign = np.sign(np.linalg.det(np.stack([axes[0], axes[1], np.cross(across, up)])))
    both = np.stack([axes[0], sign * axes[1]])
    return np.asarray((places - middle) @ both.T)


def _by_homography(plane: Array, flat: Array, largest: Array) -> np.ndarray:
    """As `agreeing`, in the plane: RANSAC over the corners, then least squares over the tags that agree."""
    everything = np.ones(len(plane), dtype=bool)
    H, _ = cv2.findHomography(plane.reshape(-1, 2), flat.reshape(-1, 2), 0)
    agrees = _near(np.asarray(H), plane, flat, largest)
    if agrees.all():
        return everything
    H, _ = cv2.findHomography(plane.reshape(-1, 2), flat.reshape(-1, 2), cv2.RANSAC, float(np.median(largest)))
    agrees = _near(np.asarray(H), plane, flat, largest)
    for _ in range(2):
        if agrees.sum() < 2:
            break
        H, _ = cv2.findHomography(plane[agrees].reshape(-1, 2), flat[agrees].reshape(-1, 2), 0)
        again = _near(np.asarray(H), plane, flat, largest)
        if again.sum() < agrees.sum():
            break
        agrees = again
    return agrees


def _near(H: Array, plane: Array, flat: Array, largest: Array) -> np.ndarray:
    if H.dtype == object or not np.isfinite(H).all():
        return np.zeros(len(plane), dtype=bool)
    predicted = cv2.perspectiveTransform(plane.reshape(-1, 1, 2), H).reshape(flat.shape)
    return np.asarray(np.linalg.norm(predicted - flat, axis=2).max(axis=1) <= largest)
