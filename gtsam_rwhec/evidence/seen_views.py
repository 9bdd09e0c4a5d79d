"""A target's corners in one image against where a calibration has them: what pictures and reports show of images."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.fitting.corner_residuals import shaped
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.reprojection_record import SIZE, WARPS, Reprojection
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.camera import Camera

#: Fewer corners than this in an image say nothing beside its pose.
FEWEST = 4
#: A corner is far off beyond so many times the median of its image, or the noise.
FAR = 6.0


class SeenView(NamedTuple):
    """A target's corners in an image: pixels (n, 2), and the same points (n, 3) in the camera's frame, metres.

    With the points' derivatives (n, 3, 6) by A Expmap([omega, v]), the image's stamp (or its index, where there are no
    stamps), the target, and whether the calibration uses it.
    """

    pixels: Array
    points: Array
    by_A: Array
    stamp_ns: int
    target: str = ""
    is_used: bool = True

    @staticmethod
    def of(
        pixels: Array,
        corners: Array,
        T_camera_targetcarrier: Array,
        T_targetcarrier_target: Array,
        stamp_ns: int,
        target: str = "",
        *,
        is_used: bool = True,
    ) -> SeenView:
        """Of corners (n, 3) in the target's frame."""
        Q = corners @ T_targetcarrier_target[:3, :3].T + T_targetcarrier_target[:3, 3]
        R = T_camera_targetcarrier[:3, :3]
        by_xi = np.concatenate([-se3.hat(Q), np.broadcast_to(np.eye(3), (len(Q), 3, 3))], axis=2)
        points = Q @ R.T + T_camera_targetcarrier[:3, 3]
        return SeenView(pixels, points, R @ by_xi, stamp_ns, target, is_used)


class CornerErrors(NamedTuple):
    """Seen minus predicted (n, 2), pixels, and which corners count, (n,) bool: the others are far off."""

    px: Array
    counts: np.ndarray


def board_of(refined: RefinedPoses, target: str, corners: Array) -> Array:
    """A target's corners (n, 3) as they were found to be: larger or smaller than stated, and bent."""
    scale = refined.scale if isinstance(refined.scale, float) else refined.scale[target]
    shape = np.array([1.0 / scale - 1.0, 0.0, 0.0])
    found = None if refined.reprojection is None else refined.reprojection.boards.get(target)
    if found is not None:
        for name, value in zip(found.names, found.values, strict=True):
            if name != SIZE and name in WARPS.values():
                shape[1 + list(WARPS.values()).index(name)] = value
    board = shaped(corners, shape)[0]
    return board + np.array(found.corners_off_m) if found is not None and found.corners_off_m else board


def errors_as_measured(camera: Camera, view: SeenView) -> CornerErrors:
    """Errors with A as it was measured; corners that are behind the camera, or have no ray, do not count."""
    off = view.pixels - camera.project(view.points)
    return CornerErrors(off, np.isfinite(off).all(axis=1) & (view.points[:, 2] > 0.0))


def errors_at_optimum(camera: Camera, view: SeenView, found: Reprojection) -> CornerErrors | None:
    """Errors of an image's corners at the optimum of a refinement from corners; None where an image says nothing.

    A of each image is off there by what its noise and its corners together say.
    With the derivatives J of the pixels by A's errors over their deviations, and residuals r over the corners' noise:
    r - J (J' J + I)^-1 J' r, to first order. Corners that are far off do not count.
    """
    P = view.points
    deviations = np.repeat([found.carrier_rotation_rad, found.carrier_translation_m], 3)
    x = P[:, :2] / P[:, 2:]
    predicted, by_x = camera.pixel_jacobian(x)
    off = view.pixels - predicted
    if len(P) < FEWEST or not (np.isfinite(off).all() and (P[:, 2] > 0.0).all()):
        return None
    to_x = np.concatenate([np.broadcast_to(np.eye(2), (len(P), 2, 2)), -x[:, :, None]], axis=2)
    J = by_x @ (to_x / P[:, 2, None, None]) @ view.by_A * deviations / found.corner_px
    length = np.linalg.norm(_at_optimum(J, off, np.ones(len(P), dtype=bool)), axis=1)
    counts = length <= FAR * max(float(np.median(length)), found.corner_px)
    return CornerErrors(_at_optimum(J, off, counts), counts) if counts.sum() >= FEWEST else None


def _at_optimum(J: Array, errors: Array, counts: np.ndarray) -> Array:
    """Errors (n, 2) without what A's errors explain of those that count; derivatives (n, 2, 6) in deviations."""
    flat = J[counts].reshape(-1, 6)
    xi = np.linalg.solve(flat.T @ flat + np.eye(6), flat.T @ errors[counts].ravel())
    left: Array = errors - J @ xi
    return left
