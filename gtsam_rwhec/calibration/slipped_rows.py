"""Rows that slipped: from some row on, each B belongs to the A of another row.

A script that leaves an image without a detection out of B, and not out of A, gives all later images the pose before.
So each row of B has a cost with the A of each row near it: Student's t of its residual, and at most that of a wrong
measurement. The shifts of all rows with the least sum follow from dynamic programming over the rows, where each change
has a price; a robust fit with these shifts, and the shifts again, until they stay. Fits start from whole pairs at each
shift and from parts of them, since a fit of all rows holds rows of both kinds.

Rows are accused only if that explains more than a wrong measurement here and there, than one constant delay, and than a
frame that moved. What errors of neighbouring rows share counts once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors.se3 import expmap, inverse, logmap

from gtsam_rwhec.calibration.moved_frames import explains_more
from gtsam_rwhec.calibration.row_shifts import AS_GIVEN, SHIFTS, cheapest, costs_of, errors_at_shifts, likely_shifts
from gtsam_rwhec.calibration.trial_fits import SLOW_SHARE, Sample, Sampled, Spread, TrialFit, angles, fitted, signal_of
from gtsam_rwhec.files.terminal_text import counted, some
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import scale_at
from gtsam_rwhec.problem.measurements import Measurements, Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.solution import Solution

#: Pairs with fewer rows are not tested.
FEWEST_ROWS = 8
#: At least so many rows slipped. Fewer are as well wrong measurements.
FEWEST_SLIPPED = 3
#: And at least so many agree at each of two shifts of some pair; else all rows of a pair are shifted alike.
FEWEST_AT_A_SHIFT = 2
#: Rows on trial of one pair at most, from all over it; the row where a slip begins is then looked for among all.
MOST_ON_TRIAL = 600
#: A change of the shift costs this and the logarithm of the number of places and shifts that it may have (nats).
PRICE = 7.0
#: All changes together explain so much more (nats) than their price.
SURELY = 8.0
#: The mean gain of a slipped row is above so many of its standard deviations.
SIGMAS = 3.0
#: So much of the rows that slipped agree with the answer then.
AGREE = 0.6
#: Places of a change whose cost is within this (nats) of the least fit as well.
AS_WELL = 3.0
#: Rounds of a fit on trial, and of shifts and fits.
TRIAL_ROUNDS, ROUNDS = 2, 6
#: So many of the first fits, those with the least costs, are followed until their shifts stay.
MOST_SETTLED = 4
#: A sentence names at most so many places.
NAMED = 4
#: Constant delays (rows) that may explain rows of a slow path as well.
DELAYS = (-1.5, -1.0, -0.75, -0.5, -0.25, 0.25, 0.5, 0.75, 1.0, 1.5)


@dataclass(frozen=True)
class Slip:
    """Where the rows of a pair slip; ``str()`` is a sentence's part. Rows are counted from one."""

    pair: Pair
    from_row: int
    #: The rows from which it may as well begin: there, the carriers stood still, or a measurement is wrong
    between: tuple[int, int]
    number: int  #: Rows until the next slip, or to the end
    shift: int  #: From here on, B's row i belongs to A's row i + shift; 0: rows belong together again
    before: int  #: The shift of the rows before
    stamp_ns: int | None = None  #: Of the first such row

    def __str__(self) -> str:
        first, last = self.between
        at = "" if self.stamp_ns is None else f", {self.stamp_ns} ns"
        begin = f"row {self.from_row}" if first == last else f"row {self.from_row} ({first} to {last} fit as well)"
        many = abs(self.shift)
        whose = f"{counted(many, 'row')} {'later' if self.shift > 0 else 'earlier'}"
        belongs = f"belongs to the A that is {whose}" if many else "belongs to its own A again"
        return f"from {begin} of {self.pair}{at} on, B {belongs} ({counted(self.number, 'row')})"


@dataclass(frozen=True)
class Slips:
    """All slips of a problem, and the median residuals of the rows that slipped, as given and at their places."""

    slips: tuple[Slip, ...]
    shifts: Mapping[Pair, np.ndarray]  #: By pair with slips, the shift (N,) of each row
    before: Spread
    after: Spread

    @property
    def words(self) -> str:
        """Where the rows of each pair slip, as a sentence's part; at most `NAMED` places."""
        return some(list(map(str, self.slips)), NAMED, between="; ")


def with_rows_shifted(problem: Problem, shifts: Mapping[Pair, np.ndarray]) -> Problem:
    """The problem with each B beside the A that is so many rows after its own; rows whose A is not there are left out.

    ``shifts`` has those (N,) of some pairs.
    """

    def own(pair: Pair) -> Measurements:
        raw = problem.measurements(*pair)
        if pair not in shifts:
            return raw
        rows = np.arange(len(raw.A)) + shifts[pair]
        there = (rows >= 0) & (rows < len(raw.A))
        return replace(raw.selected(there), A=raw.A[rows[there]])

    return problem.with_measurements({pair: own(pair) for pair in problem.pairs})


def slips_of(problem: Problem, solution: Solution | None, *, is_plain: bool) -> Slips | None:
    """Find rows that slipped; None where none did, or the problem did not keep its measurements.

    Parameters
    ----------
    problem : Problem
    solution : Solution or None
        Its certified solution.
    is_plain : bool
        Whether the residuals of half of the rows, at least, are plainly those of a sensor: then the solution alone
        shows whether a slip is to be looked for.
    """
    sampled = Sampled.of(problem)
    rows = {} if sampled is None else {pair: _Rows.of(raw) for pair, raw in sampled.whole.items() if not pair.is_motion}
    rows = {pair: one for pair, one in rows.items() if len(one.raw.B) >= FEWEST_ROWS}
    if sampled is None or not rows:
        return None
    others = {pair: (raw.A, raw.B) for pair, raw in sampled.whole.items() if pair not in rows}
    trial = _Trial(problem, rows, others, signal_of({pair: one.at(0) for pair, one in rows.items()}))
    if is_plain and solution is not None and not trial.is_suspicious(solution):
        return None
    return trial.found()


@dataclass(frozen=True)
class _Rows:
    """The measurements of a pair, and which rows of B are on trial."""

    raw: Measurements
    rows: np.ndarray

    @staticmethod
    def of(raw: Measurements) -> _Rows:
        return _Rows(raw, np.unique(np.linspace(0, len(raw.B) - 1, MOST_ON_TRIAL).astype(int)))

    def at(self, shifts: np.ndarray | int, part: slice = slice(None)) -> tuple[Array, Array]:
        """A and B of a part of the rows, with B's row i beside A's row i + shift; without those that have none."""
        rows = self.rows[part]
        own = rows + shifts
        there = (own >= 0) & (own < len(self.raw.A))
        return self.raw.A[own[there]], self.raw.B[rows[there]]

    def residuals(self, Y: Array, X: Array, scale: float, shifts: np.ndarray | int) -> Array:
        """The twists (n, 6) from the prediction to B, for rows at these shifts; A beyond an end is that at the end."""
        predicted = inverse(Y) @ self.raw.A[np.clip(self.rows + shifts, 0, len(self.raw.A) - 1)] @ X
        predicted[:, :3, 3] *= scale
        return np.asarray(logmap(inverse(predicted) @ self.raw.B[self.rows]))

    def errors(self, Y: Array, X: Array, scale: float) -> Array:
        """Angles (rad) and distances (2, S, n) of each row on trial at each shift."""
        return errors_at_shifts(self.raw.A, self.raw.B, self.rows, Y, X, scale)


@dataclass(frozen=True)
class _Fit:
    """A fit, the shifts of all rows that cost least with it, and their costs."""

    fit: TrialFit
    costs: dict[Pair, Array]  #: (S, n)
    shifts: dict[Pair, np.ndarray]  #: (n,) numbers into `SHIFTS`
    price: float  #: Of one change

    @property
    def changes(self) -> int:
        return sum(int((np.diff(of, prepend=AS_GIVEN) != 0).sum()) for of in self.shifts.values())

    def gains(self) -> Array:
        """How much less each row costs at its shift than as given (n,), pair after pair."""
        return np.concatenate(
            [
                costs[AS_GIVEN] - np.take_along_axis(costs, self.shifts[pair][None], 0)[0]
                for pair, costs in self.costs.items()
            ]
        )

    @property
    def sum(self) -> float:
        """The least sum of costs, without the price of changes."""
        return self.as_given - float(self.gains().sum())

    @property
    def as_given(self) -> float:
        """The sum of costs without shifts."""
        return float(sum(costs[AS_GIVEN].sum() for costs in self.costs.values()))

    @property
    def of_one_shift(self) -> float:
        """The least sum of costs with one shift of all rows, as given or not: all alike are another mistake."""
        return float(np.sum([costs.sum(axis=1) for costs in self.costs.values()], axis=0).min())

    @property
    def total(self) -> float:
        return self.sum + self.price * self.changes


@dataclass(frozen=True)
class _Trial:
    problem: Problem
    rows: dict[Pair, _Rows]
    others: Sample  #: Pairs that are not tested, and hold the frames together
    signal: Spread

    @property
    def price(self) -> float:
        places = sum(len(one.rows) for one in self.rows.values()) * (len(SHIFTS) - 1)
        return PRICE + math.log(places)

    def is_suspicious(self, solution: Solution) -> bool:
        """Whether some rows in a row fit better at another shift under the solution.

        On a slow path the solution lies between both shifts, and its residuals are alike: what neighbours differ by is
        the noise.
        """
        frames = {name: T.matrix() for name, T in (solution.X | solution.Y).items()}
        errors, steps = {}, []
        for pair, one in self.rows.items():
            scale = scale_at(solution.scale, pair.target)
            errors[pair] = one.errors(frames[pair.sensor], frames[pair.target], scale)
            twists = one.residuals(frames[pair.sensor], frames[pair.target], scale, 0)
            steps.append(np.diff(twists, axis=0) / math.sqrt(2.0))
        sizes = np.linalg.norm(np.concatenate(steps).reshape(-1, 2, 3), axis=2)
        for costs in self.costs_of(errors, Spread.of(*sizes.T)).values():
            sums = np.cumsum(np.insert(costs[AS_GIVEN] - costs, 0, 0.0, axis=1), axis=1)
            if (sums - np.minimum.accumulate(sums, axis=1)).max() > self.price:
                return True
        return False

    def costs_of(self, errors: Mapping[Pair, Array], spread: Spread) -> dict[Pair, Array]:
        medians = np.array([spread.rotation_rad, spread.translation_m])
        return {pair: costs_of(of, medians, self.signal) for pair, of in errors.items()}

    def fit_of(self, fit: TrialFit) -> _Fit:
        """The shifts that cost least with a fit."""
        costs = self.costs_of(self._errors(fit), fit.residual)
        return _Fit(fit, costs, {pair: cheapest(of, self.price)[0] for pair, of in costs.items()}, self.price)

    def _errors(self, fit: TrialFit) -> dict[Pair, Array]:
        scale = fit.scale
        return {
            pair: one.errors(fit.frames[pair.sensor], fit.frames[pair.target], scale_at(scale, pair.target))
            for pair, one in self.rows.items()
        }

    def fitted(self, shifts: Mapping[Pair, np.ndarray | int]) -> TrialFit | None:
        """The robust fit with each row of B beside the A at its shift."""
        sample = dict(self.others)
        for pair, one in self.rows.items():
            poses = one.at(shifts[pair])
            if len(poses[0]):
                sample[pair] = poses
        found = fitted(self.problem, sample, rounds=TRIAL_ROUNDS)
        names = {name for pair in self.rows for name in pair}
        return found if found is not None and names <= found.frames.keys() else None

    def starts(self) -> Iterator[TrialFit]:
        """Fits with the shifts that parts of each pair's rows tell, the likeliest of each pair first."""
        found = [
            [
                (pair, SHIFTS[of])
                for of in likely_shifts(
                    one.raw.A, one.raw.B, one.rows, self.signal, self.price, MOST_SETTLED, is_scaled=self.is_scaled
                )
            ]
            for pair, one in self.rows.items()
        ]
        for k in range(MOST_SETTLED):
            fit = self.fitted(dict(of_pair[min(k, len(of_pair) - 1)] for of_pair in found))
            if fit is not None:
                yield fit

    @property
    def is_scaled(self) -> bool:
        return self.problem.scale != "known"

    def settled(self, best: _Fit) -> _Fit:
        """Shifts and fits in turn until the shifts stay."""
        for _ in range(ROUNDS):
            again = self.fitted({pair: SHIFTS[of] for pair, of in best.shifts.items()})
            if again is None:
                break
            now = self.fit_of(again)
            is_same = all(np.array_equal(now.shifts[pair], of) for pair, of in best.shifts.items())
            if now.total < best.total:
                best = now
            if is_same:
                break
        return best

    def found(self) -> Slips | None:
        base = self.fitted(dict.fromkeys(self.rows, 0))
        if base is None:
            return None
        fits = [self.fit_of(base), *map(self.fit_of, self.starts())]
        simple = min(one.of_one_shift for one in fits)
        fits = [self.settled(one) for one in sorted(fits, key=lambda one: one.total)[:MOST_SETTLED]]
        best = min(fits, key=lambda one: one.total)
        # on a short smooth path other poses explain one shift more of all rows
        first = {pair: SHIFTS[of] - SHIFTS[of[0]] for pair, of in best.shifts.items()}
        if any(of[0] != AS_GIVEN for of in best.shifts.values()) and (fit := self.fitted(first)) is not None:
            fits.append(self.settled(self.fit_of(fit)))
            best = min(fits, key=lambda one: one.total)
        simple = min(simple, *(one.of_one_shift for one in fits))
        if not self.is_sure(best, simple):
            return None
        sample = {pair: one.at(0) for pair, one in self.rows.items()} | dict(self.others)
        if explains_more(self.problem, sample, best.fit.residual) or self.is_late(best):
            return None
        return self.slips(best)

    def is_sure(self, best: _Fit, simple: float) -> bool:
        """Whether the shifts explain more than chance does beside one shift of all rows, whose cost is ``simple``."""
        if not self.changes_among_right_rows(best):
            return False  # a late clock, or rows of a pair that are all shifted, are other mistakes
        moved = np.concatenate([of != AS_GIVEN for of in best.shifts.values()])
        gains = best.gains()[moved]
        wrong = max(float(costs.max()) for costs in best.costs.values())
        chosen = np.concatenate(
            [np.take_along_axis(costs, best.shifts[pair][None], 0)[0] for pair, costs in best.costs.items()]
        )[moved]
        number = int((chosen < wrong).sum())
        if number < FEWEST_SLIPPED or number < AGREE * len(chosen):
            return False
        alike = self.rows_of_one_error(best)
        if (simple - best.sum) / alike < best.changes * best.price + SURELY:
            return False
        return bool(gains.mean() > SIGMAS * gains.std(ddof=1) / math.sqrt(len(gains) / alike))

    def changes_among_right_rows(self, best: _Fit) -> bool:
        """Whether in some pair rows agree with the fit at two shifts, some rows at each."""
        for pair, costs in best.costs.items():
            one, states = self.rows[pair], best.shifts[pair]
            own = one.rows + SHIFTS[states]
            chosen = np.take_along_axis(costs, states[None], 0)[0]
            right = (own >= 0) & (own < len(one.raw.A)) & (chosen < costs.max() - AS_WELL)
            if (np.bincount(states[right], minlength=len(SHIFTS)) >= FEWEST_AT_A_SHIFT).sum() > 1:
                return True
        return False

    def rows_of_one_error(self, best: _Fit) -> float:
        """How many rows in a row have one error: (1 + r) / (1 - r), with r the correlation of neighbours' residuals."""
        products = squares = 0.0
        for pair, one in self.rows.items():
            X, Y = best.fit.frames[pair.target], best.fit.frames[pair.sensor]
            scale = scale_at(best.fit.scale, pair.target)
            twists = one.residuals(Y, X, scale, SHIFTS[best.shifts[pair]])
            size = np.maximum(np.median(np.abs(twists), axis=0), 1e-9)
            z = np.clip(twists / size, -4.0, 4.0)
            products += float((z[1:] * z[:-1]).sum())
            squares += float((z[1:] ** 2 + z[:-1] ** 2).sum()) / 2.0
        r = min(max(products / max(squares, 1e-12), 0.0), 0.98)
        return (1.0 + r) / (1.0 - r)

    def is_late(self, best: _Fit) -> bool:
        """Whether one constant delay explains the rows of a slow path as well."""
        paths = {pair: one.raw.A for pair, one in self.rows.items()}
        if not all(_is_slow(A) for A in paths.values()):
            return False
        for delay in DELAYS:
            late = replace(
                self,
                rows={
                    pair: replace(one, raw=replace(one.raw, A=_later(one.raw.A, delay)))
                    for pair, one in self.rows.items()
                },
            )
            fit = late.fitted(dict.fromkeys(self.rows, 0))
            if fit is not None and late.fit_of(fit).as_given < best.total:
                return True
        return False

    def slips(self, best: _Fit) -> Slips | None:
        """The record of all slips, with the row of each among all rows of its pair."""
        found, shifts, sizes = [], {}, []
        for pair, one in self.rows.items():
            whole = replace(one, rows=np.arange(len(one.raw.B)))
            errors = replace(self, rows={pair: whole})._errors(best.fit)
            costs = self.costs_of(errors, best.fit.residual)[pair]
            states = cheapest(costs, best.price)[0]
            if (states == AS_GIVEN).all():
                continue
            shifts[pair] = SHIFTS[states]
            rows = np.flatnonzero(states != AS_GIVEN)
            of_rows = errors[pair][:, [np.full(len(rows), AS_GIVEN), states[rows]], rows]  # (2, given or own, rows)
            sizes.append(of_rows[:, :, np.isfinite(of_rows).all(axis=(0, 1))])
            found += list(_slips_of_pair(pair, one.raw, costs, states))
        if not found:
            return None
        before, after = np.median(np.concatenate(sizes, axis=2), axis=2).T
        return Slips(tuple(found), shifts, Spread(*before.tolist()), Spread(*after.tolist()))


def _slips_of_pair(pair: Pair, raw: Measurements, costs: Array, states: np.ndarray) -> Iterator[Slip]:
    at = [0, *(np.flatnonzero(np.diff(states)) + 1).tolist()]
    ends = [*at[1:], len(states)]
    for k, (row, end) in enumerate(zip(at, ends, strict=True)):
        state = states[row]
        if k == 0 and state == AS_GIVEN:
            continue
        first = last = row
        if k:
            # cost of beginning at each row between the neighbouring slips, above that of beginning here
            low = at[k - 1]
            gain = np.cumsum(costs[states[row - 1], low:end] - costs[state, low:end])
            above = np.insert(gain, 0, 0.0) - gain[row - low - 1]
            as_well = np.flatnonzero(above < AS_WELL)
            first, last = low + int(as_well.min()), low + int(as_well.max())
        yield Slip(
            pair,
            row + 1,
            (first + 1, last + 1),
            end - row,
            int(SHIFTS[state]),
            int(SHIFTS[states[row - 1]]) if k else 0,
            None if raw.stamps_ns is None else int(raw.stamps_ns[row]),
        )


def _is_slow(A: Array) -> bool:
    """Whether poses turn little from row to row, beside rows far apart."""
    apart, R = len(A) // 2, A[:, :3, :3]
    return bool(np.median(angles(R[1:], R[:-1])) < SLOW_SHARE * np.median(angles(R[apart:], R[: len(R) - apart])))


def _later(A: Array, delay: float) -> Array:
    """Poses (N, 4, 4) of a slow path later by some rows, along the way to the next pose; beyond the ends as there."""
    whole = math.floor(delay)
    rows = np.clip(np.arange(len(A)) + whole, 0, len(A) - 1)
    after = np.clip(rows + 1, 0, len(A) - 1)
    return np.asarray(A[rows] @ expmap((delay - whole) * logmap(inverse(A[rows]) @ A[after])))
