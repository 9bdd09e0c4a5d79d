"""Beliefs about a frame's pose, and whether two of them can both be true."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.errors import PriorError
from gtsam_rwhec.geometry.poses import Array

#: Two priors on one frame contradict one another when they differ by more than this many standard deviations.
CONTRADICTION_SIGMAS = 6.0


@dataclass(frozen=True)
class Prior:
    """A Gaussian belief: |t - t_0|^2 / sigma^2 and kappa |R - R_0|_F^2 (DESIGN fact 11). None: that part is free."""

    transform: Array
    sigma: float | None
    kappa: float | None


def difference(T: Array, S: Array) -> str:
    """How far apart two poses are, in words."""
    angle = np.degrees(2.0 * np.arcsin(min(1.0, np.linalg.norm(T[:3, :3] - S[:3, :3]) / np.sqrt(8.0))))
    return f"{1e3 * np.linalg.norm(T[:3, 3] - S[:3, 3]):.4g} mm and {angle:.4g} deg apart"


def check_agreement(name: str, first: Prior, second: Prior) -> None:
    """Refuse two beliefs on one frame that cannot both be true."""
    apart = difference(first.transform, second.transform)
    if first.sigma is not None and second.sigma is not None:
        distance = np.linalg.norm(first.transform[:3, 3] - second.transform[:3, 3])
        if distance > 1e-9 + CONTRADICTION_SIGMAS * np.hypot(first.sigma, second.sigma):
            raise PriorError(
                f"what is said of {name} contradicts itself: {apart}, with standard deviations of "
                f"{1e3 * first.sigma:.4g} mm and {1e3 * second.sigma:.4g} mm; remove one of the two, or widen it"
            )
    if first.kappa is not None and second.kappa is not None:
        # kappa |R - R_0|_F^2: a standard deviation of 1 / sqrt(2 kappa) rad an axis, and |.|_F^2 = 2 theta^2.
        distance = np.linalg.norm(first.transform[:3, :3] - second.transform[:3, :3])
        spread = np.sqrt(1.0 / first.kappa + 1.0 / second.kappa)
        if distance > 1e-9 + CONTRADICTION_SIGMAS * spread:
            raise PriorError(
                f"what is said of {name} contradicts itself: {apart}, with kappa of {first.kappa:.4g} and "
                f"{second.kappa:.4g}; remove one of the two, or widen it"
            )
