"""Whether poses are determined by the carriers' motion, or by the noise of A that passes for motion.

Where the carriers turn about one axis only, a place along it is free; but measured poses A never turn about one axis
exactly, and noise of a milliradian gives it a deviation of a few centimetres, which is a claim without grounds. Noise
that is drawn once more, on top of what A has, tells: information about a place that only noise gives doubles by it, and
that of motion stays.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.reprojection.determined import CURE, told_where_it_fails
from gtsam_rwhec.reprojection.model import Model, Point
from gtsam_rwhec.reprojection.reduced import Noise, Reduced

#: Noise is drawn so many times.
DRAWS = 6
#: Of what noise gives, more noise gives twice as much; a frame whose information grows by more than this factor is told
#: by noise for a fourth and more.
GROWS = 1.25
#: Frames with a smaller deviation (rad, and a share of the corners' distance) are told by motion: no noise is so large.
SMALL = 3e-3


def grows_by_noise(
    model: Model, point: Point, noise: Noise, joint: Array, slots: Mapping[tuple[str, str], slice], distance_m: float
) -> dict[str, float]:
    """By how much noise of A would add to what is known of each frame's least known direction: 1 is nothing.

    Only frames with large deviations are asked. `joint` is the covariance (d, d) of the unknowns in `slots`.
    """
    scale = np.repeat([1.0, 1.0 / distance_m], 3)
    weakest = {}
    for (letter, name), at in slots.items():
        if letter in "xy":
            values, vectors = np.linalg.eigh(joint[at, at] * scale[:, None] * scale)
            if values[-1] > SMALL**2:
                weakest[name] = at, vectors[:, -1] * scale
    if model.A_noise is None or not weakest:
        return {}
    rng = np.random.default_rng(0)
    covariances = [_covariance(model, point, noise)]
    for _ in range(DRAWS):
        xi = (model.to_right @ (rng.normal(size=(len(model.A), 6)) * model.A_noise)[..., None])[..., 0]
        covariances.append(_covariance(model, replace(point, A=point.A @ se3.expmap(xi)), noise))
    result = {}
    for name, (at, u) in weakest.items():
        now, *more = (1.0 / float(u @ covariance[at, at] @ u) for covariance in covariances)
        result[name] = float(np.mean(more)) / now
    return result


def check_motion(
    model: Model, point: Point, noise: Noise, joint: Array, slots: Mapping[tuple[str, str], slice], distance_m: float
) -> None:
    """UnderdeterminedError where noise of A alone says where a frame is."""
    with told_where_it_fails(model, point):
        grows = grows_by_noise(model, point, noise, joint, slots, distance_m)
    faults = [name for name, factor in grows.items() if factor > GROWS]
    if faults:
        raise UnderdeterminedError(
            f"the carriers' motion does not determine the pose of {', '.join(faults)}: what the images say of it comes "
            f"from the noise of A ({np.degrees(noise.carrier_rad):.2g} degrees and {1e3 * noise.carrier_m:.2g} mm), "
            f"which passes for motion; {CURE}"
        )


def _covariance(model: Model, point: Point, noise: Noise) -> Array:
    covariance: Array = np.linalg.inv(Reduced.of(model, point).information(noise))
    return covariance
