"""A carrier that turns about all axes, and what a sensor sees of a target."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry import Trajectory
from gtsam_rwhec.simulate import Noise, perturb
from gtsam_rwhec.simulate.simulated_noise import random_poses

X, Y = random_poses(2, 1.0, np.random.default_rng(0))
NOISE = Noise(0.005, 0.5 / np.radians(0.5) ** 2)


def path(t: np.ndarray) -> np.ndarray:
    xi = np.column_stack(
        [
            0.7 * np.sin(1.1 * t) + 0.2 * np.sin(3.1 * t),
            0.6 * np.cos(0.83 * t),
            0.8 * np.sin(0.61 * t + 1.0),
            np.sin(0.4 * t),
            np.cos(0.7 * t),
            0.2 * np.sin(t),
        ]
    )
    return se3.expmap(xi)


def carrier(seconds: float = 30.0) -> Trajectory:
    stamps = np.arange(int(100 * seconds)) * 10**7
    return Trajectory.of(stamps, path(stamps * 1e-9), "/hand")


def track(offset_s: float, seed: int = 0, count: int = 400, bad: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    stamps = 2 * 10**9 + np.arange(count) * 66_666_667
    B = perturb(np.linalg.inv(Y) @ path(stamps * 1e-9 + offset_s) @ X, NOISE, seed)
    generator = np.random.default_rng(seed)
    wrong = generator.random(count) < bad
    B[wrong] = random_poses(int(wrong.sum()), 1.0, generator)
    return stamps, B
