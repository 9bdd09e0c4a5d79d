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

import json
import math
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files

import numpy as np
from scipy.special import chdtrc, fdtrc

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import is_real
from gtsam_rwhec.results.nights import Nights, Spread, solved

#: Share of the false alarms for the test that all frames moved; tests of one frame share the rest equally.
OF_ALL = 0.1


@dataclass(frozen=True, eq=False)
class Shifts:
    """The evidence of the nights for a change with each profile c."""

    S: Array  #: (K, m, m): information of the change beside an unknown baseline
    u: Array  #: (K, m): its score
    seen: np.ndarray  #: (K, m): rows that nights before and after it determine; others are not tested
    #: Residual squares without a change, and their number
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
        return np.where(seen, solved(self.S[which][np.ix_(rows, rows)], self.u[which, rows], seen), 0.0)

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
    """The test of the chart at the last night."""

    nights: int  #: In the chart, with those that are its reference
    chance: float  #: The smallest chance over moments and frames; 1 where nothing can be tested
    limit: float  #: An alarm is below it
    moment: int = 0  #: Index of the first night after the change that explains the nights best
    group: str = field(default="")  #: The frame that explains it best alone; empty for all together
    ratio: float = 0.0  #: Its likelihood ratio: squared joint deviations, stated covariances taken as they are

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
    # Numbers are taken relative to their mean, against cancellation.
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
    tested = {"": (square, dimensions)}
    for name, rows in nights.groups.items():
        square, size = found.ratios(rows)
        if size.any() and (size != dimensions).any():
            tested[name] = square, size
    alone = len(tested) - 1
    weights = np.array([OF_ALL, *[(1.0 - OF_ALL) / alone] * alone]) if alone else np.ones(1)
    # In logarithms, ties (of chances that are 0) go to the largest ratio.
    shares = np.array([found.chances(*each, spread) for each in tested.values()]) / weights[:, None]
    ratios = np.array([square for square, _ in tested.values()])
    which, k = np.unravel_index(np.lexsort((-ratios.ravel(), shares.ravel()))[0], shares.shape)
    return NightTest(
        nights=nights.count,
        chance=min(float(shares[which, k]), 1.0),
        limit=limit_of(nights.count, max(alone, 1), int(list(tested.values())[-1][1].max()), rate),
        moment=int(k) + 1,
        group=list(tested)[which],
        ratio=float(ratios[which, k]),
    )


#: False alarms a night of one robot: one in 1,000 nights.
RATE = 1e-3
#: Rates for which the table holds; it is counted at one in 100 and one in 1,000.
LEAST_RATE, MOST_RATE = 1e-5, 0.02


def checked_rate(nights: object) -> float:
    """The rate of one false alarm in so many nights; OptionError for what the table does not hold for."""
    if not (is_real(nights) and 1.0 / MOST_RATE <= nights <= 1.0 / LEAST_RATE):
        raise OptionError(
            f"nights between false alarms: {brief(nights)}; give {1.0 / MOST_RATE:.0f} to {1.0 / LEAST_RATE:.0f}, "
            f"such as {1.0 / RATE:.0f}"
        )
    return 1.0 / float(nights)


def limit_of(nights: int, frames: int, size: int, rate: float = RATE) -> float:
    """The limit of the statistic of a night.

    The chart has so many ``nights``, this one with them, at least 2; so many ``frames`` are tested alone, of ``size``
    numbers each, at most 6; ``rate`` is false alarms a night.
    """
    logs = _logs(frames, min(size, 6))
    kept, rates = _table()[0], sorted(logs)
    at = [float(np.interp(np.log(nights), np.log(kept), logs[each])) for each in rates]
    slope = (at[1] - at[0]) / np.log(rates[1] / rates[0])
    return rate * float(np.exp(at[0] + slope * np.log(rate / rates[0])))


@cache
def _logs(frames: int, size: int) -> dict[float, Array]:
    """log(limit / rate) at the nights of the table, by rate: between its numbers of frames, or its sizes of one."""
    _, table = _table()
    found = {}
    for rate, rows in table.items():
        along = {at: row for at, row in rows.items() if at[0] == 1} if frames == 1 else rows
        axis = {(at[1] if frames == 1 else at[0]): row for at, row in along.items() if frames == 1 or at[1] == 6}
        known = sorted(axis)
        wanted = np.clip(np.log(size if frames == 1 else frames), np.log(known[0]), np.log(known[-1]))
        values = np.array([axis[each] for each in known])
        found[rate] = np.array([np.interp(wanted, np.log(known), column) for column in values.T])
    return found


@cache
def _table() -> tuple[Array, dict[float, dict[tuple[int, int], Array]]]:
    tree = json.loads(files("gtsam_rwhec.results").joinpath("chart_limits.json").read_text("utf-8"))
    table: dict[float, dict[tuple[int, int], Array]] = {}
    for row in tree["limits"]:
        table.setdefault(row["rate"], {})[row["groups"], row["size"]] = np.log(row["ratio"])
    return np.array(tree["nights"], float), table


#: Frames explain a change if what is left after their movement has at least this chance.
EXPLAINED = 0.01
#: Moments whose log likelihood is less than this below the best one's count as possible.
POSSIBLE = 3.0
#: A drift must fit better than a step by this much in log likelihood, and the other way round.
BETTER = 2.0


@dataclass(frozen=True, eq=False)
class ChangeFound:
    """What changed in a series of nights."""

    #: Index of the first night after the change: it was between the night before and this one. With a drift: the
    #: first night that it moved.
    first: int
    #: The same of the other moments that are hardly less likely
    earliest: int
    latest: int
    groups: tuple[str, ...]  #: The fewest frames whose movement alone explains everything, the surest first
    #: Whether these are all frames that were tested: something that all of them share moved, such as the arm's base
    is_of_all: bool
    change: dict[str, Array]  #: How each of these moved (for a drift: by the last night), in the nights' units
    #: The same in joint deviations of the estimated movement; nan where its covariance says nothing
    deviations: dict[str, float]
    kind: str  #: Which fits better, or that neither does
    drift_gain: float  #: Log likelihood of the best drift less that of the best step


def change_of(nights: Nights, test: NightTest, spread: Spread) -> ChangeFound:
    """What changed, given an alarm at the last of the nights."""
    stepped = shifts(nights, steps(len(nights)), spread.correlation)
    tested = [name for name, rows in nights.groups.items() if stepped.seen[:, rows].any()]
    k = test.moment - 1
    for _ in range(2):  # the moment may change, and with it what explains everything
        groups, rows = _fewest(nights, stepped, k, tested, spread)
        at = stepped.ratios(rows)[0]
        k = int(np.argmax(at))
    drifted = shifts(nights, drifts(nights.days), spread.correlation)
    slow = drifted.ratios(rows)[0]
    slowest = int(np.argmax(slow))
    variance = _variance(stepped, at[k], spread)
    gain = float(slow[slowest] - at[k]) / variance / 2.0
    is_drift = gain > BETTER
    best, moment, likely = (drifted, slowest, slow) if is_drift else (stepped, k, at)
    possible = np.flatnonzero((likely.max() - likely) / variance / 2.0 < POSSIBLE)
    change = best.change(moment, rows) * (nights.days[-1] - nights.days[moment] if is_drift else 1.0)
    place = {name: slice(6 * i, 6 * i + 6) for i, name in enumerate(groups)}
    own = {name: _own(best, moment, rows, place[name], variance) for name in groups}
    return ChangeFound(
        first=moment + 1,
        earliest=int(possible[0]) + 1,
        latest=int(possible[-1]) + 1,
        groups=groups,
        is_of_all=len(tested) > 1 and len(groups) == len(tested),
        change={name: change[place[name]] for name in groups},
        deviations=own,
        kind="drift" if is_drift else "step" if gain < -BETTER else "step or drift",
        drift_gain=gain,
    )


def _fewest(
    nights: Nights, found: Shifts, k: int, tested: list[str], spread: Spread
) -> tuple[tuple[str, ...], np.ndarray]:
    """The fewest frames, added one by one, whose movement explains all but chance; and their rows."""
    (everything,), (size,) = (each[[k]] for each in found.ratios())
    chosen: list[str] = []
    rows = np.zeros(0, int)
    while len(chosen) < len(tested):
        tries = {
            name: np.concatenate([rows, np.arange(*nights.groups[name].indices(10**9))])
            for name in tested
            if name not in chosen
        }
        ratios = {name: found.ratios(each)[0][k] for name, each in tries.items()}
        name = max(ratios, key=lambda each: ratios[each])
        chosen.append(name)
        rows = tries[name]
        left = np.array([everything - ratios[name]])
        of = np.array([size - found.seen[k, rows].sum()])
        if float(found.chances(left, of, spread)[0]) >= EXPLAINED:
            break
    return tuple(chosen), rows


def _variance(found: Shifts, ratio: float, spread: Spread) -> float:
    """The variance of the nights without the change, over what their covariances say."""
    if math.isinf(spread.freedom):
        return spread.variance
    left = spread.freedom * spread.variance + max(found.squares - ratio, 0.0)
    return float(left / (spread.freedom + max(found.dimensions - found.S.shape[-1], 0)))


def _own(found: Shifts, k: int, rows: np.ndarray, place: slice, variance: float) -> float:
    """How far the frame moved, in joint deviations of its own estimated movement."""
    seen = found.seen[k, rows]
    S = np.where(np.outer(seen, seen), found.S[k][np.ix_(rows, rows)], 0.0) + np.diag(np.where(seen, 0.0, 1.0))
    C = np.linalg.inv(S)[place, place]
    d = np.where(seen, found.change(k, rows), 0.0)[place]
    return math.sqrt(max(float(d @ np.linalg.solve(C, d)), 0.0) / variance) if seen[place].any() else math.nan


@dataclass(frozen=True, eq=False)
class Alarm:
    """An alarm."""

    found: ChangeFound  #: When it was, what moved, and how; its indices are of `nights`
    nights: Nights  #: Those of the chart at the alarm
    #: Whether the frames are where they were before the alarm before this one: a few nights were off, and are over
    is_back: bool


@dataclass(frozen=True, eq=False)
class Chart:
    """The chart of one series as it stands."""

    nights: Nights  #: Since the last change; the first of them are the reference
    before: Nights | None = None  #: Those between the change before it and the last one

    def next(
        self, day: float, x: Array, information: Array, spread: Spread, rate: float = RATE
    ) -> tuple[Chart, NightTest, Alarm | None]:
        """The chart with one more night, that night's test, and the alarm if there is one.

        Parameters
        ----------
        day : float
            When, days; not before the last night.
        x, information : (m,) and (m, m) arrays
            As in `Nights`.
        spread : Spread
            How the nights before this one scatter.
        rate : float
            False alarms a night.
        """
        nights = self.nights.with_night(day, x, information)
        test = judge_night(nights, spread, rate)
        if not test.is_alarm:
            return Chart(nights, self.before), test, None
        found = change_of(nights, test, spread)
        now = nights.after(found.first if found.kind != "drift" else max(found.first, test.moment))
        back = None if self.before is None else _joined(self.before, now, spread)
        if back is not None:
            return Chart(back), test, Alarm(found, nights, is_back=True)
        return Chart(now, nights.until(found.first)), test, Alarm(found, nights, is_back=False)


def _joined(before: Nights, now: Nights, spread: Spread) -> Nights | None:
    """Both series as one, if nothing lies between them but chance."""
    joined = before
    for day, x, information in zip(now.days, now.x, now.information, strict=True):
        joined = joined.with_night(day, x, information)
    n = len(joined)
    step = (np.arange(n) >= n - len(now)).astype(float)[None]
    found = shifts(joined, step, spread.correlation)
    ratio, size = found.ratios()
    return joined if size[0] and float(found.chances(ratio, size, spread)[0]) >= EXPLAINED else None
