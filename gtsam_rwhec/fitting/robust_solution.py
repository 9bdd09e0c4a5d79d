"""Outlier rejection without a good start: graduated truncated least squares around the certified solver.

    minimise  sum_i min(d_i^2, c^2),    d_i^2 = kappa |R_A R_X - R_Y R_B|_F^2 + |alpha (...) - R_Y t_B|^2 / sigma^2

(Yang, Antonante, Tzoumas, Carlone: Graduated non-convexity for robust spatial perception, 2020, Section III. At the
truth d^2 has a chi-square distribution with 6 degrees of freedom; c^2 is a quantile of it.) For given weights the
problem is again a calibration problem, whose optimum comes from moments of the re-weighted measurements and from starts
that know nothing of the last one. So the scheme does not depend on a start: the scale of the fit to all measurements
may be negative. Fits on the way are not certified; what is kept at the end is solved once, with its certificate.

If the noise is unknown, d^2 has no unit at first. Least trimmed squares, which keep the better half of each pair, give
the first noise; the inliers give the next. If more than half of the measurements are outliers, they decide this noise,
and the estimate is wrong without a sign of it. Graduation is a heuristic: afterwards the measurements of each frame
with outliers vote on its pose. At the end all measurements are judged anew, each by a test that keeps all N good ones
with 95 % (``admission``): where there are no outliers, nothing is left out.

Every stage has a bound on its number of fits, so that no measurements make it run for ever.
"""

from __future__ import annotations

import warnings
from collections.abc import Generator
from dataclasses import dataclass
from functools import partial
from typing import Literal, TypeVar

import gtsam
import numpy as np
from scipy.special import chdtr, chdtri

from gtsam_rwhec.errors import CountError, OutlierError, OutliersWarning, ScaleError, UnderdeterminedError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.files.terminal_text import some
from gtsam_rwhec.fitting.admission import DOF, inlier_threshold, judged
from gtsam_rwhec.fitting.weighted_fit import Measured, Squares, WeightedFit, by_vote, weighted_fit
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import AS_STATED, VarianceFactors, aligned_at, reweighted, selected
from gtsam_rwhec.solver.solution import Solution, solve

NoiseScale = Literal["given", "estimate"]
#: By pair, (N,) booleans: which measurements count.
Inliers = dict[Pair, np.ndarray]
Found = TypeVar("Found")
#: A stage, fit by fit: it yields what it has done, in words, and returns what it found.
Steps = Generator[str, None, Found]

#: Mu grows by this factor in an iteration (the paper's value).
GRADUATION = 1.4
#: This is the last mu. Here only residuals within about 10 % of c^2 have weights between 0 and 1.
LAST_MU = 10.0
#: A frame's measurements vote on its pose when less than this share of them agree.
VOTED = 0.9
#: Residuals count with at least this standard deviation, m and rad, so that exact data can be divided by it.
QUIETEST = 1e-8
#: A vote is accepted when it decreases the truncated cost by more than this part.
PAYS = 1e-6
#: Graduation takes at most this many steps: where residuals are so large that it would need more, mu grows faster.
MAX_GRADUATIONS = 40
#: Trimming and settling take at most this many fits each; five to ten are usual.
MAX_FITS = 20
#: Frames vote at most this many times, each time all that have outliers.
MAX_VOTES = 3
#: The inliers are judged anew at most this many times; two or three are usual.
MAX_ADMISSIONS = 5
#: With estimated noise so many equations must be left when one measurement is left out.
SPARE = 6
#: With at most this many unknowns per equation, an outlier cannot pull the fit and so hide.
PULLED = 0.02
#: An estimated variance factor is settled when a fit changes it by no more than this part.
SETTLED = 1e-4
#: A warning names a frame or pair when the share of its measurements that agree is below this.
SUSPECT = 0.5
#: No sensor has a larger standard deviation about an axis, rad. A larger estimate comes from outliers.
GROSS_RAD = 0.35
#: A warning names at most this many frames and pairs.
NAMED = 5


@dataclass(frozen=True)
class RobustSolution:
    """The certified solution of the measurements that agree, which these are, and factors of the noise as given."""

    solution: Solution
    inliers: Inliers
    variance_factors: VarianceFactors


@one_blas_thread()
def robust_solution(
    problem: Problem, *, confidence: float = 0.997, noise_scale: NoiseScale = "given", progress: Progress | None = None
) -> RobustSolution:
    """Reject outliers and calibrate from the inliers.

    Parameters
    ----------
    problem : Problem
        A problem that kept its raw measurements.
    confidence : float
        Probability that a good measurement is kept during graduation: c^2 is this quantile of chi-square with 6
        degrees of freedom. At the end each of N is kept with this probability or 1 - 0.05 / N, whichever is larger.
    noise_scale : "given" or "estimate"
        Take sigma and kappa (or covariances) as given; or multiply them by variance factors, one for rotations and one
        for translations, which are estimated from the inliers.
    progress : callable, optional
        Is called with each stage, its step, and the number of measurements that agree.

    Raises
    ------
    MeasurementsNotKeptError
        If the problem was made with ``keep_measurements=False``.
    OutlierError
        If too few measurements agree with each other for an answer, or give a scale that is not positive.

    Warns
    -----
    OutliersWarning
        If less than half of a frame's measurements agree, or less than half of all measurements (then sigma and kappa
        may be too small). One bad tag among many does not stop the calibration: its own pose rests on the measurements
        that agree, and the other poses do not use the rejected ones.
    """
    tell = progress or silent
    if problem.directed:
        fit = weighted_fit(problem, None)
        X, Y = ({n: gtsam.Pose3(fit.poses[n]) for n in names} for names in (problem.targets, problem.sensors))
        problem = aligned_at(problem, X, Y, fit.alpha)
    work = TruncatedLeastSquares(problem, confidence)
    try:
        _, keep = done(work.run(noise_scale), tell)
        tell("certifying the inliers' solution")
        inliers = work.measured.by_pair(keep)
        weights = {pair: mask.astype(np.float64) for pair, mask in inliers.items()}
        solution = solve(reweighted(problem, weights, work.factors), progress=tell)
    except ScaleError as error:
        raise OutlierError(
            f"the {problem.number_of_measurements} measurements have no answer with a positive scale in which most of "
            f"them agree ({error}). Check that A and B are not exchanged or inverted, and the names of targets"
        ) from error
    except (UnderdeterminedError, CountError) as error:
        raise OutlierError(
            f"too few of the {problem.number_of_measurements} measurements agree for an answer ({error}). With "
            f"confidence={confidence} a measurement agrees if it is within {np.sqrt(work.threshold):.3g} standard "
            "deviations. If sigma and kappa may be too small, take noise='estimate'; else check that B = "
            "T_sensor_target, that A and B are of the same instant, and the names of targets"
        ) from error
    for words in _doubts(work, inliers, noise_scale):
        warnings.warn(words, OutliersWarning, stacklevel=3)
    return RobustSolution(solution, inliers, work.factors)


def _doubts(work: TruncatedLeastSquares, inliers: Inliers, noise_scale: NoiseScale) -> list[str]:
    """What a warning says: too few measurements, or too few of them that agree, of all or of some frames and pairs."""
    problem, said = work.problem, []
    if not work.searches:
        said.append(
            f"{problem.number_of_measurements} measurements are too few to tell outliers from noise that is not known: "
            "all of them count. Measure more, or give sigma and kappa (noise='given')"
        )
    frames = {name: inlier_count(name, inliers) for name in problem.targets + problem.sensors}
    suspect = {name: (good, total) for name, (good, total) in frames.items() if good < SUSPECT * total}
    doubted = dict(sorted(suspect.items(), key=lambda item: item[1][0] / item[1][1]))
    doubted |= {
        str(pair): (int(mask.sum()), len(mask))
        for pair, mask in inliers.items()
        if mask.sum() < SUSPECT * len(mask) and not suspect.keys() & set(pair)
    }
    named = [f"{name} ({good} of {total}{'' if good else ': left out'})" for name, (good, total) in doubted.items()]
    kept, total = sum(int(mask.sum()) for mask in inliers.values()), sum(map(len, inliers.values()))
    if kept < SUSPECT * total:
        said.append(
            f"only {kept} of {total} measurements agree to within {np.sqrt(work.threshold):.3g} standard deviations; "
            "check the frame convention, the stamps and the names of frames, and take noise='estimate' if sigma and "
            "kappa may be too small"
        )
    elif named:
        said.append(
            f"less than half of the measurements agree with the answer for {some(named, NAMED)}. Check "
            "whether the frame has moved, or has another frame's name. The poses rest on the measurements that agree"
        )
    turns = work.measured.told[:, 0] > 0.0
    kappa = np.median(work.measured.kappa[turns]) if turns.any() else np.inf
    rotation_rad = float(np.sqrt(0.5 * work.factors.rotation / kappa))
    if noise_scale == "estimate" and work.searches and rotation_rad > GROSS_RAD:
        said.append(
            f"the estimated noise, {np.degrees(rotation_rad):.0f} degrees an axis, is too large for a sensor: more "
            "than half of the measurements may be outliers. Give sigma and kappa and take noise='given', which "
            "withstands more outliers"
        )
    return said


@dataclass
class TruncatedLeastSquares:
    """The stages of the minimisation and their common state: ``factors`` and ``threshold`` (c^2) change on the way.

    Each stage goes on fit by fit, so that who has little time may do some now and the others later.
    """

    problem: Problem
    confidence: float
    factors: VarianceFactors = AS_STATED

    def __post_init__(self) -> None:
        self.threshold = float(chdtri(DOF, 1.0 - self.confidence))
        #: Whether there are measurements enough to tell an outlier.
        self.searches = True
        self.measured = Measured.of(self.problem)
        # What registrations state is the least that they are off by.
        self.smallest_factors = AS_STATED
        if not self.problem.is_of_registrations:
            self.smallest_factors = VarianceFactors(
                2.0 * float(np.median(self.measured.kappa)) * QUIETEST**2,
                QUIETEST**2 / float(np.median(self.measured.sigma)) ** 2,
            )

    def run(self, noise_scale: NoiseScale) -> Steps[tuple[WeightedFit, np.ndarray]]:
        """The best answer and its inliers (N,)."""
        yield "rejecting outliers: the fit to all measurements"
        everyone = np.ones(len(self.measured.A), dtype=bool)
        everything = self.fit(everyone, None)
        self.searches = noise_scale == "given" or self.spare_equations >= SPARE
        if not self.searches or self.is_clean(everything, everyone, noise_scale):
            return everything, everyone
        if not everything.has_positive_scales and self.problem.scale == "per_target":
            everything = yield from with_scales_of_targets_alone(self.problem, self.confidence, noise_scale)
        if noise_scale == "given":
            fit, _ = yield from self.best(everything)
            self.threshold = inlier_threshold(self.confidence, len(everyone))
            return (yield from self.settle(fit))
        trimmed = yield from self.trim(everything)
        fit, _ = yield from self.settle(trimmed, estimates=True)
        fit, _ = yield from self.best(everything, fit)
        fit, keep = yield from self.settle(fit, estimates=True)
        return (yield from self.admit(fit, keep))

    @property
    def free_frames(self) -> list[str]:
        """Frames whose pose is not known."""
        return [name for name in self.problem.targets + self.problem.sensors if name not in self.problem.fixed]

    @property
    def spare_equations(self) -> int:
        """Equations less unknowns when one measurement is left out."""
        owners = {pair.target for pair in self.problem.pairs} - self.problem.fixed_scales.keys()
        scales = {"known": 0, "shared": 1, "per_target": len(owners)}[self.problem.scale]
        unseen = sum(int(self.problem.unseen(name).sum()) for name in self.problem.targets)
        return int(self.measured.told[1:].sum()) - 6 * len(self.free_frames) + unseen - scales

    def is_clean(self, everything: WeightedFit, everyone: np.ndarray, noise_scale: NoiseScale) -> bool:
        """Whether the fit to all measurements shows no outlier, so that there is nothing to do.

        If the noise is not known, an outlier may hide in the fit that it has pulled, unless there are many measurements
        for each unknown: then it cannot pull.
        """
        count = len(everyone)
        # Who agrees as registrations state is no outlier.
        if noise_scale == "given" or self.problem.is_of_registrations:
            agree = bool((self.distances(everything) <= inlier_threshold(self.confidence, count)).all())
            if agree or noise_scale == "given":
                return agree
        unknowns = int(self.measured.told[1:].sum()) - self.spare_equations
        if unknowns > PULLED * float(self.measured.told.sum()):
            return False
        if not judged(self.problem, self.measured, everything, everyone, self.confidence, robust=True).all():
            return False
        self.factors = self._from_inliers(self.measured.squares(everything), everyone)
        self.threshold = inlier_threshold(self.confidence, count)
        return True

    def admit(self, fit: WeightedFit, keep: np.ndarray) -> Steps[tuple[WeightedFit, np.ndarray]]:
        """Judge every measurement anew, under the noise by axis that the inliers show, until the inliers stay.

        The noise is that of the inliers of graduation throughout. If it followed the admitted ones, heavy tails would
        let one another in.
        """
        first = keep
        self.threshold = inlier_threshold(self.confidence, len(keep))
        for step in range(1, MAX_ADMISSIONS + 1):
            agrees = judged(self.problem, self.measured, fit, keep, self.confidence, noise_of=first)
            yield f"rejecting outliers: judging anew, step {step} of at most {MAX_ADMISSIONS}"
            if (agrees == keep).all():
                break
            try:
                fit = self.complete(self.fit(agrees, fit))
            except (UnderdeterminedError, CountError):
                break
            keep = agrees
            yield self.words("admitting", step, MAX_ADMISSIONS, self.distances(fit))
        self.factors = self._from_inliers(self.measured.squares(fit), keep)
        return fit, keep

    def best(self, everything: WeightedFit, *known: WeightedFit) -> Steps[tuple[WeightedFit, np.ndarray]]:
        """The best fit by graduation from that to everything, and of those that are known.

        Each is settled to weights of 0 and 1; one with too few inliers is left out.
        """
        ends: list[tuple[WeightedFit, np.ndarray]] = []
        for number, start in enumerate((None, *known)):
            try:
                begun = start or (yield from self.graduate(everything))
                ends.append((yield from self.settle(begun)))
            except (UnderdeterminedError, CountError):
                if number == len(known) and not ends:
                    raise
        best = min(ends, key=lambda end: self.truncated(self.distances(end[0])))
        return (yield from self.vote(*best))

    def vote(self, fit: WeightedFit, keep: np.ndarray) -> Steps[tuple[WeightedFit, np.ndarray]]:
        """Move frames with outliers to where more of their measurements agree, where this lowers the cost."""
        for _ in range(MAX_VOTES):
            least = self.truncated(self.distances(fit))
            moved, saved = fit, 0.0
            inliers = self.measured.by_pair(keep)
            for name in self.free_frames:
                good, total = inlier_count(name, inliers)
                if good >= VOTED * total:
                    continue
                yield f"rejecting outliers: the measurements of {name} vote, {good} of {total} agree"
                moved, less = by_vote(name, self.problem, moved, self.factors, self.threshold)
                saved += less
            if saved <= 0.0:
                break
            try:
                candidate, kept = yield from self.settle(moved)
            except (UnderdeterminedError, CountError):
                break
            if self.truncated(self.distances(candidate)) >= least * (1.0 - PAYS):
                break
            fit, keep = candidate, kept
        return fit, keep

    def complete(self, fit: WeightedFit) -> WeightedFit:
        """The fit with poses by vote for frames that lost all their measurements, so that they may come back."""
        for name in self.free_frames:
            if name not in fit.poses:
                fit, _ = by_vote(name, self.problem, fit, self.factors, self.threshold)
        return fit

    def fit(self, weights: np.ndarray, previous: WeightedFit | None) -> WeightedFit:
        """The optimum of weighted measurements."""
        by_pair = self.measured.by_pair(weights.astype(np.float64))
        return weighted_fit(reweighted(self.problem, by_pair, self.factors), previous)

    def distances(self, fit: WeightedFit) -> Array:
        """d^2 (N,)."""
        return self.measured.together(self.measured.squares(fit), self.factors)

    def truncated(self, distances: Array) -> float:
        """sum min(d^2, c^2)."""
        return float(np.minimum(distances, self.threshold).sum())

    def words(self, stage: str, step: int, most: int, distances: Array) -> str:
        """Of a fit: its stage, its step, and how many measurements agree."""
        inliers = int((distances <= self.threshold).sum())
        return f"rejecting outliers: {stage}, step {step} of at most {most}, {inliers} of {len(distances)} agree"

    def graduate(self, fit: WeightedFit) -> Steps[WeightedFit]:
        """From least squares to truncated least squares with growing mu (Remark 5 and eq. 14 of the paper)."""
        d = self.distances(fit)
        c2 = self.threshold
        worst = float(d[np.isfinite(d)].max(initial=0.0))
        if worst <= c2:
            return fit
        mu = c2 / (2.0 * worst - c2)
        growth = max(GRADUATION, (LAST_MU / mu) ** (1.0 / (MAX_GRADUATIONS - 1)))
        for step in range(1, MAX_GRADUATIONS + 1):
            w = truncated_weights(d, mu, c2)
            if not w.any():
                break
            fit = self.fit(w / w.max(), fit)  # all are small at first, and priors would dominate
            d = self.distances(fit)
            yield self.words("graduating", step, MAX_GRADUATIONS, d)
            mu *= growth
            if mu > LAST_MU * growth or not ((w > 0.0) & (w < 1.0)).any():
                break
        return fit

    def trim(self, fit: WeightedFit) -> Steps[WeightedFit]:
        """Least trimmed squares: the better half of each pair under the median's noise, until it stays the same."""
        keep = np.zeros(len(self.measured.A), dtype=bool)
        for step in range(1, MAX_FITS + 1):
            squares = self.measured.squares(fit)
            self.factors = self._from_median(squares)
            d = self.measured.together(squares, self.factors)
            half = np.zeros_like(keep)
            for rows in self.measured.rows:
                count = rows.stop - rows.start
                number = min(count, count // 2 + 2)  # enough to determine one pair alone
                half[rows.start + np.argsort(d[rows], kind="stable")[:number]] = True
            if (half == keep).all():
                break
            keep = half
            fit = self.fit(keep, fit)
            yield self.words("trimming", step, MAX_FITS, self.distances(fit))
        return fit

    def settle(self, fit: WeightedFit, *, estimates: bool = False) -> Steps[tuple[WeightedFit, np.ndarray]]:
        """Weights of 0 and 1 until they stay the same: a local minimum of the truncated cost."""
        keep = np.zeros(len(self.measured.A), dtype=bool)
        for step in range(1, MAX_FITS + 1):
            squares = self.measured.squares(fit)
            d = self.measured.together(squares, self.factors)
            change = 0.0
            if estimates:
                before = self.factors
                self.factors = self._from_inliers(squares, d <= self.threshold)
                change = float(np.abs(np.log(np.array(self.factors) / np.array(before))).max())
                d = self.measured.together(squares, self.factors)
            inliers = d <= self.threshold
            if (inliers == keep).all() and change < SETTLED:
                break
            keep = inliers
            fit = self.complete(self.fit(keep, fit))
            yield self.words("settling", step, MAX_FITS, self.distances(fit))
        return fit, keep

    def _from_median(self, squares: Squares) -> VarianceFactors:
        found = []
        for each, told in zip((squares.rotation, squares.translation), self.measured.told.T, strict=True):
            has = told > 0.0
            found.append(float(np.median(each[has] / chdtri(told[has], 0.5))) if has.any() else 1.0)
        return self._factors(*found)

    def _from_inliers(self, squares: Squares, inliers: np.ndarray) -> VarianceFactors:
        """The inliers' mean squares over the share of its variance that a truncated chi-square keeps.

        E[chi^2_k; chi^2_k <= c^2] = k F_(k+2)(c^2), with the distribution function F.
        """
        number = int(inliers.sum())
        if number == 0:
            return self.factors
        kept = float(chdtr(DOF + 2, self.threshold) / chdtr(DOF, self.threshold))
        told = self.measured.told[inliers].sum(axis=0)
        freedom = kept * np.maximum(told - 3.0 * len(self.free_frames), 1.0)
        found = [float(each[inliers].sum()) for each in (squares.rotation, squares.translation)]
        return self._factors(*(s / f if n else 1.0 for s, f, n in zip(found, freedom, told, strict=True)))

    def _factors(self, rotation: float, translation: float) -> VarianceFactors:
        least = self.smallest_factors
        return VarianceFactors(max(rotation, least.rotation), max(translation, least.translation))


def with_scales_of_targets_alone(problem: Problem, confidence: float, noise_scale: NoiseScale) -> Steps[WeightedFit]:
    """A start where outliers make a scale negative: each target alone gives its scale, then all are known.

    Outliers pull the scales of the inverse equation to zero and below (design fact 7), and there is no way back from
    there. A target alone has one scale, which the direct equation holds.
    """
    known = selected(problem, {})
    owners = [name for name in dict.fromkeys(pair.target for pair in problem.pairs) if name not in problem.fixed_scales]
    for number, name in enumerate(owners, 1):
        yield f"rejecting outliers: the scale of {name} alone, {number} of {len(owners)}"
        alone = Problem("shared")
        for pair in problem.pairs:
            if pair.target == name:
                raw = problem.measurements(*pair)
                add = alone.add_motion if pair.is_motion else partial(alone.add, pair.target)
                add(pair.sensor, raw.A, raw.B, raw.sigma, raw.kappa)
        fit, _ = done(TruncatedLeastSquares(alone, confidence).run(noise_scale), silent)
        if not fit.has_positive_scales:
            raise CountError(f"the measurements of {name} that agree with one another give it no positive scale")
        known.fix_scale(name, fit.alpha[name])
    fit, _ = yield from TruncatedLeastSquares(known, confidence).run(noise_scale)
    return fit


def done(steps: Steps[Found], tell: Progress) -> Found:
    """What a stage finds, all its steps at once."""
    while True:
        try:
            tell(next(steps))
        except StopIteration as end:
            found: Found = end.value
            return found


def truncated_weights(d2: Array, mu: float, c2: float) -> Array:
    """Weights of the graduated truncated squares, eq. 14: 1 at first, then c / d sqrt(mu (mu + 1)) - mu, then 0."""
    with np.errstate(divide="ignore"):
        weights: Array = np.clip(np.sqrt(c2 * mu * (mu + 1.0) / d2) - mu, 0.0, 1.0)
    return weights


def inlier_count(name: str, inliers: Inliers) -> tuple[int, int]:
    """The number of a frame's measurements that agree, and of all its measurements."""
    masks = [mask for pair, mask in inliers.items() if name in pair]
    return sum(int(mask.sum()) for mask in masks), sum(len(mask) for mask in masks)
