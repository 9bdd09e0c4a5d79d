"""Part of a problem's measurements, or all of them weighed anew, under the same knowledge of frames and scales.

A frame that loses its last measurement is not in the problem that comes back (``Problem.with_measurements``), and the
caller says what that means.
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
    """The problem with only some of its measurements.

    Parameters
    ----------
    problem : Problem
        With its raw measurements; it is not changed.
    keep : dict of (target, sensor) to (N,) booleans
        Which measurements of a pair stay, in the order of ``problem.measurements``. Pairs that it lacks stay whole.

    Returns
    -------
    Problem
        Frames in the same order. Pairs without a measurement are left out, and so are frames without one.

    Raises
    ------
    MeasurementsNotKeptError
        When the problem was made with ``keep_measurements=False``.
    FrameError, CountError
        For a pair that the problem does not have, a mask of another length or kind, or when nothing is left.
    """
    _check_pairs(problem, keep)
    edges: dict[Pair, Measurements] = {}
    for pair in problem.pairs:
        if pair not in keep:
            edges[pair] = problem.measurements(*pair)
            continue
        raw, mask = problem.measurements(*pair), np.asarray(keep[pair])
        if mask.shape != (len(raw.A),) or mask.dtype != np.bool_:
            raise CountError(f"keep of {pair} has shape {mask.shape} of {mask.dtype}; give {len(raw.A)} booleans")
        if mask.any():
            edges[pair] = raw if mask.all() else raw.selected(mask)
    return problem.with_measurements(edges)


def reweighted(
    problem: Problem,
    weights: ByPair[ArrayLike],
    factors: VarianceFactors = AS_STATED,
) -> Problem:
    """The problem with each measurement's squared residual multiplied by a weight.

    Parameters
    ----------
    problem : Problem
        With its raw measurements; it is not changed.
    weights : dict of (target, sensor) to (N,) array
        At least zero; a measurement of weight w has sigma / sqrt(w) and w kappa, and with w = 0 it is left out. Pairs
        that it lacks keep their weights.
    factors : VarianceFactors
        Every kappa is divided by the rotation's, every sigma^2 multiplied by the translation's.

    Returns
    -------
    Problem
        Frames in the same order; pairs and frames without a measurement are left out.

    Raises
    ------
    MeasurementsNotKeptError
        When the problem was made with ``keep_measurements=False``.
    FrameError, CountError, NoiseError
        For a pair that the problem does not have, weights of another number or below zero, or when nothing is left.
    """
    _check_pairs(problem, weights)
    if not all(np.isfinite(factor) and factor > 0.0 for factor in factors):
        raise NoiseError(f"{factors}: a variance factor is positive and finite")
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


def _check_pairs(problem: Problem, given: ByPair[ArrayLike]) -> None:
    for target, sensor in given:
        problem.moments(target, sensor)


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
