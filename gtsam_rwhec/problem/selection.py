"""Part of a problem's measurements, or all of them weighed anew, under the same knowledge of frames and scales.

Poses were checked when they were added; here moments are summed again, about the same gauge, and nothing is warned of.
Of what is known (fixed frames, priors, fixed scales) only what concerns frames that keep a measurement stays: a frame
that loses its last one is not in the problem that comes back, and the caller says what that means.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from gtsam_rwhec.errors import CountError, FrameError, NoiseError
from gtsam_rwhec.problem.accumulation import Accumulator, Pair
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.problem.moments import Moments
from gtsam_rwhec.problem.problem import Problem, _Edge


def selected(problem: Problem, keep: Mapping[Pair, ArrayLike]) -> Problem:
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
            raise CountError(
                f"keep of {'-'.join(pair)} has shape {mask.shape} of {mask.dtype}; give {len(raw.A)} booleans"
            )
        if mask.any():
            edges[pair] = raw if mask.all() else _taken(raw, mask)
    return with_measurements(problem, edges)


def reweighted(
    problem: Problem,
    weights: Mapping[Pair, ArrayLike],
    *,
    rotation_factor: float = 1.0,
    translation_factor: float = 1.0,
) -> Problem:
    """The problem with each measurement's squared residual multiplied by a weight.

    Parameters
    ----------
    problem : Problem
        With its raw measurements; it is not changed.
    weights : dict of (target, sensor) to (N,) array
        At least zero; a measurement of weight w has sigma / sqrt(w) and w kappa, and with w = 0 it is left out. Pairs
        that it lacks keep their weights.
    rotation_factor, translation_factor : float
        Variance factors of the noise: every kappa is divided by the one, every sigma^2 multiplied by the other.

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
    for name, factor in (("rotation_factor", rotation_factor), ("translation_factor", translation_factor)):
        if not (np.isfinite(factor) and factor > 0.0):
            raise NoiseError(f"{name} is {factor!r}; a variance factor is positive and finite")
    edges: dict[Pair, Measurements] = {}
    for pair in problem.pairs:
        raw = problem.measurements(*pair)
        w = np.ones(len(raw.A))
        if pair in weights:
            w = np.asarray(weights[pair], dtype=np.float64)
            if w.shape != (len(raw.A),):
                raise CountError(f"weights of {'-'.join(pair)} have shape {w.shape}; give {len(raw.A)}")
            if not (np.isfinite(w).all() and w.min() >= 0.0):
                raise NoiseError(f"weights of {'-'.join(pair)} are not all finite and at least zero: {w.min():g}")
        positive = w > 0.0
        if positive.any():
            kept, w = (raw, w) if positive.all() else (_taken(raw, positive), w[positive])
            edges[pair] = _weighed(kept, w, rotation_factor, translation_factor)
    return with_measurements(problem, edges)


def _check_pairs(problem: Problem, given: Mapping[Pair, ArrayLike]) -> None:
    unknown = [pair for pair in given if pair not in problem.pairs]
    if unknown:
        raise FrameError(f"no measurements of the pair {unknown[0]}; there are {problem.pairs}")


def _taken(raw: Measurements, mask: np.ndarray) -> Measurements:
    return Measurements(
        raw.A[mask],
        raw.B[mask],
        raw.sigma[mask],
        raw.kappa[mask],
        None if raw.stamps_ns is None else raw.stamps_ns[mask],
        None if raw.covariances is None else raw.covariances[mask],
    )


def _weighed(raw: Measurements, w: np.ndarray, rotation_factor: float, translation_factor: float) -> Measurements:
    covariances = raw.covariances
    if covariances is not None:
        deviation = np.sqrt(np.repeat([rotation_factor, translation_factor], 3))
        covariances = covariances * deviation[:, None] * deviation / w[:, None, None]
    return replace(
        raw,
        sigma=raw.sigma * np.sqrt(translation_factor / w),
        kappa=raw.kappa * w / rotation_factor,
        covariances=covariances,
    )


def with_measurements(problem: Problem, edges: dict[Pair, Measurements]) -> Problem:
    """The same knowledge with other measurements of the same frames."""
    if not edges:
        raise CountError(f"nothing is left of {problem}: no measurement was to be kept")
    gauge = problem.gauge
    moments = {
        pair: Moments.of(
            raw.A, raw.B, 1.0 / raw.sigma**2, raw.kappa, gauge, pair[0] == pair[1], "-".join(dict.fromkeys(pair))
        )
        for pair, raw in edges.items()
    }
    left = {name for pair in edges for name in pair}
    result = copy.copy(problem)
    result._kind = {name: kind for name, kind in problem._kind.items() if name in left}
    result._edges = {pair: _Edge([raw], raw.covariances is not None) for pair, raw in edges.items()}
    result._accumulator = Accumulator(gauge, moments)
    result.fixed = {name: T for name, T in problem.fixed.items() if name in left or name not in problem._kind}
    result.priors = {
        name: list(priors) for name, priors in problem.priors.items() if name in left or name not in problem._kind
    }
    owners = {target for target, _ in edges}  # a scale is of what its measurements' lengths are of
    known_owners = {target for target, _ in problem.pairs}
    result.fixed_scales = {
        name: scale for name, scale in problem.fixed_scales.items() if name in owners or name not in known_owners
    }
    return result
