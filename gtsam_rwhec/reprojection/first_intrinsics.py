"""First intrinsics of a camera that nobody calibrated: by homographies of its views, as Zhang does it (OpenCV's)."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.reprojection.observations import Observations, in_plane
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.unknown_intrinsics import Lens, estimated_intrinsics


def first_intrinsics(observations: Observations, sensor: str) -> Camera:
    """A camera's intrinsics from its views of flat targets alone, with the lens model that is stated.

    A stated pinhole gets four coefficients of distortion, zero where the corners do not ask for them. Raises
    `CameraError` where the views are too few, or do not determine intrinsics.
    """
    stated = observations.cameras[sensor]
    points, pixels = _views(observations, sensor)
    lens: Lens = "radtan" if stated.model == "pinhole" else stated.model
    try:
        found = estimated_intrinsics(points, pixels, (stated.width, stated.height), lens).camera
    except CameraError as error:
        raise CameraError(f"the intrinsics of {sensor} {error}. Or state intrinsics") from error
    if found.model == "pinhole":
        return Camera(found.width, found.height, "radtan", found.K, np.zeros(4))
    return found


def _views(observations: Observations, sensor: str) -> tuple[list[Array], list[Array]]:
    """Corners in their plane and their pixels, of each view."""
    points, pixels = [], []
    for (target, name), view in observations.views.items():
        if name != sensor:
            continue
        flat, _ = in_plane(observations.corners[target], target)
        for seen, known in zip(view.pixels, view.known, strict=True):
            points.append(flat[known])
            pixels.append(seen[known])
    return points, pixels
