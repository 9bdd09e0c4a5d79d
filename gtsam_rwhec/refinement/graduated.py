"""Outliers rejected without a good start: truncated least squares, graduated, around the certified solver.

    minimise  sum_i min(d_i^2, c^2),    d_i^2 = kappa |R_A R_X - R_Y R_B|_F^2 + |alpha (...) - R_Y t_B|^2 / sigma^2

(Yang, Antonante, Tzoumas, Carlone: Graduated non-convexity for robust spatial perception, 2020, Section III; c^2 is
a quantile of the chi-square distribution with 6 degrees of freedom, which d^2 has at the truth.) For given weights the
problem is a calibration problem again, solved to its global optimum from moments of the re-weighted measurements; so
the scheme has no start to depend on. Graduating is a heuristic all the same: afterwards, frames with outliers are put
to the vote of their own measurements (``consensus``).

With noise unknown, d^2 has no unit to begin with: the worst of all measurements would make everything an inlier. Least
trimmed squares, which keep the better half of each pair, give a first one, the inliers the next. With more than half
outliers that noise is theirs, and nothing tells.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from scipy.stats import chi2

from gtsam_rwhec.accumulation import Pair
from gtsam_rwhec.calibration import solve
from gtsam_rwhec.errors import CountError, OptionError, OutlierError, OutliersWarning, UnderdeterminedError
from gtsam_rwhec.poses import Array
from gtsam_rwhec.problem import Problem
from gtsam_rwhec.refinement.certified_fit import Fit, certified_fit
from gtsam_rwhec.refinement.consensus import by_vote
from gtsam_rwhec.refinement.squared_residuals import Measured, NoiseFactors, Squares
from gtsam_rwhec.selection import reweighted
from gtsam_rwhec.solution import Solution

Progress = Callable[[str], None]
NoiseScale = Literal["given", "estimate"]

#: mu grows by this much an iteration (the paper's value).
GRADUATION = 1.4
#: Graduation ends here, with weights between 0 and 1 within some 10 % of c^2 only.
LAST_MU = 10.0
#: Frames of which fewer measurements agree than this are put to the vote.
VOTED = 0.9
#: A frame or pair of which a smaller share of measurements agrees is named in a warning.
SUSPECT = 0.5
#: So many of them at most.
NAMED = 5
#: Residuals are not taken for quieter than this (m and rad): exact data would leave nothing to divide by.
QUIETEST = 1e-8
#: A vote pays when the truncated cost goes down by more than this, relatively.
PAYS = 1e-6
DOF = 6


@dataclass(frozen=True)
class Iteration:
    """One re-weighted solution.

    Attributes
    ----------
    stage : str
    mu : float
        Of the graduation; nan where weights are 0 or 1.
    truncated_cost : float
        1/2 sum min(d^2, c^2) of all measurements.
    inliers : int
        Measurements with d^2 <= c^2.
    certified : bool
        Whether the re-weighted problem's optimum was proven on the way.
    """

    stage: str
    mu: float
    truncated_cost: float
    inliers: int
    certified: bool


@dataclass(frozen=True)
class Graduated:
    """A calibration from the measurements that agree with it.

    Attributes
    ----------
    solution : Solution
        Of the inliers, certified in full, under the noise factors.
    weights : dict of (target, sensor) to (N,) array
        0 or 1, in the order of ``problem.measurements``.
    inliers : dict of (target, sensor) to (N,) booleans
    noise_factors : NoiseFactors
        Variances of the noise over those that were given, (rotation, translation); 1 unless estimated.
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
    noise_factors: NoiseFactors
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
    work = _Work(problem, float(chi2.ppf(confidence, DOF)), max_iterations, progress)
    try:
        fit, keep = work.run(noise_scale)
        weights = work.measured.by_pair(keep.astype(np.float64))
        if progress is not None:
            progress("certifying the inliers' solution")
        solution = solve(
            reweighted(
                problem,
                weights,
                rotation_factor=work.factors.rotation,
                translation_factor=work.factors.translation,
            ),
            progress=progress,
        )
    except (UnderdeterminedError, CountError) as error:
        raise OutlierError(
            f"too few of the {problem.number_of_measurements} measurements agree for an answer ({error}). With "
            f"confidence={confidence} a measurement agrees up to {np.sqrt(work.threshold):.3g} standard deviations in "
            "all; noise_scale='estimate' does not believe sigma and kappa; else check that B = T_sensor_target, that A "
            "and B are of the same instant, and the names of targets"
        ) from error
    inliers = work.measured.by_pair(keep)
    counts = {name: _count(name, inliers) for name in problem.targets + problem.sensors}
    left_out = tuple(name for name, (good, _) in counts.items() if good == 0)
    suspect = {name: (good, total) for name, (good, total) in counts.items() if good < SUSPECT * total}
    suspect_pairs = {
        pair: (int(mask.sum()), len(mask))
        for pair, mask in inliers.items()
        if mask.sum() < SUSPECT * len(mask) and not any(name in suspect for name in pair)
    }
    _warn(keep, suspect, suspect_pairs, left_out, work.threshold, noise_scale)
    return Graduated(
        solution=solution,
        weights=weights,
        inliers=inliers,
        noise_factors=work.factors,
        threshold=work.threshold,
        truncated_cost=0.5 * work.truncated(work.distances(fit)),
        left_out=left_out,
        suspect=suspect,
        suspect_pairs=suspect_pairs,
        iterations=len(work.history),
        history=tuple(work.history),
    )


@dataclass
class _Work:
    """What the stages share; ``factors`` and ``history`` change on the way."""

    problem: Problem
    threshold: float
    max_iterations: int
    progress: Progress | None
    factors: NoiseFactors = field(default_factory=lambda: NoiseFactors(1.0, 1.0))
    history: list[Iteration] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.measured = Measured.of(self.problem)
        self.smallest_factors = NoiseFactors(
            2.0 * float(np.median(self.measured.kappa)) * QUIETEST**2,
            QUIETEST**2 / float(np.median(self.measured.sigma)) ** 2,
        )

    def run(self, noise_scale: NoiseScale) -> tuple[Fit, np.ndarray]:
        """The best answer and its inliers (N,)."""
        everything = self.fit(np.ones(len(self.measured.A)), None)
        if noise_scale == "given":
            return self.best([lambda: self.graduate(everything)])
        halves = self.trim(everything)
        fit, _ = self.settle(halves, estimates=True)
        fit, _ = self.best([lambda: self.graduate(everything), lambda: fit])
        return self.settle(fit, estimates=True)

    def best(self, starts: list[Callable[[], Fit]]) -> tuple[Fit, np.ndarray]:
        """Each settled to weights of 0 and 1; the smallest truncated cost. A start that ends with too few is none."""
        ends: list[tuple[float, Fit, np.ndarray]] = []
        failure: UnderdeterminedError | CountError | None = None
        for start in starts:
            try:
                fit, keep = self.settle(start())
                ends.append((self.truncated(self.distances(fit)), fit, keep))
            except (UnderdeterminedError, CountError) as error:
                failure = error
        if not ends:
            assert failure is not None
            raise failure
        _, fit, keep = min(ends, key=lambda end: end[0])
        return self.vote(fit, keep)

    def vote(self, fit: Fit, keep: np.ndarray) -> tuple[Fit, np.ndarray]:
        """Move single frames to where more of their measurements agree, as long as that pays."""
        least = self.truncated(self.distances(fit))
        for name in self.problem.targets + self.problem.sensors:
            good, total = _count(name, self.measured.by_pair(keep))
            if good >= VOTED * total or name in self.problem.fixed:
                continue
            moved, saved = by_vote(name, self.measured, fit, self.factors, self.threshold)
            if saved <= 0.0:
                continue
            with contextlib.suppress(UnderdeterminedError, CountError):
                candidate, kept = self.settle(moved)
                cost = self.truncated(self.distances(candidate))
                if cost < least * (1.0 - PAYS):
                    fit, keep, least = candidate, kept, cost
        return fit, keep

    def complete(self, fit: Fit) -> Fit:
        """With poses by vote of the frames that lost their last measurement, so that they may come back."""
        for name in self.problem.targets + self.problem.sensors:
            if name not in fit.poses and name not in self.problem.fixed:
                fit, _ = by_vote(name, self.measured, fit, self.factors, self.threshold)
        return fit

    def fit(self, weights: Array, previous: Fit | None) -> Fit:
        """The certified optimum of weighted measurements."""
        return certified_fit(
            reweighted(
                self.problem,
                self.measured.by_pair(weights),
                rotation_factor=self.factors.rotation,
                translation_factor=self.factors.translation,
            ),
            previous,
        )

    def distances(self, fit: Fit) -> Array:
        """d^2 (N,)."""
        return self.measured.together(self.measured.squares(fit), self.factors)

    def truncated(self, distances: Array) -> float:
        """sum min(d^2, c^2)."""
        return float(np.minimum(distances, self.threshold).sum())

    def record(self, stage: str, mu: float, fit: Fit, distances: Array) -> None:
        """Remember an iteration."""
        inliers = int((distances <= self.threshold).sum())
        self.history.append(Iteration(stage, mu, 0.5 * self.truncated(distances), inliers, fit.certified))
        if self.progress is not None:
            self.progress(f"rejecting outliers: {stage}, {inliers} of {len(distances)} agree")

    def graduate(self, fit: Fit) -> Fit:
        """From least squares to truncated least squares, mu growing (Remark 5 and eq. 14 of the paper)."""
        d = self.distances(fit)
        c2 = self.threshold
        worst = float(d[np.isfinite(d)].max(initial=0.0))
        if worst <= c2:
            return fit
        mu = c2 / (2.0 * worst - c2)
        for _ in range(self.max_iterations):
            w = truncated_weights(d, mu, c2)
            if not w.any():
                break
            fit = self.fit(w / w.max(), fit)  # all small at first: priors would weigh more than what was measured
            d = self.distances(fit)
            self.record("graduating", mu, fit, d)
            mu *= GRADUATION
            if mu > LAST_MU or not ((w > 0.0) & (w < 1.0)).any():
                break
        return fit

    def trim(self, fit: Fit) -> Fit:
        """Least trimmed squares: the better half of each pair, by the noise of the median, until it stays the same."""
        keep = np.zeros(len(self.measured.A), dtype=bool)
        for _ in range(self.max_iterations):
            squares = self.measured.squares(fit)
            self.factors = self._from_median(squares)
            d = self.measured.together(squares, self.factors)
            half = np.zeros_like(keep)
            for rows in self.measured.rows:
                number = _half(rows.stop - rows.start)
                half[rows.start + np.argsort(d[rows], kind="stable")[:number]] = True
            if (half == keep).all():
                break
            keep = half
            fit = self.fit(keep.astype(np.float64), fit)
            self.record("trimming", np.nan, fit, self.distances(fit))
        return fit

    def settle(self, fit: Fit, *, estimates: bool = False) -> tuple[Fit, np.ndarray]:
        """Weights of 0 and 1 until they stay the same: a local minimum of the truncated cost."""
        keep = np.zeros(len(self.measured.A), dtype=bool)
        for _ in range(self.max_iterations):
            squares = self.measured.squares(fit)
            d = self.measured.together(squares, self.factors)
            change = 0.0
            if estimates:
                before = self.factors
                self.factors = self._from_inliers(squares, d <= self.threshold)
                change = float(np.abs(np.log(np.array(self.factors) / np.array(before))).max())
                d = self.measured.together(squares, self.factors)
            inliers = d <= self.threshold
            if (inliers == keep).all() and change < 1e-6:
                break
            keep = inliers
            fit = self.complete(self.fit(keep.astype(np.float64), fit))
            self.record("settling", np.nan, fit, self.distances(fit))
        return fit, keep

    def _from_median(self, squares: Squares) -> NoiseFactors:
        median = float(chi2.ppf(0.5, DOF // 2))
        return self._factors(
            float(np.median(squares.rotation)) / median, float(np.median(squares.translation)) / median
        )

    def _from_inliers(self, squares: Squares, inliers: np.ndarray) -> NoiseFactors:
        """Mean squares of the inliers, over the share of its variance that a cut chi-square keeps.

        E[chi^2_k; chi^2_k <= c^2] = k F_(k+2)(c^2), F the distribution function.
        """
        kept = float(chi2.cdf(self.threshold, DOF + 2) / chi2.cdf(self.threshold, DOF))
        number = int(inliers.sum())
        unknowns = sum(6.0 for name in self.problem.targets + self.problem.sensors if name not in self.problem.fixed)
        freedom = kept * max(3.0 * number - 0.5 * unknowns, 1.0)
        if number == 0:
            return self.factors
        return self._factors(
            float(squares.rotation[inliers].sum()) / freedom, float(squares.translation[inliers].sum()) / freedom
        )

    def _factors(self, rotation: float, translation: float) -> NoiseFactors:
        return NoiseFactors(
            max(rotation, self.smallest_factors.rotation), max(translation, self.smallest_factors.translation)
        )


def truncated_weights(d2: Array, mu: float, c2: float) -> Array:
    """Weights of the graduated truncated squares, eq. 14: 1, 0, or c / d sqrt(mu (mu + 1)) - mu between the two."""
    w = np.zeros_like(d2)
    w[d2 <= mu / (mu + 1.0) * c2] = 1.0
    between = (d2 > mu / (mu + 1.0) * c2) & (d2 < (mu + 1.0) / mu * c2)
    w[between] = np.sqrt(c2 * mu * (mu + 1.0) / d2[between]) - mu
    return np.clip(w, 0.0, 1.0)


def _half(count: int) -> int:
    """More than half, and enough for one pair alone to be determined."""
    return min(count, count // 2 + 2)


def _count(name: str, inliers: dict[Pair, np.ndarray]) -> tuple[int, int]:
    masks = [mask for pair, mask in inliers.items() if name in pair]
    return sum(int(mask.sum()) for mask in masks), sum(len(mask) for mask in masks)


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
    named += [f"{'-'.join(dict.fromkeys(pair))} ({good} of {total})" for pair, (good, total) in suspect_pairs.items()]
    if keep.sum() < SUSPECT * len(keep):
        message = (
            f"only {int(keep.sum())} of {len(keep)} measurements agree to within {np.sqrt(threshold):.3g} standard "
            "deviations; "
        )
        if noise_scale == "given":
            message += "sigma and kappa may claim too much (noise_scale='estimate'), or the frames may be confused"
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
