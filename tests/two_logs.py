"""Two logs of one cell, with a motion and noise of their own, for the tests of what changed."""

from __future__ import annotations

import warnings

import gtsam
import numpy as np

import gtsam_rwhec as rw
from gtsam_rwhec.simulate.simulated_noise import Noise, perturb, random_poses
from gtsam_rwhec.simulate.simulated_rigs import Motion, carrier_poses

NOISE = Noise(sigma_m=0.001, kappa=0.5 / np.radians(0.1) ** 2)
#: A camera that was knocked: some 20 joint deviations.
KNOCKED = gtsam.Pose3(gtsam.Rot3.Rodrigues(0.005, 0.0, 0.0), np.array([0.0, 0.01, 0.0]))
WHERE = np.random.default_rng(0)
X = dict(zip(("board", "tag"), random_poses(2, 1.0, WHERE), strict=True))
Y = dict(zip(("left", "right"), random_poses(2, 0.3, WHERE), strict=True))


def log_of(
    seed: int, *, knocked: str = "", count: int = 20, motion: Motion | None = None, sensors: tuple[str, ...] = tuple(Y)
) -> rw.Problem:
    """A log in which one frame may have moved since."""
    generator = np.random.default_rng([1, seed])
    A = np.linalg.inv(carrier_poses(motion or Motion("general"), count, generator))
    moved = {name: pose @ KNOCKED.matrix() if name == knocked else pose for name, pose in (X | Y).items()}
    problem = rw.Problem()
    for target in X:
        for sensor in sensors:
            B = np.linalg.inv(moved[sensor]) @ A @ moved[target]
            stamps = 100_000_000 * np.arange(count)
            problem.add(target, sensor, A, perturb(B, NOISE, generator), 0.001, NOISE.kappa, stamps_ns=stamps)
    return problem


def calibrated(problem: rw.Problem) -> rw.Calibration:
    """With the noise that was stated: quick, and the same for each log."""
    options = rw.CalibrateOptions(noise="given", robust="none", misreadings=False)
    with warnings.catch_warnings(action="ignore", category=rw.errors.RwhecWarning):
        return rw.calibrate(problem, options)
