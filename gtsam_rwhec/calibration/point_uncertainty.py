"""How far off a point is, by a refined calibration: the frames in which it may be expressed, and its ellipsoid."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri

from gtsam_rwhec.calibration.task_units import (
    CARRIER_WORDS,
    PointUncertainty,
    checked_level,
    checked_point,
    ellipsoid,
    jacobian_of_point,
)
from gtsam_rwhec.calibration.views import SensorView
from gtsam_rwhec.errors import FrameError, PoseError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.pose_covariances import relative_jacobian
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.refinement.refined import Refined
from gtsam_rwhec.refinement.unknowns import Unknown


@dataclass(frozen=True)
class Carriers:
    """The names of the carriers as the problem states them; None where it does not."""

    sensors: str | None = None
    targets: str | None = None


def point_uncertainty(
    refined: Refined,
    views: Mapping[str, SensorView],
    noise_m: Mapping[Pair, float],
    carriers: Carriers,
    point: ArrayLike,
    *,
    frame: str,
    seen_from: str | None,
    level: float,
) -> PointUncertainty:
    """As ``Calibration.uncertainty_at``; ``noise_m`` is that of one measurement's translation, by pair, metres."""
    p, level = checked_point(point), checked_level(level)
    side, poses = _side_of(refined, frame)
    if frame in views and views[frame].in_front and p[2] <= 0.0:
        raise PoseError(
            f"the point {p.tolist()} is behind {frame}, which saw every target in front of it (z > 0); give a "
            "point in the sensor's own frame, z forward, metres"
        )
    seen_from, other = _resolved(carriers, frame, side, poses, seen_from)
    T = poses[frame] if other is None else poses[other].between(poses[frame])
    R = T.rotation().matrix()
    J = jacobian_of_point(R, p)
    jacobians: dict[str | Unknown, Array] = {}
    if other is None:
        jacobians[frame] = J
    else:
        by_poses = J @ relative_jacobian(poses[other], poses[frame])
        jacobians |= {other: by_poses[:, :6], frame: by_poses[:, 6:]}
    if "scale" in refined.names and side == "sensor":
        jacobians["scale"] = -(R @ p)[:, None] / float(np.asarray(refined.scale))
    covariance = refined.covariance_of(jacobians)
    axes, half_lengths, radius = ellipsoid(covariance, level, refined.degrees_of_freedom)
    return PointUncertainty(
        point_m=p,
        frame=frame,
        seen_from=seen_from,
        level=level,
        centre_m=np.asarray(T.transformFrom(p)),
        covariance_m2=covariance,
        axes=axes,
        half_lengths_mm=1e3 * half_lengths,
        radius_mm=1e3 * radius,
        measurement_mm=_measurement_mm(noise_m, frame, level) if side == "sensor" else None,
    )


def _measurement_mm(noise_m: Mapping[Pair, float], sensor: str, level: float) -> float | None:
    """The radius of a new measurement's noise; the median of the sensor's pairs."""
    noise = [value for pair, value in noise_m.items() if pair.sensor == sensor]
    return 1e3 * math.sqrt(chdtri(3, 1.0 - level)) * float(np.median(noise)) if noise else None


def _side_of(refined: Refined, frame: str) -> tuple[str, Mapping[str, gtsam.Pose3]]:
    for side, poses in (("sensor", refined.Y), ("target", refined.X)):
        if frame in poses:
            return side, poses
    raise FrameError(
        f"there is no frame {brief(frame)}; there are the sensors {', '.join(refined.Y) or '(none)'} and the targets "
        f"{', '.join(refined.X) or '(none)'}"
    )


def _resolved(
    carriers: Carriers, frame: str, side: str, poses: Mapping[str, gtsam.Pose3], seen_from: str | None
) -> tuple[str, str | None]:
    """The name of the frame in which the point is expressed, and the frame itself; None for the carrier."""
    name = carriers.sensors if side == "sensor" else carriers.targets
    words = CARRIER_WORDS[side] if name is None else (name, CARRIER_WORDS[side][0])
    if seen_from is None or seen_from in words:
        return name or f"the frame that carries {frame}", None
    if seen_from in poses and seen_from != frame:
        return seen_from, seen_from
    others = [other for other in poses if other != frame]
    raise FrameError(
        f"{brief(seen_from)} is no frame in which a point of {frame} can be expressed; there are the carrier "
        f"({', '.join(words)}){' and ' + ', '.join(others) if others else ''}"
    )
