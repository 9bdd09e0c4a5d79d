"""What two LiDARs of one vehicle tell of their pose to each other by what both saw: a record."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array

#: Information below this share of the largest is rounding.
ROUNDING = 1e-12


@dataclass(frozen=True)
class LidarsTogether:
    """The pose of one LiDAR in the frame of another by what both saw.

    Attributes
    ----------
    T_first_second : (4, 4)
    information : (6, 6)
        Of a right perturbation, rotation first; zero along what the surroundings do not tell.
    places : int
        At so many places maps were registered.
    half_s : float
        Maps are of the sweeps so long before and after.
    overlap : float
        The share of the surfaces of the second's maps that lie on the first's, across the direction where it is least.
    noise_m : float
        Standard deviation of a distance between both.
    scatter : (float, float)
        How turns and shifts of places disagree, over what each claims (mean squares); where above 1 the information is
        less by it.
    why_not : str
        Why it is not to be used; empty if it is.
    clock_sigma_s : float
        Standard deviation of what is between the clocks of both.
    """

    first: str
    second: str
    T_first_second: Array
    information: Array
    places: int = 0
    half_s: float = 0.0
    overlap: float = 0.0
    noise_m: float = 0.0
    scatter: tuple[float, float] = (0.0, 0.0)
    why_not: str = ""
    clock_sigma_s: float = 0.0

    def __str__(self) -> str:
        pair = f"the clouds of {self.first} and {self.second}"
        if self.why_not:
            return f"{pair} do not tell their pose: {self.why_not}"
        values = np.linalg.eigvalsh(self.information)
        told = values > ROUNDING * values[-1]
        slide = int((~told).sum())
        free = f"; what slides ({slide} of 6 directions) is left to the motions" if slide else ""
        spread = np.linalg.pinv(self.information, hermitian=True)
        deg, mm = np.degrees(np.sqrt(np.trace(spread[:3, :3]))), 1e3 * np.sqrt(np.trace(spread[3:, 3:]))
        return (
            f"{pair} are registered with each other at {self.places} places ({self.overlap:.0%} overlap, maps of "
            f"{2 * self.half_s:g} s), which gives the pose to {deg:.2g} degrees and {mm:.2g} mm{free}"
        )
