"""First intrinsics of a camera that nobody calibrated: by homographies of its views, as Zhang does it (OpenCV's)."""

from __future__ import annotations

import cv2
import numpy as np

from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.reprojection.observations import Observations, in_plane
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.zhang import fitted_to_planes

#: Views with fewer corners, and cameras with fewer views, give no intrinsics.
CORNERS, VIEWS = 6, 3
#: This many views, spread over all of them, are enough for a start.
ENOUGH = 40
#: Fisheye lenses are started at these focal lengths over the larger side; the first is 180 degrees from edge to edge.
FOCAL_OF_SIZE = (1.0 / np.pi, 0.4, 0.6, 1.0)


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
    found = {"equidistant": _fisheye, "unified": _unified}.get(stated.model, _radtan)(points, pixels, size)
    if found is None:
        raise CameraError(
            f"the intrinsics of {sensor} could not be estimated from its {len(points)} views; take images of the "
            "target at different tilts and distances, or state intrinsics"
        )
    model, K, D = found
    upright = [[K[0, 0], 0.0, K[0, 2]], [0.0, K[1, 1], K[1, 2]], [0.0, 0.0, 1.0]]
    return Camera.of(*size, model, upright, D, f"the estimated intrinsics of {sensor}")


def _radtan(points: list[Array], pixels: list[Array], size: tuple[int, int]) -> tuple[str, Array, Array] | None:
    found = fitted_to_planes(points, pixels, size, "all")
    return None if found is None else ("radtan", found.K, found.D)


def _fisheye(points: list[Array], pixels: list[Array], size: tuple[int, int]) -> tuple[str, Array, Array] | None:
    flags = _fisheye_flag("CALIB_RECOMPUTE_EXTRINSIC") | _fisheye_flag("CALIB_FIX_SKEW")
    flags |= _fisheye_flag("CALIB_USE_INTRINSIC_GUESS")
    width, height = size
    for share in FOCAL_OF_SIZE:
        f = share * max(size)
        start = np.array([[f, 0.0, 0.5 * (width - 1)], [0.0, f, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
        try:
            _, K, D, _, _ = cv2.fisheye.calibrate(
                [p[None] for p in points], [u[None] for u in pixels], size, start, np.zeros((4, 1)), flags=flags
            )
        except cv2.error:  # the start sees a corner behind it, or the views do not say f
            continue
        return "equidistant", np.asarray(K, dtype=np.float64), np.asarray(D, dtype=np.float64).ravel()[:4]
    return None


def _unified(points: list[Array], pixels: list[Array], size: tuple[int, int]) -> tuple[str, Array, Array] | None:
    """The fisheye's curve as f (m + k1 m^3 + k2 m^5), m = tan(theta / 2), which is the unified model with xi = 1."""
    found = _fisheye(points, pixels, size)
    if found is None:
        return None
    _, K, D = found
    seen = Camera(*size, "equidistant", K, D).undistort(np.concatenate(pixels))
    furthest = np.arctan(np.nanmax(np.linalg.norm(seen, axis=1)))
    theta = np.linspace(0.0, furthest, 50)[1:]
    curve = theta * (1.0 + (theta[:, None] ** [2, 4, 6, 8]) @ D)
    f, *k = np.linalg.lstsq(np.tan(0.5 * theta)[:, None] ** [1, 3, 5], curve, rcond=None)[0].tolist()
    return "unified", K * [[f, 1.0, 1.0], [1.0, f, 1.0], [1.0, 1.0, 1.0]], np.array([1.0, *(np.array(k) / f), 0.0, 0.0])


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
