"""Where each sensor saw its targets: the typical point, for which every report says how far off it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem

#: Unit vectors whose mean is shorter than this have no common direction.
NO_DIRECTION = 0.1


@dataclass(frozen=True)
class SensorView:
    """Where a sensor saw its targets: the typical point (3,) in metres, and whether every one was in front of it."""

    point_m: tuple[float, float, float]
    in_front: bool


def views_of(
    problem: Problem, inliers: Mapping[Pair, np.ndarray], scale: float | dict[str, float]
) -> dict[str, SensorView]:
    """Where each sensor saw its targets: their median distance, in their mean direction, true metres."""
    points: dict[str, list[np.ndarray]] = {}
    if not problem.has_measurements:
        return {}
    for pair in problem.pairs:
        if pair.is_motion:
            continue
        seen = problem.measurements(*pair).B[:, :3, 3]
        if inliers:
            seen = seen[inliers[pair]]
        length = scale.get(pair.target) if isinstance(scale, dict) else scale
        if len(seen) and length is not None:
            points.setdefault(pair.sensor, []).append(seen / length)
    return {sensor: _view(np.concatenate(seen)) for sensor, seen in points.items()}


def _view(seen: np.ndarray) -> SensorView:
    distances = np.linalg.norm(seen, axis=1)
    mean = (seen / np.maximum(distances, 1e-300)[:, None]).mean(axis=0)
    length = float(np.linalg.norm(mean))
    # Seen all around, the mean has no direction; then z, which is forward for cameras.
    direction = mean / length if length > NO_DIRECTION else np.array([0.0, 0.0, 1.0])
    x, y, z = (float(np.median(distances)) * direction).tolist()
    return SensorView((x, y, z), bool((seen[:, 2] > 0.0).all()))
