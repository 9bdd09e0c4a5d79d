"""Successive estimates of the same numbers, which nights may lack in part: what a control chart is made from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtrc, chdtri, polygamma

from gtsam_rwhec.geometry.poses import Array


@dataclass(frozen=True)
class Spread:
    """How the nights scatter beside what their covariances say."""

    variance: float = 1.0  #: Of the nights over what their covariances say, before the series' own nights are looked at
    freedom: float = math.inf  #: The degrees of freedom with which that is known; infinite for exactly
    correlation: float = 0.0  #: Of the errors of successive nights


#: Nights between which a change is sought; earlier ones are one estimate together.
MOST_NIGHTS = 60


@dataclass(frozen=True, eq=False)
class Nights:
    """Successive estimates of the same numbers, in units in which all are of similar size."""

    days: Array  #: (n,): when, days
    x: Array  #: (n, m): zero in rows that a night does not determine
    information: Array  #: (n, m, m): zero in these rows and columns
    root: Array  #: (n, m, m): R with R' R the information
    groups: Mapping[str, slice]  #: The rows of each frame
    earlier: int = 0  #: Nights that are in the first one together
    #: The residual squares of these, and their number
    squares: float = 0.0
    dimensions: int = 0

    @staticmethod
    def none(groups: Mapping[str, slice]) -> Nights:
        """No nights yet."""
        m = max((rows.stop for rows in groups.values()), default=0)
        return Nights(np.zeros(0), np.zeros((0, m)), np.zeros((0, m, m)), np.zeros((0, m, m)), groups)

    def __len__(self) -> int:
        return len(self.days)

    @property
    def count(self) -> int:
        """How many nights there are, with those that are one together."""
        return len(self) + max(self.earlier - 1, 0)

    @property
    def seen(self) -> np.ndarray:
        """(n, m): what each night determines."""
        seen: np.ndarray = np.einsum("nii->ni", self.information) > 0.0
        return seen

    def with_night(self, day: float, x: Array, information: Array) -> Nights:
        """The nights and one more; beyond ``MOST_NIGHTS`` the two oldest become one."""
        L = information[None]
        more = replace(
            self,
            days=np.append(self.days, day),
            x=np.concatenate([self.x, x[None]]),
            information=np.concatenate([self.information, L]),
            root=np.concatenate([self.root, _root(information, self.information[:1])[None]]),
        )
        return more if len(more) <= MOST_NIGHTS else more._with_oldest_joined()

    def after(self, night: int) -> Nights:
        """The nights from index ``night`` on."""
        return Nights(self.days[night:], self.x[night:], self.information[night:], self.root[night:], self.groups)

    def until(self, night: int) -> Nights:
        """The nights before index ``night``."""
        return replace(
            self, days=self.days[:night], x=self.x[:night], information=self.information[:night], root=self.root[:night]
        )

    def _with_oldest_joined(self) -> Nights:
        L = self.information[:2].sum(axis=0)
        seen = np.diagonal(L) > 0.0
        mean = np.where(seen, solved(L, np.einsum("nij,nj->i", self.information[:2], self.x[:2]), seen), 0.0)
        r = self.x[:2] - mean
        return replace(
            self,
            days=self.days[1:],
            x=np.concatenate([mean[None], self.x[2:]]),
            information=np.concatenate([L[None], self.information[2:]]),
            root=self.root[1:],
            earlier=max(self.earlier, 1) + 1,
            squares=self.squares + float(np.einsum("ni,nij,nj->", r, self.information[:2], r)),
            dimensions=self.dimensions + int(self.seen[:2].sum()) - int(seen.sum()),
        )


def solved(S: Array, u: Array, seen: np.ndarray) -> Array:
    """S^-1 u over the rows that are seen, 0 in the others; stacks of them too."""
    S = np.where(seen[..., :, None] & seen[..., None, :], S, 0.0)
    S = S + np.where(seen, 0.0, 1.0)[..., :, None] * np.eye(S.shape[-1])
    return np.linalg.solve(S, np.where(seen, u, 0.0)[..., None])[..., 0]


def _root(information: Array, first: Array) -> Array:
    """R with R' R the information: symmetric in the numbers that the first night whitens. No axes are special."""
    whitens = first[0] if len(first) else information
    W = np.linalg.cholesky(whitens + np.diag(np.where(np.diagonal(whitens) > 0.0, 0.0, 1.0))).T
    inward = solve_triangular(W, information, trans="T")
    values, vectors = np.linalg.eigh(solve_triangular(W, inward.T, trans="T"))
    root: Array = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T @ W
    return root


#: The stated covariances have the weight of this many squared deviations, so they decide while nights are few.
STATED_COUNTS = 10.0
#: The prior of how much robots' variances differ (variance of the logarithm), with the weight of this many robots.
ROBOTS_DIFFER, PRIOR_ROBOTS = 0.02, 4.0
#: The prior standard deviation of the correlation, and the largest correlation.
CORRELATION_DEVIATION, MOST_CORRELATION = 0.3, 0.9
#: A difference is left out if the chance of one so large is below this.
TOO_LARGE = 1e-3
#: Squared differences of successive nights overlap: of n of them, n / OVERLAP count.
OVERLAP = 1.5


@dataclass
class SpreadPool:
    """The differences of successive nights of all robots so far."""

    robots: list[int] = field(default_factory=list)  #: The robot of each difference, as its number
    lags: list[int] = field(default_factory=list)  #: 1 for successive nights, 2 for every second
    squares: list[float] = field(default_factory=list)  #: By the sum of both covariances
    dimensions: list[int] = field(default_factory=list)

    def add(self, robot: int, lag: int, difference: Array, covariance: Array) -> None:
        """Take one difference (m,) with the sum of both covariances (m, m)."""
        if not len(difference):
            return
        self.robots.append(robot)
        self.lags.append(lag)
        self.squares.append(float(difference @ np.linalg.solve(covariance, difference)))
        self.dimensions.append(len(difference))

    def found(self) -> FoundSpread:
        """What all differences say together."""
        robot, lag = np.array(self.robots, int), np.array(self.lags, int)
        square, size = np.array(self.squares), np.array(self.dimensions, float)
        quiet = np.zeros(len(square), bool)
        for each in (1, 2):
            of = lag == each
            if of.any():
                middle = float(np.median(square[of] / chdtri(size[of], 0.5)))
                quiet[of] = chdtrc(size[of], square[of] / max(middle, 1e-300)) > TOO_LARGE
        first, second = quiet & (lag == 1), quiet & (lag == 2)
        count = int(robot.max()) + 1 if len(robot) else 0
        sums = np.bincount(robot[first], square[first], count).astype(float)
        sizes = np.bincount(robot[first], size[first], count).astype(float)
        correlation = 0.0
        if second.any() and sums.sum() > 0.0:
            ratio = (square[second].sum() / size[second].sum()) / (sums.sum() / sizes.sum())
            weight = CORRELATION_DEVIATION**2
            correlation = (ratio - 1.0) * weight / (weight + 2.0 / size[second].sum())
        correlation = min(max(correlation, 0.0), MOST_CORRELATION)
        return FoundSpread(sums / (1.0 - correlation), sizes, correlation, _differing(sums, sizes))


@dataclass(frozen=True, eq=False)
class FoundSpread:
    """What the differences say."""

    #: (robots,): squares over the stated variance, of each robot, and their number
    sums: Array
    sizes: Array
    correlation: float  #: Of the errors of successive nights
    differing: float  #: How much robots' variances differ: the variance of their logarithm

    @property
    def variance(self) -> float:
        """The variance of all robots together, over the stated one; 1 where nothing is known."""
        return float((STATED_COUNTS + self.sums.sum()) / (STATED_COUNTS + self.sizes.sum()))

    def of_robot(self, robot: int) -> Spread:
        """The prior of one robot, from all others."""
        own = (self.sums[robot], self.sizes[robot]) if robot < len(self.sums) else (0.0, 0.0)
        size = STATED_COUNTS + float(self.sizes.sum() - own[1])
        variance = (STATED_COUNTS + float(self.sums.sum() - own[0])) / size
        counted = STATED_COUNTS + (size - STATED_COUNTS) / OVERLAP
        freedom = 1.0 / (1.0 / counted + self.differing / 2.0)
        return Spread(variance, freedom, self.correlation)


def _differing(sums: Array, sizes: Array) -> float:
    """The variance of the logarithm of robots' variances, beyond what few nights make; by the median."""
    known = (sizes > 0.0) & (sums > 0.0)
    count = int(known.sum())
    prior = PRIOR_ROBOTS * ROBOTS_DIFFER
    if count < 2:
        return prior / PRIOR_ROBOTS
    half = sizes[known] / OVERLAP / 2.0
    logs = np.log(sums[known] / sizes[known]) - polygamma(0, half) + np.log(half)
    chance = np.asarray(polygamma(1, half))
    # Whitened by what chance alone makes, so that robots with few nights do not rule.
    away = (logs - np.median(logs)) ** 2 / chance
    excess = max(float(np.median(away)) / 0.4549 - 1.0, 0.0) / float(np.mean(1.0 / chance))
    found = (prior + count * excess) / (PRIOR_ROBOTS + count)
    return found if math.isfinite(found) else ROBOTS_DIFFER
