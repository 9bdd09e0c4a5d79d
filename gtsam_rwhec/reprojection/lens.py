"""Pixels as functions of a camera's parameters: K's focal lengths and centre, and the lens model's coefficients.

The parameters of a camera are one vector: fx, fy, cx, cy in pixels, then OpenCV's coefficients of its model.
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
    K = camera.K
    return np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], camera.D])


def camera_with(camera: Camera, parameters: Array) -> Camera:
    """The camera with other parameters, and the same model and size of images."""
    fx, fy, cx, cy = parameters[:PINHOLE]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(camera.width, camera.height, camera.model, K, np.asarray(parameters[PINHOLE:]))


def pixels_of(camera: Camera, parameters: Array, x: Array) -> Array:
    """Pixels (..., 2) of normalised coordinates (..., 2)."""
    return parameters[:2] * distorted(camera.model, parameters[PINHOLE:], x)[0] + parameters[2:PINHOLE]


def pixels_and_derivatives(camera: Camera, parameters: Array, x: Array) -> tuple[Array, Array, Array]:
    """Pixels (..., 2) of normalised coordinates (..., 2), with derivatives (..., 2, 2) by x and by the parameters."""
    f, c, D = parameters[:2], parameters[2:PINHOLE], parameters[PINHOLE:]
    bent, by_x = distorted(camera.model, D, x)
    by_parameters = np.zeros((*x.shape[:-1], 2, len(parameters)))
    by_parameters[..., 0, 0], by_parameters[..., 1, 1] = bent[..., 0], bent[..., 1]
    by_parameters[..., 0, 2] = by_parameters[..., 1, 3] = 1.0
    if len(D):
        by_parameters[..., PINHOLE:] = f[:, None] * coefficient_jacobian(camera.model, D, x)
    return f * bent + c, f[:, None] * by_x, by_parameters
