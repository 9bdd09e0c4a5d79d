"""How sure projections are over the image: what the intrinsics' and the pose's errors together do to a pixel.

A point that stands still on the sensor's carrier, at a distance along a pixel's ray, is projected again with other
errors of Y and of the intrinsics. These errors belong together: a turn of the camera hides a shift of its centre. Where
no corner was seen, they do not hide each other, and the deviation grows: a camera that was calibrated from one corner
of its image says so. mrcal's measure.
"""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import FrameError, OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import is_real
from gtsam_rwhec.reprojection.lens import parameters_of, pixels_and_derivatives
from gtsam_rwhec.reprojection.refined import CornersRefined


def projection_deviations(
    refined: CornersRefined, sensor: str, distance_m: float, *, steps: int = 20
) -> tuple[Array, Array]:
    """Standard deviations of the projection of points over a sensor's image.

    Parameters
    ----------
    refined : CornersRefined
    sensor : str
    distance_m : float
        Depth of the points in front of the sensor, metres.
    steps : int
        Pixels along the image's longer side.

    Returns
    -------
    (h, w, 2) array
        The pixels.
    (h, w) array
        The deviation along the worse direction, pixels; nan where the lens has no ray.

    Raises
    ------
    FrameError
        There is no such sensor.
    OptionError
        The distance is not positive.
    """
    if sensor not in refined.intrinsics:
        raise FrameError(f"{sensor!r} is no sensor; they are {', '.join(refined.intrinsics)}")
    if not (is_real(distance_m) and 0.0 < distance_m < np.inf):
        raise OptionError(f"distance_m={brief(distance_m)}; give metres, above 0")
    camera = refined.intrinsics[sensor].camera
    step = max(camera.width, camera.height) / steps
    u, v = (np.arange(0.5 * step, size, step) - 0.5 for size in (camera.width, camera.height))
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    x = camera.undistort(pixels)
    seen = np.asarray(np.isfinite(x).all(axis=-1))
    x = np.where(seen[..., None], x, 0.0)
    _, by_x, by_camera = pixels_and_derivatives(camera, parameters_of(camera), x)
    P = distance_m * np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)
    to_x = np.concatenate([np.broadcast_to(np.eye(2), (*x.shape, 2)), -x[..., None]], axis=-1) / distance_m
    # Y Expmap([w, v]) moves a point that stands on the carrier by -(w x P + v) in the sensor's frame.
    hat = se3.hat(P.reshape(-1, 3)).reshape(*P.shape, 3)
    by_xi = np.concatenate([hat, np.broadcast_to(-np.eye(3), hat.shape)], axis=-1)
    J = np.concatenate([by_x @ to_x @ by_xi, by_camera], axis=-1)
    covariance = J @ refined.covariance(sensor, f"intrinsics:{sensor}") @ np.swapaxes(J, -1, -2)
    worst = np.sqrt(np.linalg.eigvalsh(covariance)[..., -1])
    return pixels, np.where(seen, worst, np.nan)
