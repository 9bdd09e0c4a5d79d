"""Outliers rejected without a good start: truncated least squares, graduated, around the certified solver.

    minimise  sum_i min(d_i^2, c^2),    d_i^2 = kappa |R_A R_X - R_Y R_B|_F^2 + |alpha (...) - R_Y t_B|^2 / sigma^2

(Yang, Antonante, Tzoumas, Carlone: Graduated non-convexity for robust spatial perception, 2020, Section III; c^2 is
a quantile of the chi-square distribution with 6 degrees of freedom, which d^2 has at the truth.) For given weights the
problem is a calibration problem again, solved to its global optimum from moments of the re-weighted measurements; so
the scheme has no start to depend on. Graduating is a heuristic all the same: afterwards, frames with outliers are put
to the vote of their own measurements (``voting``).

With noise unknown, d^2 has no unit to begin with: the worst of all measurements would make everything an inlier. Least
trimmed squares, which keep the better half of each pair, give a first one, the inliers the next. With more than half
outliers that noise is theirs, and nothing tells.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import get_args

import numpy as np
from scipy.special import chdtri

from gtsam_rwhec.errors import CountError, OptionError, OutlierError, OutliersWarning, UnderdeterminedError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import reweighted
from gtsam_rwhec.problem.variance_factors import VarianceFactors
from gtsam_rwhec.refinement.truncated_least_squares import (
    DOF,
    Iteration,
    NoiseScale,
    TruncatedLeastSquares,
    inlier_count,
)
from gtsam_rwhec.solving.certified_solution import solve
from gtsam_rwhec.solving.solution import Solution

#: A frame or pair of which a smaller share of measurements agrees is named in a warning.
SUSPECT = 0.5
#: No sensor is this noisy about each axis, rad: an estimate of so much has taken outliers in.
GROSS_RAD = 0.35
#: So many of them at most.
NAMED = 5


@dataclass(frozen=True)
class Graduated:
    """A calibration from the measurements that agree with it.

    Attributes
    ----------
    solution : Solution
        Of the inliers, certified in full, under the variance factors.
    weights : dict of (target, sensor) to (N,) array
        0 or 1, in the order of ``problem.measurements``.
    inliers : dict of (target, sensor) to (N,) booleans
    variance_factors : VarianceFactors
        Of the noise as given; 1 unless estimated.
    threshold : float
        c^2, which inliers' squared residuals do not exceed.
    truncated_cost : float
        1/2 sum min(d^2, c^2).
    left_out : tuple of str
        Frames of which no measurement agrees; the solution lacks them.
    suspect : dict of str to (int, int)
        Frames of which less than half agrees: how many do, of how many.
    suspect_pairs : dict of (target, sensor) to (int, int)
        The same of pairs, where neither of the two frames is suspect as a whole.
    iterations : int
        Re-weighted solutions, of all starts together.
    history : tuple of Iteration
    """

    solution: Solution
    weights: dict[Pair, Array]
    inliers: dict[Pair, np.ndarray]
    variance_factors: VarianceFactors
    threshold: float
    truncated_cost: float
    left_out: tuple[str, ...]
    suspect: dict[str, tuple[int, int]]
    suspect_pairs: dict[Pair, tuple[int, int]]
    iterations: int
    history: tuple[Iteration, ...]


def graduated(
    problem: Problem,
    *,
    confidence: float = 0.997,
    noise_scale: NoiseScale = "given",
    max_iterations: int = 100,
    progress: Progress | None = None,
) -> Graduated:
    """Reject outliers and calibrate from the rest.

    Parameters
    ----------
    problem : Problem
        With its raw measurements.
    confidence : float
        Probability that a good measurement is kept: c^2 is this quantile of chi-square with 6 degrees of freedom.
    noise_scale : "given" or "estimate"
        Whether sigma and kappa (or covariances) are believed, or multiplied by variance factors, one for rotations and
        one for translations, estimated from the inliers.
    max_iterations : int
        Of each start.
    progress : callable, optional
        Told each stage's name.

    Returns
    -------
    Graduated

    Raises
    ------
    MeasurementsNotKeptError
        When the problem was made with ``keep_measurements=False``.
    OutlierError
        When too few measurements agree with one another for any answer.
    OptionError
        For a confidence or another option that cannot be meant.

    Warns
    -----
    OutliersWarning
        Where less than half of a frame's measurements agree, or of all (then sigma and kappa may claim too much). One
        bad tag among many is no reason to give nothing: its own pose rests on what agrees, and the others do not use
        the rest.
    """
    _check_options(confidence, noise_scale, max_iterations)
    tell = progress or silent
    work = TruncatedLeastSquares(problem, float(chdtri(DOF, 1.0 - confidence)), max_iterations, tell)
    try:
        fit, keep = work.run(noise_scale)
        weights = work.measured.by_pair(keep.astype(np.float64))
        tell("certifying the inliers' solution")
        solution = solve(reweighted(problem, weights, work.factors), progress=tell)
    except (UnderdeterminedError, CountError) as error:
        raise OutlierError(
            f"too few of the {problem.number_of_measurements} measurements agree for an answer ({error}). With "
            f"confidence={confidence} a measurement agrees up to {np.sqrt(work.threshold):.3g} standard deviations in "
            "all; noise='estimate' does not believe sigma and kappa; else check that B = T_sensor_target, that A "
            "and B are of the same instant, and the names of targets"
        ) from error
    inliers = work.measured.by_pair(keep)
    counts = {name: inlier_count(name, inliers) for name in problem.targets + problem.sensors}
    left_out = tuple(name for name, (good, _) in counts.items() if good == 0)
    suspect = {name: (good, total) for name, (good, total) in counts.items() if good < SUSPECT * total}
    suspect_pairs = {
        pair: (int(mask.sum()), len(mask))
        for pair, mask in inliers.items()
        if mask.sum() < SUSPECT * len(mask) and not any(name in suspect for name in pair)
    }
    _warn(keep, suspect, suspect_pairs, left_out, work.threshold, noise_scale)
    rotation_rad = float(np.sqrt(0.5 * work.factors.rotation / np.median(work.measured.kappa)))
    if noise_scale == "estimate" and rotation_rad > GROSS_RAD:
        warnings.warn(
            f"no majority of the measurements agrees: the noise estimated for them is {np.degrees(rotation_rad):.0f} "
            "degrees an axis, in which outliers hide. More than half may be wrong; noise='given', with sigma and "
            "kappa, withstands more",
            OutliersWarning,
            stacklevel=2,
        )
    return Graduated(
        solution=solution,
        weights=weights,
        inliers=inliers,
        variance_factors=work.factors,
        threshold=work.threshold,
        truncated_cost=0.5 * work.truncated(work.distances(fit)),
        left_out=left_out,
        suspect=suspect,
        suspect_pairs=suspect_pairs,
        iterations=len(work.history),
        history=tuple(work.history),
    )


def _warn(
    keep: np.ndarray,
    suspect: dict[str, tuple[int, int]],
    suspect_pairs: dict[Pair, tuple[int, int]],
    left_out: tuple[str, ...],
    threshold: float,
    noise_scale: NoiseScale,
) -> None:
    """Say where less than half agrees: of all, or of some frames and pairs."""
    named = [
        f"{name} ({good} of {total}{': left out' if name in left_out else ''})"
        for name, (good, total) in sorted(suspect.items(), key=lambda item: item[1][0] / item[1][1])
    ]
    named += [f"{pair} ({good} of {total})" for pair, (good, total) in suspect_pairs.items()]
    if keep.sum() < SUSPECT * len(keep):
        message = (
            f"only {int(keep.sum())} of {len(keep)} measurements agree to within {np.sqrt(threshold):.3g} standard "
            "deviations; "
        )
        if noise_scale == "given":
            message += "sigma and kappa may claim too much (noise='estimate'), or the frames may be confused"
        else:
            message += "check the frame convention, the stamps, and the names of targets"
    elif named:
        more = f" and {len(named) - NAMED} more (suspect, suspect_pairs)" if len(named) > NAMED else ""
        message = (
            f"less than half of the measurements agree of {', '.join(named[:NAMED])}{more}: moved, or confused with "
            "another? Its pose rests on those that do; the others' poses do not rest on what was rejected"
        )
    else:
        return
    warnings.warn(message, OutliersWarning, stacklevel=3)


def _check_options(confidence: float, noise_scale: str, max_iterations: int) -> None:
    if not (isinstance(confidence, float) and 0.5 < confidence < 1.0):
        raise OptionError(f"confidence={confidence!r}; give a probability between 0.5 and 1")
    if noise_scale not in get_args(NoiseScale):
        raise OptionError(f"noise_scale={noise_scale!r} is not one of {', '.join(map(repr, get_args(NoiseScale)))}")
    if not (isinstance(max_iterations, int) and max_iterations > 0):
        raise OptionError(f"max_iterations={max_iterations!r}; give a positive number")
