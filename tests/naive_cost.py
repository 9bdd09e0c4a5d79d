"""The cost as the papers write it: one measurement after another. What the moments must reproduce."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec import Problem
from gtsam_rwhec.problem.moments import Gauge

Transforms = Mapping[str, np.ndarray]


def naive_cost(
    problem: Problem,
    X: Transforms,
    Y: Transforms,
    scale: float | Mapping[str, float],
    form: str = "direct",
    gauge: Gauge | None = None,
) -> float:
    """J of Problem 3 ("direct") or of the inverse equation ("inverse"), priors included, by plain loops.

    The residuals turned round are those of the origin of the target's carrier (for motions, the sensor's), so they
    depend on where that is: ``gauge`` says.
    """
    gauge = gauge or Gauge()
    poses = {**X, **Y}
    total = 0.0
    for target, sensor in problem.pairs:
        data = problem.measurements(target, sensor)
        alpha = scale[target] if isinstance(scale, Mapping) else scale
        T_X, T_Y = poses[target], poses[sensor]
        origin = se3.pose(np.eye(3), gauge.sensor_carrier if target == sensor else gauge.target_carrier)
        for A, B, sigma, kappa in zip(data.A, data.B, data.sigma, data.kappa, strict=True):
            if form == "direct":  # the translations of A, X and Y in the units of B
                left, right = A @ T_X, T_Y @ B
                translation = alpha * left[:3, 3] - T_Y[:3, :3] @ B[:3, 3] - alpha * T_Y[:3, 3]
            else:
                B_true = B.copy()
                B_true[:3, 3] /= alpha
                left, right = B_true @ np.linalg.inv(T_X) @ origin, np.linalg.inv(T_Y) @ A @ origin
                translation = left[:3, 3] - right[:3, 3]
            rotation = left[:3, :3] - right[:3, :3]
            total += 0.5 * (translation @ translation) / sigma**2 + 0.5 * kappa * (rotation**2).sum()
    for name, priors in problem.priors.items():
        for prior in priors:
            apart = poses[name] - prior.transform
            if prior.sigma is not None:
                total += 0.5 * (apart[:3, 3] ** 2).sum() / prior.sigma**2
            if prior.kappa is not None:
                total += 0.5 * prior.kappa * (apart[:3, :3] ** 2).sum()
    return float(total)
