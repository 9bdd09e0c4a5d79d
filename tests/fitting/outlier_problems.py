"""Simulated problems with known outliers."""

from __future__ import annotations

from typing import Literal

import numpy as np
from rwhec_factors.se3 import inverse

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, Simulation, perturb
from gtsam_rwhec.simulate.simulated_noise import random_poses

Pair = tuple[str, str]
Kind = Literal["random", "structured"]


def corrupted(
    simulation: Simulation,
    share: float,
    kind: Kind,
    seed: int,
    noise: Noise,
    *,
    pairs: tuple[Pair, ...] | None = None,
    weights: Literal["given", "unit", "three_times_too_small"] = "given",
) -> tuple[rw.Problem, dict[Pair, np.ndarray]]:
    """The problem with a share of each pair's B replaced, and masks of the good measurements.

    "random": poses within 2 m, any rotation. "structured": what a second target, at a random place, shows, with the
    same noise (for motions: a second sensor's).
    """
    generator = np.random.default_rng(seed)
    problem = rw.Problem(simulation.problem.scale)
    good: dict[Pair, np.ndarray] = {}
    for pair in simulation.problem.pairs:
        raw = simulation.problem.measurements(*pair)
        count = len(raw.A)
        mask = np.ones(count, dtype=bool)
        if pairs is None or pair in pairs:
            mask[generator.permutation(count)[: round(share * count)]] = False
        if kind == "random":
            wrong = random_poses(count, 2.0, generator)
        else:
            other = random_poses(1, 2.0, generator)[0]
            seen_from = inverse(other if pair[0] == pair[1] else simulation.Y[pair[1]])
            wrong = seen_from @ raw.A @ other
        wrong[:, :3, 3] *= simulation.scale[pair[0]] if isinstance(simulation.scale, dict) else simulation.scale
        if kind == "structured":
            wrong = perturb(wrong, noise, generator)
        B = np.where(mask[:, None, None], raw.B, wrong)
        factor = {"given": 1.0, "unit": np.nan, "three_times_too_small": 3.0}[weights]
        sigma = None if weights == "unit" else raw.sigma / factor
        kappa = None if weights == "unit" else raw.kappa * factor**2
        if pair[0] == pair[1]:
            problem.add_motion(pair[1], raw.A, B, sigma, kappa, stamps_ns=raw.stamps_ns)
        else:
            problem.add(*pair, raw.A, B, sigma, kappa, stamps_ns=raw.stamps_ns)
        good[pair] = mask
    for name, scale in simulation.problem.fixed_scales.items():
        problem.fix_scale(name, scale)
    return problem, good
