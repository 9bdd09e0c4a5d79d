"""A frame's pose by vote: each measurement proposes a pose, and the lowest truncated cost decides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.variance_factors import VarianceFactors
from gtsam_rwhec.refinement.squared_residuals import Measured
from gtsam_rwhec.refinement.weighted_fit import WeightedFit

#: A frame has at most this many proposals, sampled evenly in the order of the residuals.
PROPOSALS = 50


def by_vote(
    name: str, measured: Measured, fit: WeightedFit, factors: VarianceFactors, threshold: float
) -> tuple[WeightedFit, float]:
    """The fit with one frame moved to where most of its measurements agree, and the decrease of sum min(d^2, c^2).

    The frame may lack a pose before. The fit stays as given where no proposal is better. ``threshold`` is c^2.
    """
    own = measured.of_pairs([pair for pair in measured.pairs if name in pair and not pair.is_motion])

    def cost_of(candidate: WeightedFit) -> tuple[float, Array]:
        d = own.together(own.squares(candidate), factors)
        return float(np.minimum(d, threshold).sum()), d

    before, d = cost_of(fit)
    best, least = fit, before
    order = np.argsort(np.minimum(d, np.finfo(float).max), kind="stable")
    for index in order[np.unique(np.linspace(0, len(order) - 1, PROPOSALS).astype(int))] if len(order) else []:
        T = _proposed(name, int(index), own, fit)
        if T is None:
            continue
        candidate = replace(fit, poses={**fit.poses, name: T})
        cost, _ = cost_of(candidate)
        if cost < least:
            best, least = candidate, cost
    return best, before - least


def _proposed(name: str, index: int, own: Measured, fit: WeightedFit) -> Array | None:
    """X = A^-1 Y B or Y = A X B^-1 of one measurement, true lengths; None if the pair's other frame has no pose."""
    pair = own.pair_of(index)
    other = pair.sensor if pair.target == name else pair.target
    alpha = fit.alpha.get(pair.target, np.nan)
    if other not in fit.poses or not np.isfinite(alpha) or alpha == 0.0:
        return None
    A, B = own.A[index], own.B[index].copy()
    B[:3, 3] /= alpha
    if pair.target == name:
        X: Array = np.linalg.solve(A, fit.poses[other] @ B)
        return X
    Y: Array = np.linalg.solve(B.T, (A @ fit.poses[other]).T).T
    return Y
