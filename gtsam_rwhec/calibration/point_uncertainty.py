"""How far off a point is, by a refined calibration: its ellipsoid in the frame in which it is expressed."""

from __future__ import annotations

import math
from collections.abc import Mapping

import gtsam
import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from gtsam_rwhec.calibration.seen_from import Carriers, place_of, sides_of
from gtsam_rwhec.calibration.task_units import (
    PointUncertainty,
    ball_radius,
    checked_level,
    checked_point,
    ellipsoid,
    jacobian_of_point,
)
from gtsam_rwhec.calibration.views import SensorView
from gtsam_rwhec.errors import PoseError
from gtsam_rwhec.fitting.fit_options import CarrierNoise
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.unknowns import Unknown
from gtsam_rwhec.geometry.poses import Array, PoseLike, one_transform
from gtsam_rwhec.problem.pairs import Pair


def point_uncertainty(
    refined: Refined,
    views: Mapping[str, SensorView],
    noise_m: Mapping[Pair, float],
    noise_of_A: CarrierNoise | None,
    carriers: Carriers,
    point: ArrayLike,
    *,
    frame: str,
    seen_from: str | None,
    level: float,
    A: PoseLike | None,
) -> PointUncertainty:
    """As ``Calibration.uncertainty_at``; ``noise_m`` is that of one measurement's translation, by pair, metres."""
    p, level = checked_point(point), checked_level(level)
    own, other = sides_of(refined, frame, carriers, has_A=A is not None)
    if frame in views and views[frame].in_front and p[2] <= 0.0:
        raise PoseError(
            f"the point {p.tolist()} is behind {frame}, which saw every target in front of it (z > 0); give a "
            "point in the sensor's own frame, z forward, metres"
        )
    place = place_of(seen_from, frame, own, other, carriers, has_A=A is not None)
    is_sensor = own.kind == "sensor"
    on_carrier = own.poses[frame]
    T, levers = on_carrier, None
    if A is not None:
        given = gtsam.Pose3(one_transform(A, "A"))
        T = (given.inverse() if is_sensor else given).compose(on_carrier)
        here, there = np.asarray(on_carrier.transformFrom(p)), np.asarray(T.transformFrom(p))
        levers = {"sensorcarrier": here if is_sensor else there, "targetcarrier": there if is_sensor else here}
    if place.frame is not None:
        T = place.frame.between(T)
    R, q = T.rotation().matrix(), np.asarray(T.transformFrom(p))
    jacobians: dict[str | Unknown, Array] = {frame: jacobian_of_point(R, p)}
    if place.frame is not None:  # its error xi turns T into Expmap(-xi) T, and moves q by -(omega x q + v)
        jacobians[place.name] = -jacobian_of_point(np.eye(3), q)
    if "scale" in refined.names and is_sensor:
        jacobians["scale"] = -(R @ p)[:, None] / float(np.asarray(refined.scale))
    covariance = refined.covariance_of(jacobians)
    axes, half_lengths, radius = ellipsoid(covariance, level, refined.degrees_of_freedom)
    sigma = _noise_of_sensor(noise_m, frame) if is_sensor else 0.0
    lever = None if levers is None or noise_of_A is None else levers[noise_of_A.about]
    return PointUncertainty(
        point_m=p,
        frame=frame,
        seen_from=place.name,
        level=level,
        centre_m=q,
        covariance_m2=covariance,
        axes=axes,
        half_lengths_mm=1e3 * half_lengths,
        radius_mm=1e3 * radius,
        measurement_mm=_measurement_mm(sigma, noise_of_A, lever, level),
    )


def _noise_of_sensor(noise_m: Mapping[Pair, float], sensor: str) -> float | None:
    """The noise of one measurement's translation along each axis, m: the median of the sensor's pairs."""
    noise = [value for pair, value in noise_m.items() if pair.sensor == sensor]
    return float(np.median(noise)) if noise else None


def _measurement_mm(
    sigma_m: float | None, noise_of_A: CarrierNoise | None, lever: Array | None, level: float
) -> float | None:
    """The radius of the noise of one new measurement: of B, and of A where the point crosses from carrier to carrier.

    An error [omega, v] of A moves the point by omega x l + v, in whichever frame; l is the point on the carrier whose
    axes the noise has. None where nothing is measured, or its noise is not known.
    """
    if sigma_m is None:
        return None
    if noise_of_A is None or lever is None:
        return 1e3 * math.sqrt(chdtri(3, 1.0 - level)) * sigma_m if sigma_m else None
    across = sigma_m**2 + noise_of_A.translation_m**2
    turned = across + noise_of_A.rotation_rad**2 * float(lever @ lever)
    return 1e3 * ball_radius(np.array([turned, turned, across]), level)
