"""Inliers where sigma and kappa do not hold the whole noise: full covariances of B, and noise in A.

Graduated truncation runs on the certified form, which has one sigma and one kappa a measurement. If a covariance is
long along one axis, a fit under its mean is off by many standard deviations along another axis, and good measurements
would be left out. So the truncation first takes the noise of each measurement's worst axis, which keeps every good
measurement and leaves out gross outliers. The kept measurements are then refined and chosen again under the full noise,
until the choice stays the same.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.variance_factors import AS_STATED
from gtsam_rwhec.refinement.geodesic import linearized
from gtsam_rwhec.refinement.pair_data import PairData
from gtsam_rwhec.refinement.variables import State, Variables
from gtsam_rwhec.refinement.weighting import FactorsByPair, residual_covariance


def under_worst_axis(problem: Problem, data: list[PairData], variables: Variables, state: State) -> Problem:
    """The problem with isotropic noise: the noise of B and A together along its worst axis.

    ``state`` gives the lever arms of A's noise, and the carriers' poses when a sensor's clock is off.
    """
    at = linearized(data, variables, state)
    edges = {}
    for item in data:
        C = residual_covariance(item, at[item.pair], AS_STATED)
        scale = problem.fixed_scales.get(item.pair.target, 1.0)  # the data are in true metres
        A = item.residuals.A
        if item.paths is not None:
            A = A @ item.paths.motion(state.offsets_s[item.pair.sensor])
        edges[item.pair] = replace(
            problem.measurements(*item.pair),
            A=A,
            sigma=scale * np.sqrt(np.linalg.eigvalsh(C[:, 3:, 3:])[:, -1]),
            kappa=0.5 / np.linalg.eigvalsh(C[:, :3, :3])[:, -1],
            covariances=None,
        )
    return problem.with_measurements(edges)


def inliers_of(
    data: list[PairData], variables: Variables, state: State, factors: FactorsByPair, threshold: float
) -> dict[Pair, np.ndarray]:
    """By pair, (N,) booleans: r' C^-1 r is within the threshold. False where the estimate lacks a frame."""
    known = set(state.X) | set(state.Y)
    present = [item for item in data if known.issuperset(item.pair)]
    at = linearized(present, variables, state)
    result = {item.pair: np.zeros(item.count, dtype=bool) for item in data}
    everywhere = next(iter(factors.values()))
    for item in present:
        r = at[item.pair].residual
        C = residual_covariance(item, at[item.pair], factors.get(item.pair, everywhere))
        square: Array = np.einsum("ni,ni->n", r, np.linalg.solve(C, r[:, :, None])[:, :, 0])
        result[item.pair] = square <= threshold
    return result
