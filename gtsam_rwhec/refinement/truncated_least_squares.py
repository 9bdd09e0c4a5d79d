"""The minimisation of truncated squares: graduated, trimmed, settled, and put to the vote, in certified solutions.

``graduated`` says what for, and what comes of it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.special import chdtr, chdtri

from gtsam_rwhec.errors import CountError, UnderdeterminedError
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import reweighted
from gtsam_rwhec.problem.variance_factors import AS_STATED, VarianceFactors
from gtsam_rwhec.refinement.certified_fit import CertifiedFit, certified_fit
from gtsam_rwhec.refinement.squared_residuals import Measured, Squares
from gtsam_rwhec.refinement.voting import by_vote

NoiseScale = Literal["given", "estimate"]

#: mu grows by this much an iteration (the paper's value).
GRADUATION = 1.4
#: Graduation ends here, with weights between 0 and 1 within some 10 % of c^2 only.
LAST_MU = 10.0
#: Frames of which fewer measurements agree than this are put to the vote.
VOTED = 0.9
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


@dataclass
class TruncatedLeastSquares:
    """The stages and what they share; ``factors`` and ``history`` change on the way."""

    problem: Problem
    threshold: float
    max_iterations: int
    tell: Progress
    factors: VarianceFactors = AS_STATED
    history: list[Iteration] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.measured = Measured.of(self.problem)
        self.smallest_factors = VarianceFactors(
            2.0 * float(np.median(self.measured.kappa)) * QUIETEST**2,
            QUIETEST**2 / float(np.median(self.measured.sigma)) ** 2,
        )

    def run(self, noise_scale: NoiseScale) -> tuple[CertifiedFit, np.ndarray]:
        """The best answer and its inliers (N,)."""
        everything = self.fit(np.ones(len(self.measured.A)), None)
        if noise_scale == "given":
            return self.best([lambda: self.graduate(everything)])
        halves = self.trim(everything)
        fit, _ = self.settle(halves, estimates=True)
        fit, _ = self.best([lambda: self.graduate(everything), lambda: fit])
        return self.settle(fit, estimates=True)

    def best(self, starts: list[Callable[[], CertifiedFit]]) -> tuple[CertifiedFit, np.ndarray]:
        """Each settled to weights of 0 and 1; the smallest truncated cost. A start that ends with too few is none."""
        ends: list[tuple[float, CertifiedFit, np.ndarray]] = []
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

    def vote(self, fit: CertifiedFit, keep: np.ndarray) -> tuple[CertifiedFit, np.ndarray]:
        """Move single frames to where more of their measurements agree, as long as that pays."""
        least = self.truncated(self.distances(fit))
        for name in self.problem.targets + self.problem.sensors:
            good, total = inlier_count(name, self.measured.by_pair(keep))
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

    def complete(self, fit: CertifiedFit) -> CertifiedFit:
        """With poses by vote of the frames that lost their last measurement, so that they may come back."""
        for name in self.problem.targets + self.problem.sensors:
            if name not in fit.poses and name not in self.problem.fixed:
                fit, _ = by_vote(name, self.measured, fit, self.factors, self.threshold)
        return fit

    def fit(self, weights: Array, previous: CertifiedFit | None) -> CertifiedFit:
        """The certified optimum of weighted measurements."""
        return certified_fit(reweighted(self.problem, self.measured.by_pair(weights), self.factors), previous)

    def distances(self, fit: CertifiedFit) -> Array:
        """d^2 (N,)."""
        return self.measured.together(self.measured.squares(fit), self.factors)

    def truncated(self, distances: Array) -> float:
        """sum min(d^2, c^2)."""
        return float(np.minimum(distances, self.threshold).sum())

    def record(self, stage: str, mu: float, fit: CertifiedFit, distances: Array) -> None:
        """Remember an iteration."""
        inliers = int((distances <= self.threshold).sum())
        self.history.append(Iteration(stage, mu, 0.5 * self.truncated(distances), inliers, fit.certified))
        self.tell(f"rejecting outliers: {stage}, {inliers} of {len(distances)} agree")

    def graduate(self, fit: CertifiedFit) -> CertifiedFit:
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

    def trim(self, fit: CertifiedFit) -> CertifiedFit:
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

    def settle(self, fit: CertifiedFit, *, estimates: bool = False) -> tuple[CertifiedFit, np.ndarray]:
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

    def _from_median(self, squares: Squares) -> VarianceFactors:
        median = float(chdtri(DOF // 2, 0.5))
        return self._factors(
            float(np.median(squares.rotation)) / median, float(np.median(squares.translation)) / median
        )

    def _from_inliers(self, squares: Squares, inliers: np.ndarray) -> VarianceFactors:
        """Mean squares of the inliers, over the share of its variance that a cut chi-square keeps.

        E[chi^2_k; chi^2_k <= c^2] = k F_(k+2)(c^2), F the distribution function.
        """
        kept = float(chdtr(DOF + 2, self.threshold) / chdtr(DOF, self.threshold))
        number = int(inliers.sum())
        unknowns = sum(6.0 for name in self.problem.targets + self.problem.sensors if name not in self.problem.fixed)
        degrees_of_freedom = kept * max(3.0 * number - 0.5 * unknowns, 1.0)
        if number == 0:
            return self.factors
        return self._factors(
            float(squares.rotation[inliers].sum()) / degrees_of_freedom,
            float(squares.translation[inliers].sum()) / degrees_of_freedom,
        )

    def _factors(self, rotation: float, translation: float) -> VarianceFactors:
        return VarianceFactors(
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


def inlier_count(name: str, inliers: dict[Pair, np.ndarray]) -> tuple[int, int]:
    """How many of a frame's measurements agree, of how many."""
    masks = [mask for pair, mask in inliers.items() if name in pair]
    return sum(int(mask.sum()) for mask in masks), sum(len(mask) for mask in masks)
