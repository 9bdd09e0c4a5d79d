"""First intrinsics of a camera that nobody calibrated: by homographies of its views, as Zhang does it (OpenCV's)."""

from __future__ import annotations

import cv2
import numpy as np

from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.reprojection.observations import Observations, in_plane
from gtsam_rwhec.vision.camera import Camera

#: Views with fewer corners, and cameras with fewer views, give no intrinsics.
CORNERS, VIEWS = 6, 3
#: This many views, spread over all of them, are enough for a start.
ENOUGH = 40


def first_intrinsics(observations: Observations, sensor: str) -> Camera:
    """A camera's intrinsics from its views of flat targets alone, with the lens model that is stated.

    A stated pinhole gets four coefficients of distortion. Raises `CameraError` where the views are too few, or OpenCV
    finds no intrinsics from them.
    """
    stated = observations.cameras[sensor]
    points, pixels = _views(observations, sensor)
    if len(points) < VIEWS:
        raise CameraError(
            f"the intrinsics of {sensor} cannot be estimated from {len(points)} views with {CORNERS} corners and more; "
            f"at least {VIEWS} are needed, at different tilts. State intrinsics, or take more images"
        )
    spread = np.unique(np.linspace(0, len(points) - 1, ENOUGH).round().astype(int))
    points, pixels = [points[i] for i in spread], [pixels[i] for i in spread]
    size = (stated.width, stated.height)
    try:
        if stated.model == "equidistant":
            flags = _fisheye_flag("CALIB_RECOMPUTE_EXTRINSIC") | _fisheye_flag("CALIB_FIX_SKEW")
            _, K, D, _, _ = cv2.fisheye.calibrate(
                [p[None] for p in points], [u[None] for u in pixels], size, np.eye(3), np.zeros((4, 1)), flags=flags
            )
            coefficients, model = D.ravel()[:4], "equidistant"
        else:
            few = [p.astype(np.float32) for p in points], [u.astype(np.float32) for u in pixels]
            K = cv2.initCameraMatrix2D(*few, size)
            flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
            _, K, D, _, _ = cv2.calibrateCamera(*few, size, K, np.zeros(5), flags=flags)
            coefficients, model = D.ravel()[:4], "radtan"
        K = np.array([[K[0, 0], 0.0, K[0, 2]], [0.0, K[1, 1], K[1, 2]], [0.0, 0.0, 1.0]])
        return Camera.of(*size, model, K, coefficients, f"the estimated intrinsics of {sensor}")
    except (cv2.error, CameraError) as error:
        raise CameraError(
            f"the intrinsics of {sensor} could not be estimated from its {len(points)} views "
            f"({' '.join(str(error).split())}); take images of the target at different tilts and distances, or state "
            "intrinsics"
        ) from error


def _fisheye_flag(name: str) -> int:
    """OpenCV 5 has the fisheye model's flags beside the others, OpenCV 4 in a module of their own."""
    return int(getattr(cv2 if hasattr(cv2, name) else cv2.fisheye, name))


def _views(observations: Observations, sensor: str) -> tuple[list[Array], list[Array]]:
    """Corners in their plane and their pixels, of each view with enough corners."""
    points, pixels = [], []
    for (target, name), view in observations.views.items():
        if name != sensor:
            continue
        flat, _ = in_plane(observations.corners[target], target)
        for seen, known in zip(view.pixels, view.known, strict=True):
            if known.sum() >= CORNERS:
                points.append(flat[known])
                pixels.append(seen[known])
    return points, pixels
