"""After an alarm of the control chart: when it was, which frames moved and by how much, at once or slowly."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.changes.control_chart import NightTest, Shifts, Spread, drifts, shifts, steps
from gtsam_rwhec.changes.nights import Nights
from gtsam_rwhec.geometry.poses import Array

#: What a movement of the frames named leaves must be as large by chance in at least this share of series.
EXPLAINED = 0.01
#: Moments whose log likelihood is less than this below the best one's count as possible.
POSSIBLE = 3.0
#: A drift must fit better than a step by this much in log likelihood, and the other way round.
BETTER = 2.0


@dataclass(frozen=True, eq=False)
class ChangeFound:
    """What changed in a series of nights.

    Attributes
    ----------
    first : int
        Index of the first night after the change: it was between the night before and this one. Of a drift: the first
        night that it moved.
    earliest, latest : int
        The same of the other moments that are hardly less likely.
    groups : tuple of str
        The fewest frames whose movement alone explains everything, the surest first.
    is_of_all : bool
        Whether these are all frames that were tested: something that all of them share moved, such as the arm's base.
    change : dict of str to (6,) array
        How each of these moved (for a drift: by the last night), in the nights' units.
    deviations : dict of str to float
        The same in joint deviations of the estimated movement; nan where its covariance says nothing.
    kind : "step", "drift" or "step or drift"
        Which fits better, or that neither does.
    drift_gain : float
        Log likelihood of the best drift less that of the best step.
    """

    first: int
    earliest: int
    latest: int
    groups: tuple[str, ...]
    is_of_all: bool
    change: dict[str, Array]
    deviations: dict[str, float]
    kind: str
    drift_gain: float


def change_of(nights: Nights, test: NightTest, spread: Spread) -> ChangeFound:
    """What changed, given an alarm at the last of the nights."""
    stepped = shifts(nights, steps(len(nights)), spread.correlation)
    tested = [name for name, rows in nights.groups.items() if stepped.seen[:, rows].any()]
    groups, rows = _fewest(nights, stepped, test.moment - 1, tested, spread)
    at = stepped.ratios(rows)[0]
    k = int(np.argmax(at))
    # The moment may have changed, and with it what explains everything.
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
    """The fewest frames, taken one by one, after which no more than chance is left; and their rows."""
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
    """Of the nights beside the change, over what their covariances say."""
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
