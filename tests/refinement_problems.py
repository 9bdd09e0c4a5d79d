"""Small simulated problems that the tests of refinement share."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, Simulation, general

SIGMA_M = 0.005
SIGMA_RAD = np.radians(0.5)
KAPPA = 0.5 / SIGMA_RAD**2


def rig(targets: int = 2, sensors: int = 2, seed: int = 0, **options: Any) -> Simulation:
    """A rig among targets, 20 measurements a pair, 5 mm and 0.5 degrees."""
    return general(targets, sensors, seed=seed, **{"noise": Noise(SIGMA_M, KAPPA), **options})


def refined(problem: rw.Problem, **options: Any) -> rw.Refined:
    """Solved and refined, warnings kept quiet."""
    with warnings.catch_warnings(action="ignore", category=rw.errors.RwhecWarning):
        return rw.refine(problem, rw.solve(problem), rw.RefineOptions(**options))


def copied(problem: rw.Problem, **changes: Any) -> rw.Problem:
    """The same measurements in a new problem; ``changes``: functions of (pair, Measurements) for A, B, sigma, ..."""
    new = rw.Problem(scale=problem.scale)
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        fields = {"A": raw.A, "B": raw.B, "sigma": raw.sigma, "kappa": raw.kappa, "stamps_ns": raw.stamps_ns}
        for name, change in changes.items():
            fields[name] = change(pair, raw)
        new.add(*pair, **{name: value for name, value in fields.items() if value is not None})
    for name, scale in problem.fixed_scales.items():
        new.fix_scale(name, scale)
    return new


def distance(first: rw.Refined, second: Any) -> float:
    """Largest difference of any frame's matrix."""
    return max(
        float(np.abs(pose.matrix() - (second.X | second.Y)[name].matrix()).max())
        for name, pose in (first.X | first.Y).items()
    )
