"""The control chart: did something move between any two nights of a series, when the nights come one by one?

Each night i has an estimate x_i of the same m numbers (the tangents of all frames from a reference) with its
information L_i, the inverse of its covariance; both miss what the night does not determine. With an unknown baseline
mu and an unknown change d after night k,

    x_i = mu + c_i d + e_i,    c_i = 1 for i > k, else 0 (a step) or the days since (a drift),

the generalised likelihood ratio of "d is not 0" is u' S^-1 u, with S the information of d beside an unknown mu and u
its score (Siegmund and Venkatraman 1995, for one dimension). It is asked for every k, for all frames together and for
each alone. The baseline's own uncertainty counts, so the chart starts at the second night. What is the same in all
nights, such as the constant error of an arm, is in mu. Errors of successive nights may be correlated: e_i is an
autoregression of first order in the whitened numbers. The variance of e_i is known up to a factor, of which `Spread`
has a prior, and the nights say the rest: chances are those of an F (of the nights' own squares beside the change, as a
moderated F of Smyth 2004).

The statistic is the smallest chance over all k and frames. Its limit (`chart_limits`) depends on the night, such that
each night without an earlier alarm has the same chance of a false one (Hawkins and Zamba 2005).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtrc, fdtrc

from gtsam_rwhec.changes.chart_limits import limit_of
from gtsam_rwhec.changes.nights import Nights, solved
from gtsam_rwhec.geometry.poses import Array

#: The share of false alarms that is left to "all of it moved"; the rest is for one frame alone, in equal parts.
OF_ALL = 0.1


@dataclass(frozen=True)
class Spread:
    """How the nights scatter beside what their covariances say.

    Attributes
    ----------
    variance : float
        Of the nights over what their covariances say, before the series' own nights are looked at.
    freedom : float
        The degrees of freedom with which that is known; infinite for exactly.
    correlation : float
        Of the errors of successive nights.
    """

    variance: float = 1.0
    freedom: float = math.inf
    correlation: float = 0.0


@dataclass(frozen=True, eq=False)
class Shifts:
    """What the nights say of changes, one for each profile c.

    Attributes
    ----------
    S : (K, m, m) array
        Information of the change beside an unknown baseline.
    u : (K, m) array
        Its score.
    seen : (K, m) array of bool
        Rows that nights before and after it determine; others are not tested.
    squares, dimensions : float, int
        Residual squares without a change, and their number.
    """

    S: Array
    u: Array
    seen: np.ndarray
    squares: float
    dimensions: int

    def ratios(self, rows: slice | np.ndarray = slice(None)) -> tuple[Array, np.ndarray]:
        """The likelihood ratio (K,) of "these rows changed and no others did", and how many of them are tested."""
        seen = self.seen[:, rows]
        at = np.arange(self.S.shape[-1])[rows]
        found = solved(self.S[:, at[:, None], at], self.u[:, rows], seen)
        return np.einsum("ki,ki->k", np.where(seen, self.u[:, rows], 0.0), found), seen.sum(axis=1)

    def change(self, which: int, rows: np.ndarray) -> Array:
        """The estimated change (r,) of these rows, if only they changed."""
        seen = self.seen[which, rows]
        found: Array = np.where(seen, solved(self.S[which][np.ix_(rows, rows)], self.u[which, rows], seen), 0.0)
        return found

    def chances(self, ratios: Array, dimensions: np.ndarray, spread: Spread) -> Array:
        """How often a ratio of so many dimensions is as large without a change; 1 where nothing is tested."""
        tested = np.maximum(dimensions, 1)
        if math.isinf(spread.freedom):
            found = chdtrc(tested, np.maximum(ratios, 0.0) / spread.variance)
        else:
            left = spread.freedom * spread.variance + np.maximum(self.squares - ratios, 0.0)
            freedom = spread.freedom + self.dimensions - dimensions
            found = fdtrc(tested, freedom, np.maximum(ratios, 0.0) / tested / (left / freedom))
        return np.where(dimensions > 0, found, 1.0)


@dataclass(frozen=True)
class NightTest:
    """What the chart says at the last night.

    Attributes
    ----------
    nights : int
        In the chart, with those that are its reference.
    chance : float
        The smallest chance over moments and frames; 1 where nothing can be tested.
    limit : float
        An alarm is below it.
    moment : int
        Index of the first night after the change that explains the nights best.
    group : str
        The frame that explains it best alone; empty for all together.
    ratio : float
        Its likelihood ratio: squared joint deviations, stated covariances taken as they are.
    """

    nights: int
    chance: float
    limit: float
    moment: int = 0
    group: str = field(default="")
    ratio: float = 0.0

    @property
    def is_alarm(self) -> bool:
        """Whether something changed, at the chart's rate of false alarms."""
        return self.chance < self.limit


def steps(n: int) -> Array:
    """The profiles (n - 1, n) of a step after each night but the last."""
    return np.triu(np.ones((n, n)), 1)[:-1]


def drifts(days: Array) -> Array:
    """The profiles (n - 1, n) of a drift that begins at each night but the last, days."""
    return np.maximum(days - days[:-1, None], 0.0)


def shifts(nights: Nights, profiles: Array, correlation: float = 0.0) -> Shifts:
    """What the nights say of changes with these profiles (K, n), in one go.

    With R_i' R_i = L_i, night i is whitened as (R_i x_i - q R_i-1 x_i-1) / sqrt(1 - q^2), q the correlation, where it
    determines the same as the night before.
    """
    L, R, seen = nights.information, nights.root, nights.seen
    n, m = nights.x.shape
    q = np.zeros(n + 1)
    if correlation > 0.0:
        q[1:n] = np.where((seen[1:] == seen[:-1]).all(axis=1), correlation, 0.0)
        if nights.earlier:  # the mean of many correlated nights
            L = np.concatenate([L[:1] * (1.0 - correlation) / (1.0 + correlation), L[1:]])
            q[1:2] = 0.0
    g = 1.0 / (1.0 - q**2)
    own = g[:n] + g[1:] * q[1:] ** 2
    flat = L.reshape(n, m * m)
    before = np.pad(profiles, ((0, 0), (1, 0)))[:, :n]
    B = ((own * profiles**2) @ flat).reshape(-1, m, m)
    M = ((own * profiles) @ flat).reshape(-1, m, m)
    A = (own @ flat).reshape(m, m)
    if q.any():
        K = np.concatenate([np.zeros((1, m, m)), R[1:].transpose(0, 2, 1) @ R[:-1]])
        flat, link = K.reshape(n, m * m), (g * q)[:n]
        crossed = ((link * profiles * before) @ flat).reshape(-1, m, m)
        B -= crossed + crossed.transpose(0, 2, 1)
        M -= ((link * before) @ flat).reshape(-1, m, m)
        M -= ((link * profiles) @ flat).reshape(-1, m, m).transpose(0, 2, 1)
        summed = (link @ flat).reshape(m, m)
        A -= summed + summed.T
    known = seen.any(axis=0)
    A = A + np.diag(np.where(known, 0.0, 1.0))
    A_inverse = np.linalg.inv(A)
    # From the mean on, so that nothing cancels.
    first, second = _scores(nights.x, L, R, g[:n], q[:n])
    x = nights.x - np.where(known, A_inverse @ (first - second).sum(axis=0), 0.0)
    first, second = _scores(x, L, R, g[:n], q[:n])
    u = profiles @ first - before @ second
    squares = float(np.einsum("ni,ni->", x, first)) - float(np.einsum("ni,ni->", x[:-1], second[1:]))
    S = B - M.transpose(0, 2, 1) @ (A_inverse @ M)
    changed = profiles > 0.0
    both = (changed @ seen > 0.0) & (~changed @ seen > 0.0)
    return Shifts(S, u, both, nights.squares + squares, nights.dimensions + int(seen.sum()) - int(known.sum()))


def _scores(x: Array, L: Array, R: Array, g: Array, q: Array) -> tuple[Array, Array]:
    """g R_i' (R_i x_i - q R_i-1 x_i-1), and the same by q R_i-1: what a night says of itself and of the one before."""
    first = g[:, None] * np.einsum("nij,nj->ni", L, x)
    if not q.any():
        return first, np.zeros_like(first)
    white = np.einsum("nij,nj->ni", R, x)
    last = np.concatenate([np.zeros_like(white[:1]), white[:-1]])
    e = (g * q)[:, None] * last
    first = first - np.einsum("nji,nj->ni", R, e)
    back = (g * q)[:, None] * (white - q[:, None] * last)
    second = np.zeros_like(first)
    second[1:] = np.einsum("nji,nj->ni", R[:-1], back[1:])
    return first, second


def judge_night(nights: Nights, spread: Spread, rate: float) -> NightTest:
    """What the chart says at the last of the nights, at so many false alarms a night."""
    n = len(nights)
    if n < 2:
        return NightTest(nights.count, 1.0, 0.0)
    found = shifts(nights, steps(n), spread.correlation)
    square, dimensions = found.ratios()
    names, chances, ratios, sizes = [""], [found.chances(square, dimensions, spread)], [square], [dimensions]
    for name, rows in nights.groups.items():
        square, size = found.ratios(rows)
        if size.any() and (size != dimensions).any():
            names.append(name)
            chances.append(found.chances(square, size, spread))
            ratios.append(square)
            sizes.append(size)
    alone = len(names) - 1
    weights = np.array([OF_ALL, *[(1.0 - OF_ALL) / alone] * alone]) if alone else np.ones(1)
    # In logarithms, ties (of chances that are 0) go to the largest ratio.
    shares = np.array(chances) / weights[:, None]
    which, k = np.unravel_index(np.lexsort((-np.array(ratios).ravel(), shares.ravel()))[0], shares.shape)
    largest = int(np.max(sizes[-1]))
    return NightTest(
        nights=nights.count,
        chance=min(float(shares[which, k]), 1.0),
        limit=limit_of(nights.count, max(alone, 1), largest, rate),
        moment=int(k) + 1,
        group=names[which],
        ratio=float(ratios[which][k]),
    )
