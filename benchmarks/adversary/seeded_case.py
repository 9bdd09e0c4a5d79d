"""One calibration problem of a campaign, with what it was made of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

import gtsam_rwhec as rw


@dataclass(frozen=True)
class Batch:
    """Arguments of one call of ``add`` (of ``add_motion`` where both names are one)."""

    target: str
    sensor: str
    A: np.ndarray
    B: np.ndarray
    sigma: Any
    kappa: Any


@dataclass(frozen=True)
class Case:
    """One problem with what it was made of."""

    seed: int
    kind: str
    is_sane: bool
    scale: str
    batches: tuple[Batch, ...]
    truth: dict[str, np.ndarray]  #: matrices of all frames
    scales: dict[str, float]  #: true scales of targets and of sensors with motions
    fixed: dict[str, np.ndarray]
    priors: tuple[tuple[str, np.ndarray, float | None, float | None], ...]
    fixed_scales: dict[str, float]
    keep_measurements: bool
    as_sum: bool
    is_exact: bool  #: whether every rotation is orthonormal to rounding: the library must take it as it is
    method: str  #: of ``solve``
    has_nonnegative_scale: bool  #: whether ``solve`` gets that option
    traits: tuple[str, ...] = field(default=())

    def problem(self) -> rw.Problem:
        """The problem as a user states it; warnings are for the caller to hear."""
        parts = [rw.Problem(self.scale, keep_measurements=self.keep_measurements)]
        for index, batch in enumerate(self.batches):
            if self.as_sum and index:
                parts.append(rw.Problem(self.scale, keep_measurements=self.keep_measurements))
            if batch.target == batch.sensor:
                parts[-1].add_motion(batch.sensor, batch.A, batch.B, batch.sigma, batch.kappa)
            else:
                parts[-1].add(batch.target, batch.sensor, batch.A, batch.B, batch.sigma, batch.kappa)
        problem = sum(parts[1:], parts[0])
        for name, pose in self.fixed.items():
            problem.fix(name, pose)
        for name, pose, sigma, kappa in self.priors:
            problem.add_prior(name, pose, sigma, kappa)
        for name, scale in self.fixed_scales.items():
            problem.fix_scale(name, scale)
        return problem

    def solution(self, problem: rw.Problem) -> rw.Solution:
        """What a user gets of it."""
        options = rw.SolveOptions(nonnegative_scale=self.has_nonnegative_scale)
        if self.method != "local":
            return rw.solve(problem, self.method, options=options)
        X, Y = ({name: self.truth[name] for name in names} for names in (problem.targets, problem.sensors))
        X, Y = ({name: T for name, T in poses.items() if name not in problem.fixed} for poses in (X, Y))
        scale = self.scales if self.scale == "per_target" else next(iter(self.scales.values()))
        return rw.solve(problem, "local", initial=(X, Y, scale), options=options)
