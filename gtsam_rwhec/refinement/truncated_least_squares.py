"""The minimisation of truncated squares by certified solutions: graduation, trimming, settling and voting.

``graduated`` has the equation and the reasons.
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
#: A measurement has these degrees of freedom: three of rotation, three of translation.
DOF = 6
#: Each start gets at most this many re-weighted solutions.
MAX_ITERATIONS = 100


@dataclass(frozen=True)
class Iteration:
    """One re-weighted solution."""

    #: "graduating", "trimming" or "settling".
    stage: str
    #: The graduation's parameter; nan where weights are 0 or 1.
    mu: float
    #: 1/2 sum min(d^2, c^2) of all measurements.
    truncated_cost: float
    #: Number of measurements with d^2 <= c^2.
    inliers: int
    #: Whether the optimum of the re-weighted problem is certified.
    certified: bool


@dataclass
class TruncatedLeastSquares:
    """The stages of the minimisation and their common state: ``factors`` and ``history`` change on the way."""

    problem: Problem
    threshold: float
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
        """The best fit of all starts, each settled to weights of 0 and 1; a start with too few inliers is left out."""
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
        """Move single frames to where more of their measurements agree, if this lowers the cost; return the new fit."""
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
        """The fit with poses by vote for frames that lost all their measurements, so that they may come back."""
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
        """Add an iteration to the history."""
        inliers = int((distances <= self.threshold).sum())
        self.history.append(Iteration(stage, mu, 0.5 * self.truncated(distances), inliers, fit.certified))
        self.tell(f"rejecting outliers: {stage}, {inliers} of {len(distances)} agree")

    def graduate(self, fit: CertifiedFit) -> CertifiedFit:
        """From least squares to truncated least squares with growing mu (Remark 5 and eq. 14 of the paper)."""
        d = self.distances(fit)
        c2 = self.threshold
        worst = float(d[np.isfinite(d)].max(initial=0.0))
        if worst <= c2:
            return fit
        mu = c2 / (2.0 * worst - c2)
        for _ in range(MAX_ITERATIONS):
            w = truncated_weights(d, mu, c2)
            if not w.any():
                break
            fit = self.fit(w / w.max(), fit)  # all are small at first, and priors would dominate
            d = self.distances(fit)
            self.record("graduating", mu, fit, d)
            mu *= GRADUATION
            if mu > LAST_MU or not ((w > 0.0) & (w < 1.0)).any():
                break
        return fit

    def trim(self, fit: CertifiedFit) -> CertifiedFit:
        """Least trimmed squares: the better half of each pair under the median's noise, until it stays the same."""
        keep = np.zeros(len(self.measured.A), dtype=bool)
        for _ in range(MAX_ITERATIONS):
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
            fit = self.fit(keep.astype(np.float64), fit)
            self.record("trimming", np.nan, fit, self.distances(fit))
        return fit

    def settle(self, fit: CertifiedFit, *, estimates: bool = False) -> tuple[CertifiedFit, np.ndarray]:
        """Weights of 0 and 1 until they stay the same: a local minimum of the truncated cost."""
        keep = np.zeros(len(self.measured.A), dtype=bool)
        for _ in range(MAX_ITERATIONS):
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
        """The inliers' mean squares over the share of its variance that a truncated chi-square keeps.

        E[chi^2_k; chi^2_k <= c^2] = k F_(k+2)(c^2), with the distribution function F.
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
    """Weights of the graduated truncated squares, eq. 14: 1 at first, then c / d sqrt(mu (mu + 1)) - mu, then 0."""
    w = np.zeros_like(d2)
    w[d2 <= mu / (mu + 1.0) * c2] = 1.0
    between = (d2 > mu / (mu + 1.0) * c2) & (d2 < (mu + 1.0) / mu * c2)
    w[between] = np.sqrt(c2 * mu * (mu + 1.0) / d2[between]) - mu
    return np.clip(w, 0.0, 1.0)


def inlier_count(name: str, inliers: dict[Pair, np.ndarray]) -> tuple[int, int]:
    """The number of a frame's measurements that agree, and of all its measurements."""
    masks = [mask for pair, mask in inliers.items() if name in pair]
    return sum(int(mask.sum()) for mask in masks), sum(len(mask) for mask in masks)
