"""Problems with some of the measurements of another problem, or with other weights, and the same knowledge.

A frame that loses its last measurement is not in the new problem (``Problem.with_measurements``).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import CountError, NoiseError
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.problem.pairs import ByPair, Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.variance_factors import AS_STATED, VarianceFactors


def selected(problem: Problem, keep: ByPair[ArrayLike]) -> Problem:
    """The problem with some of its measurements only.

    The masks ``keep`` (N,) are true for measurements that stay, in the order of ``problem.measurements``. Pairs without
    an entry stay whole. A CountError says which mask is not one boolean for each measurement; other errors are as in
    `reweighted`.
    """
    masks = {Pair(*pair): np.asarray(mask) for pair, mask in keep.items()}
    for pair, mask in masks.items():
        count = problem.moments(*pair).count
        if mask.shape != (count,) or mask.dtype != np.bool_:
            raise CountError(f"keep of {pair} has shape {mask.shape} of {mask.dtype}; give {count} booleans")
    return reweighted(problem, masks)


def reweighted(problem: Problem, weights: ByPair[ArrayLike], factors: VarianceFactors = AS_STATED) -> Problem:
    """The problem with each measurement's squared residual multiplied by a weight.

    Parameters
    ----------
    problem : Problem
        With its raw measurements; it is not changed.
    weights : dict of (target, sensor) to (N,) array
        At least zero. A measurement of weight w > 0 gets sigma / sqrt(w) and w kappa; weight 0 leaves it out. A pair
        without an entry keeps its weights.
    factors : VarianceFactors
        Each kappa is divided by ``factors.rotation``, each sigma^2 multiplied by ``factors.translation``.

    Returns
    -------
    Problem
        Frames in the same order, without the pairs and frames that have no measurement left.

    Raises
    ------
    MeasurementsNotKeptError
        The problem was made with ``keep_measurements=False``.
    FrameError, CountError, NoiseError
        The problem does not have a pair, weights have another count or are negative, or nothing is left.
    """
    for target, sensor in weights:
        problem.moments(target, sensor)
    if not all(np.isfinite(factor) and factor > 0.0 for factor in factors):
        raise NoiseError(f"{factors}: give variance factors that are positive and finite")
    edges: dict[Pair, Measurements] = {}
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        w = np.ones(len(raw.A))
        if pair in weights:
            w = np.asarray(weights[pair], dtype=np.float64)
            if w.shape != (len(raw.A),):
                raise CountError(f"weights of {pair} have shape {w.shape}; give {len(raw.A)}")
            if not (np.isfinite(w).all() and w.min() >= 0.0):
                raise NoiseError(f"weights of {pair} are not all finite and at least zero: {w.min():g}")
        positive = w > 0.0
        if positive.any():
            kept, w = (raw, w) if positive.all() else (raw.selected(positive), w[positive])
            edges[pair] = _weighed(kept, w, factors)
    return problem.with_measurements(edges)


def _weighed(raw: Measurements, w: np.ndarray, factors: VarianceFactors) -> Measurements:
    covariances = raw.covariances
    if covariances is not None:
        deviation = np.sqrt(np.repeat(factors, 3))
        covariances = covariances * deviation[:, None] * deviation / w[:, None, None]
    return replace(
        raw,
        sigma=raw.sigma * np.sqrt(factors.translation / w),
        kappa=raw.kappa * w / factors.rotation,
        covariances=covariances,
    )
