"""Pixels as functions of a camera's parameters: K's focal lengths and centre, and the lens model's coefficients.

The parameters of a camera are one vector, `Camera.parameters`: fx, fy, cx, cy in pixels, then its model's coefficients.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.camera import Camera
from gtsam_rwhec.vision.distortion import coefficient_jacobian, distorted

#: fx, fy, cx, cy come before the coefficients.
PINHOLE = 4


def parameters_of(camera: Camera) -> Array:
    """The parameters (4 + n,) of a camera with n coefficients."""
    return camera.parameters


def camera_with(camera: Camera, parameters: Array) -> Camera:
    """The camera with other parameters, and the same model and size of images."""
    return camera.with_parameters(parameters)


def pixels_of(camera: Camera, parameters: Array, x: Array) -> Array:
    """Pixels (..., 2) of normalised coordinates (..., 2)."""
    return camera_with(camera, parameters).pixels(x)


def pixels_and_derivatives(camera: Camera, parameters: Array, x: Array) -> tuple[Array, Array, Array]:
    """Pixels (..., 2) of normalised coordinates (..., 2), with derivatives (..., 2, 2) by x and by the parameters."""
    camera = camera_with(camera, parameters)
    f, c, D = np.diagonal(camera.K)[:2], camera.K[:2, 2], camera.D
    bent, by_x = distorted(camera.model, D, x)
    by_parameters = np.zeros((*x.shape[:-1], 2, len(parameters)))
    by_parameters[..., 0, 0], by_parameters[..., 1, 1] = bent[..., 0], bent[..., 1]
    by_parameters[..., 0, 2] = by_parameters[..., 1, 3] = 1.0
    if len(D):
        by_parameters[..., PINHOLE:] = f[:, None] * coefficient_jacobian(camera.model, D, x)
    if camera.model == "unified":  # f is a parameter times 1 + xi
        by_parameters[..., :2] *= 1.0 + D[0]
        by_parameters[..., PINHOLE] += bent * parameters[:2]
    return f * bent + c, f[:, None] * by_x, by_parameters
