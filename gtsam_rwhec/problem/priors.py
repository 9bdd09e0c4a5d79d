"""Priors of a frame's pose, and the check that two priors do not contradict one another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.errors import PriorError
from gtsam_rwhec.geometry.poses import Array

#: Two priors on one frame contradict one another when they differ by more than this many standard deviations.
CONTRADICTION_SIGMAS = 6.0


@dataclass(frozen=True)
class Prior:
    """A Gaussian prior: |t - t_0|^2 / sigma^2 and kappa |R - R_0|_F^2 (design fact 11).

    Attributes
    ----------
    transform : (4, 4) array
        The expected pose of the frame on its carrier, metres.
    sigma : float or None
        Standard deviation of the translation along each axis, in metres; None leaves the translation free.
    kappa : float or None
        Concentration of the rotation, 1 / (2 s^2) for s rad about each axis; None leaves the rotation free.
    """

    transform: Array
    sigma: float | None
    kappa: float | None


def difference(T: Array, S: Array) -> str:
    """The distance of two poses, in words."""
    angle = np.degrees(2.0 * np.arcsin(min(1.0, np.linalg.norm(T[:3, :3] - S[:3, :3]) / np.sqrt(8.0))))
    return f"{1e3 * np.linalg.norm(T[:3, 3] - S[:3, 3]):.4g} mm and {angle:.4g} deg apart"


def check_agreement(name: str, first: Prior, second: Prior) -> None:
    """Raise a PriorError where two priors of a frame cannot both be true."""
    said = ""
    if first.sigma is not None and second.sigma is not None:
        distance = np.linalg.norm(first.transform[:3, 3] - second.transform[:3, 3])
        if distance > 1e-9 + CONTRADICTION_SIGMAS * np.hypot(first.sigma, second.sigma):
            said = f"standard deviations of {1e3 * first.sigma:.4g} mm and {1e3 * second.sigma:.4g} mm"
    if first.kappa is not None and second.kappa is not None:
        # The standard deviation about each axis is 1 / sqrt(2 kappa) rad, and |R - R_0|_F^2 = 2 theta^2.
        distance = np.linalg.norm(first.transform[:3, :3] - second.transform[:3, :3])
        spread = np.sqrt(1.0 / first.kappa + 1.0 / second.kappa)
        if distance > 1e-9 + CONTRADICTION_SIGMAS * spread:
            said = said or f"kappa of {first.kappa:.4g} and {second.kappa:.4g}"
    if said:
        apart = difference(first.transform, second.transform)
        raise PriorError(
            f"two stated poses of {name} contradict one another: they are {apart}, with {said}; remove one of the two, "
            "or give a larger sigma or a smaller kappa"
        )
