"""Problems whose motions are stated pair by pair, and what is identifiable of them."""

from __future__ import annotations

import warnings

import numpy as np
from rwhec_factors.se3 import inverse

import gtsam_rwhec as rw
from gtsam_rwhec.errors import RwhecWarning
from gtsam_rwhec.simulate import Motion, Noise, carrier_poses, perturb
from gtsam_rwhec.simulate.simulated_noise import random_poses

NOISE = Noise(0.01, 1250.0)  # 1 cm, 0.02 rad
MOCAP = Noise(0.001, 2e4)  # 1 mm, 0.005 rad
FRAMES = random_poses(8, 1.0, np.random.default_rng(12))


def identify(problem: rw.Problem) -> rw.Identifiability:
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):
        return rw.solve(problem).identifiability


def of_motions(
    motions: dict[tuple[int, int], tuple[Motion, int]],
    noise: Noise | None,
    noise_in_A: Noise | None = None,
    seed: int = 0,
) -> rw.Problem:
    """Pairs (target, sensor), each seen on a motion of its own, so many times."""
    problem = rw.Problem()
    generator = np.random.default_rng(seed)
    for (j, k), (motion, count) in motions.items():
        X, Y = FRAMES[j], FRAMES[4 + k]
        A = inverse(carrier_poses(motion, count, generator))
        B = perturb(inverse(Y) @ A @ X, noise, generator)
        weights = {} if noise is None else {"sigma": noise.sigma_m, "kappa": noise.kappa}
        problem.add(f"tag{j}", f"cam{k}", perturb(A, noise_in_A, generator), B, **weights)
    return problem
