"""How nights scatter beside what their covariances say: counted from the differences of successive quiet nights.

Stated covariances may be too small (errors that vary from night to night, such as temperature) or too large (errors
that are the same in all nights). The squared difference of two successive nights of one robot, by the sum of both
covariances, has the mean s (1 - q) in each direction, and of every second night s (1 - q^2), with s the variance over
the stated one and q the correlation of successive nights, of an autoregression. Neither depends on the baseline.
Differences that are too large to be chance are left out, since something may have moved between. Robots differ in s:
the prior of each is the others' mean with the freedom of a scaled inverse chi-square that their differences show
(Smyth 2004).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtrc, chdtri, polygamma

from gtsam_rwhec.changes.control_chart import Spread
from gtsam_rwhec.geometry.poses import Array

#: The stated covariances count as much as this many squared deviations, which rules before there are any nights.
STATED_COUNTS = 10.0
#: Robots' variances differ by this much (variance of the logarithm) before they say so, as PRIOR_ROBOTS would.
ROBOTS_DIFFER, PRIOR_ROBOTS = 0.02, 4.0
#: The correlation's deviation before there are any nights; it lies below the most.
CORRELATION_DEVIATION, MOST_CORRELATION = 0.3, 0.9
#: A difference that is as large by chance less often is left out.
TOO_LARGE = 1e-3
#: Squared differences of successive nights overlap: of n of them, n / OVERLAP count.
OVERLAP = 1.5


@dataclass
class SpreadPool:
    """The differences of successive nights of all robots so far.

    Attributes
    ----------
    robots : list of int
        The robot of each difference, as its number.
    lags : list of int
        1 for successive nights, 2 for every second.
    squares : list of float
        By the sum of both covariances.
    dimensions : list of int
    """

    robots: list[int] = field(default_factory=list)
    lags: list[int] = field(default_factory=list)
    squares: list[float] = field(default_factory=list)
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
        """What they say together."""
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
    """What the differences say.

    Attributes
    ----------
    sums, sizes : (robots,) arrays
        Squares over the stated variance, of each robot, and their number.
    correlation : float
        Of the errors of successive nights.
    differing : float
        How much robots' variances differ: the variance of their logarithm.
    """

    sums: Array
    sizes: Array
    correlation: float
    differing: float

    @property
    def variance(self) -> float:
        """Of all robots together, over the stated one; 1 where nothing is known."""
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
