"""How sure projections are over the image: what the intrinsics' and the pose's errors together do to a pixel.

A point that stands still on the sensor's carrier, at a distance along a pixel's ray, is projected again with other
errors of Y and of the intrinsics. These errors belong together: a turn of the camera hides a shift of its centre. Where
no corner was seen, they do not hide each other, and the deviation grows: a camera that was calibrated from one corner
of its image says so.

What of this is the lens's own, whatever errors all poses share, is mrcal's measure: intrinsics are off by dk, and the
pose by what hides dk best where corners were seen, dp = -(sum Jp' Jp)^-1 sum Jp' Jk dk; a pixel moves by Jk dk + Jp dp.
"""

from __future__ import annotations

import math

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import FrameError, OptionError
from gtsam_rwhec.files.terminal_text import brief, rounded
from gtsam_rwhec.fitting.corners_refined import CornersRefined
from gtsam_rwhec.fitting.held_out import REGIONS, rms_by_region
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.reprojection_record import Regions
from gtsam_rwhec.fitting.stated_intrinsics import pixels_and_derivatives
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import is_real

#: A part of the image is said to be uncertain where projections are so many times as uncertain as in the best part,
#: and by more than this: what was learnt in one part is extrapolated.
TIMES, LEAST_PX = 5.0, 1.0


def projection_deviations(
    refined: CornersRefined | RefinedPoses, sensor: str, distance_m: float, *, steps: int = 20
) -> tuple[Array, Array]:
    """Standard deviations of the projection of points over a sensor's image.

    Parameters
    ----------
    refined : CornersRefined or RefinedPoses
        A refinement from corners, also as a result file has it.
    sensor : str
        One whose intrinsics were estimated.
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
        There is no such sensor, or its intrinsics were not estimated.
    OptionError
        The distance is not positive.
    """
    if sensor not in refined.intrinsics:
        there = ", ".join(refined.intrinsics) or "none"
        raise FrameError(f"{sensor!r} is no sensor whose intrinsics were estimated; they are {there}")
    camera, covariance = refined.intrinsics[sensor].camera, refined.covariance(sensor, f"intrinsics:{sensor}")
    pixels, P = _points_over(camera, distance_m, steps)
    by_pose, by_camera = _derivatives(camera, P)
    return pixels, _worst(np.concatenate([by_pose, by_camera], axis=-1), covariance)


def lens_deviations_over(
    camera: Camera, covariance: Array, seen: Array, distance_m: float, *, steps: int = 20
) -> tuple[Array, Array]:
    """As `projection_deviations`, of the lens alone: with the pose that hides its errors best where corners were seen.

    Parameters
    ----------
    camera : Camera
        With the estimated intrinsics.
    covariance : (m, m) array
        Of its parameters, as ``refined.covariance(f"intrinsics:{sensor}")`` has it.
    seen : (n, 3) array
        The corners that were seen, in the camera's frame, metres.
    distance_m : float
        Depth of the points in front of the sensor, metres.
    """
    by_pose, by_camera = (J.reshape(-1, J.shape[-1]) for J in _derivatives(camera, seen))
    size = np.maximum(np.linalg.norm(by_pose, axis=0), 1e-300)
    hiding, *_ = np.linalg.lstsq(by_pose / size, -by_camera, rcond=1e-9)
    pixels, P = _points_over(camera, distance_m, steps)
    there, moved = _derivatives(camera, P)
    return pixels, _worst(moved + there / size @ hiding, covariance)


def by_region(camera: Camera, covariance: Array, seen: Array, distance_m: float) -> Regions:
    """`lens_deviations_over` by region of the image, as errors of held-out corners are: root mean square over each.

    Returns
    -------
    tuple of tuple of float or None
        Pixels, rows from the top; None where the lens has no ray.
    """
    pixels, deviations = lens_deviations_over(camera, covariance, seen, distance_m, steps=10 * REGIONS)
    known = np.isfinite(deviations)
    return as_regions(rms_by_region(camera, pixels[known], deviations[known]))


def as_regions(values: Array) -> Regions:
    """Values (3, 3) by region; None in the place of nan."""
    return tuple(tuple(None if math.isnan(value) else value for value in row) for row in values.tolist())


def uneven_words(projection_px: Regions, corners: Regions = ()) -> str:
    """What to say of a camera that was calibrated from a part of its image; empty where it knows all parts alike.

    Parameters
    ----------
    projection_px : tuple of tuple of float or None
        As `by_region` gives it.
    corners : tuple of tuple of float or None
        Anything by the same regions that is None where no corner was seen.
    """
    known = [px for row in projection_px for px in row if px is not None]
    if not known:
        return ""
    best, limit = min(known), max(TIMES * min(known), LEAST_PX)
    far = {(v, u) for v, row in enumerate(projection_px) for u, px in enumerate(row) if px is not None and px > limit}
    if not far:
        return ""
    unseen = sum((v, u) in far for v, row in enumerate(corners) for u, of in enumerate(row) if of is None)
    seen = f"; no corner was seen in {unseen} of these" if unseen else ""
    return (
        f"projections are uncertain by up to {rounded(max(known))} px in {len(far)} of {len(known)} parts of the "
        f"image (rms over a part), and by {rounded(best)} px in the best part{seen}: take images with a "
        "target there, or do not use these parts"
    )


def _points_over(camera: Camera, distance_m: float, steps: int) -> tuple[Array, Array]:
    """Pixels (h, w, 2) evenly over the image, and points (h, w, 3) along their rays; nan where the lens has no ray."""
    if not (is_real(distance_m) and 0.0 < distance_m < np.inf):
        raise OptionError(f"distance_m={brief(distance_m)}; give metres, above 0")
    sides = (camera.width, camera.height)
    numbers = [max(round(steps * side / max(sides)), 1) for side in sides]
    u, v = ((np.arange(number) + 0.5) * side / number - 0.5 for number, side in zip(numbers, sides, strict=True))
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    x = camera.undistort(pixels)
    return pixels, distance_m * np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)


def _derivatives(camera: Camera, P: Array) -> tuple[Array, Array]:
    """Of the pixels of points (..., 3), by the camera's pose (..., 2, 6) and its parameters (..., 2, m).

    Y Expmap([w, v]) moves a point that stands on the carrier by -(w x P + v) in the sensor's frame. Derivatives are nan
    where the point is.
    """
    known = np.asarray(np.isfinite(P).all(axis=-1))
    at = np.where(known[..., None], P, [0.0, 0.0, 1.0])
    z = at[..., 2, None]
    x = at[..., :2] / z
    _, by_x, by_camera = pixels_and_derivatives(camera, camera.parameters, x)
    to_x = np.concatenate([np.broadcast_to(np.eye(2), (*x.shape, 2)), -x[..., None]], axis=-1) / z[..., None]
    hat = se3.hat(at.reshape(-1, 3)).reshape(*at.shape, 3)
    by_xi = np.concatenate([hat, np.broadcast_to(-np.eye(3), hat.shape)], axis=-1)
    nowhere = np.where(known, 0.0, np.nan)[..., None, None]
    return by_x @ to_x @ by_xi + nowhere, by_camera + nowhere


def _worst(J: Array, covariance: Array) -> Array:
    """Deviations (...) along the worse direction, with the derivatives J (..., 2, d); nan where these are."""
    known = np.asarray(np.isfinite(J).all(axis=(-1, -2)))
    J = np.where(known[..., None, None], J, 0.0)
    variance = np.linalg.eigvalsh(J @ covariance @ np.swapaxes(J, -1, -2))[..., -1]
    return np.where(known, np.sqrt(np.maximum(variance, 0.0)), np.nan)
