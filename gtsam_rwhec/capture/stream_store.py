"""What a stream keeps: measurements in one compact array, and their sums by pair, which follow each of them."""

from __future__ import annotations

import copy
from dataclasses import fields, replace
from functools import partial

import numpy as np

from gtsam_rwhec.errors import FrameError, MeasurementsNotKeptError, NoiseError, StampError
from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.problem.additions import SIDES
from gtsam_rwhec.problem.many_measurements import Sorted
from gtsam_rwhec.problem.measurements import Measurements, Pair
from gtsam_rwhec.problem.moment_stack import MomentStack
from gtsam_rwhec.problem.moments import BLOCK, Gauge
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import VarianceFactors, of_moments

#: What a measurement may state besides its two poses: all of a stream state the same.
STATED = "sigma", "kappa", "stamps_ns", "covariances"
#: The gauge is chosen again when the number of rows is a power of this: the first poses do not show the centre of a
#: trajectory.
GAUGE_AGAIN = 4


class Store:
    """The measurements of a stream, of which ``rows`` has those that are kept, by arrival.

    With a ``window`` at most twice as many rows are kept: what is older is in the sums alone.
    """

    def __init__(self, knowledge: Problem, window: int | None) -> None:
        self.knowledge, self.window = knowledge, window
        self.pairs: list[Pair] = []
        self.number = 0  #: of measurements that ever came
        self._kind: dict[str, str] = {}
        self._stated: frozenset[str] | None = None
        self._rows, self._size = np.empty(0), 0
        self._gauge = Gauge()
        self._with_R_B = knowledge.scale != "known"
        #: Of all that counts, and of what is not in the rows any more; as stated, without variance factors.
        self._sums = self._folded = MomentStack.nothing(np.zeros(0, dtype=bool), with_R_B=self._with_R_B)

    @property
    def rows(self) -> np.ndarray:
        """The measurements that are kept: a view of their records."""
        return self._rows[: self._size]

    # -- what comes and goes --------------------------------------------------------------------------------------

    def append(self, pair: Pair, raw: Measurements, stated: frozenset[str]) -> int:
        """Take a measurement of a pair, which does not count as yet; its row. Errors leave everything as it was."""
        self._check(pair, stated)
        self._summed(pair, raw)  # a PoseError names a pose that is not valid
        if self._stated is None:
            self._stated = stated
            poses = {"A": (4, 4), "B": (4, 4)} | ({"covariance": (6, 6)} if raw.covariances is not None else {})
            numbers = [("number", "i8"), ("stamp_ns", "i8"), ("judged", "i8"), ("pair", "i4"), ("counts", "?")]
            noise = [("sigma", "f8"), ("kappa", "f8"), ("square", "f8")]
            self._rows = np.zeros(8, dtype=[*numbers, *noise, *((name, "f8", shape) for name, shape in poses.items())])
        if pair not in self.pairs:
            self.pairs.append(pair)
            self._kind |= dict(zip(pair, SIDES, strict=True))
            nothing = MomentStack.nothing(np.array([pair.is_motion]), with_R_B=self._with_R_B)
            self._sums, self._folded = (MomentStack.joined([of, nothing]) for of in (self._sums, self._folded))
        if self._size == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        row = self._rows[self._size]
        row["number"], row["pair"], row["counts"], row["judged"] = self.number, self.pairs.index(pair), False, 0
        row["A"], row["B"], row["sigma"], row["kappa"] = raw.A[0], raw.B[0], raw.sigma.item(), raw.kappa.item()
        row["stamp_ns"] = 0 if raw.stamps_ns is None else raw.stamps_ns[0]
        if raw.covariances is not None:
            row["covariance"] = raw.covariances[0]
        self._size, self.number = self._size + 1, self.number + 1
        return self._size - 1

    def _check(self, pair: Pair, stated: frozenset[str]) -> None:
        for name, kind in zip(pair, SIDES, strict=True):
            if self._kind.get(name, kind) != kind and not pair.is_motion:
                raise FrameError(f"{pair}: {name!r} is a {self._kind[name]} already; names are unique across both")
        if self._stated is not None and stated != self._stated:
            first, now = (", ".join(sorted(names)) or "none" for names in (self._stated, stated))
            raise (StampError if stated ^ self._stated == {"stamps_ns"} else NoiseError)(
                f"this measurement of {pair} states {now} of {', '.join(STATED)}; the first one stated {first}. Give "
                "the same for every measurement of a stream"
            )

    def let_count(self, places: np.ndarray, *, counts: bool) -> None:
        """Let some rows count, or count no more; the sums follow."""
        changed = places[self.rows["counts"][places] != counts]
        self.rows["counts"][changed] = counts
        if counts and len(changed) == 1:
            e = int(self.rows["pair"][changed[0]])
            self._sums.add_to(np.array([e]), self._summed(self.pairs[e], self.measurements(changed)))
        else:
            self._sum_again(np.unique(self.rows["pair"][changed]))

    def choose_gauge(self) -> bool:
        """Choose the reference points of the sums anew where it is time to, and sum everything again."""
        size = self._size
        if not size or not self.is_whole or GAUGE_AGAIN ** round(np.log(size) / np.log(GAUGE_AGAIN)) != size:
            return False
        counting = self.rows[self.rows["counts"]]
        if len(counting):
            some = counting[:: -(-len(counting) // BLOCK)]
            motion = np.array([pair.is_motion for pair in self.pairs])[some["pair"]]
            self._gauge = Gauge.of(some["A"], motion)
            self._sum_again(np.arange(len(self.pairs)))
        return True

    def forget(self, place: int) -> None:
        """Take a row out as if it had never come."""
        e = int(self.rows["pair"][place])
        self._rows = self._rows.copy()  # what `as_now` gave stays
        self._rows[place : self._size - 1] = self._rows[place + 1 : self._size]
        self._size -= 1
        self._sum_again(np.array([e]))

    def fold(self) -> None:
        """Leave the older half of the rows to the sums alone, where the window is full."""
        if self.window is None or self._size < 2 * self.window:
            return
        old = np.arange(self.window)
        for e in np.unique(self.rows["pair"][old]):
            counting = old[(self.rows["pair"][old] == e) & self.rows["counts"][old]]
            if len(counting):
                self._folded.add_to(np.array([e]), self._summed(self.pairs[e], self.measurements(counting)))
        self._size -= self.window
        self._rows = np.roll(self._rows, -self.window)  # anew: what `as_now` gave stays

    # -- what it holds --------------------------------------------------------------------------------------------

    def place_of(self, number: int) -> int:
        """The row of a measurement by its number; a MeasurementsNotKeptError where there is none."""
        numbers = self.rows["number"] if self._size else np.zeros(0)
        found = np.flatnonzero(numbers == number)
        if not len(found):
            there = f"{numbers[0]} to {numbers[-1]}" if len(numbers) else "none"
            raise MeasurementsNotKeptError(f"measurement {number} is not kept, or was removed; there are {there}")
        return int(found[0])

    @property
    def count(self) -> int:
        """How many measurements count."""
        return int(self._sums.count.sum())

    @property
    def is_whole(self) -> bool:
        """Whether all that counts is kept."""
        return not self._folded.count.any()

    @property
    def is_relative(self) -> bool:
        """Whether the noise is not stated."""
        return not ({"covariances"} <= (self._stated or set()) or {"sigma", "kappa"} <= (self._stated or set()))

    def left_out(self) -> np.ndarray:
        """The records of rows that do not count, without their poses."""
        names = [name for name in self._rows.dtype.names or () if name not in ("A", "B", "covariance")]
        return self.rows[~self.rows["counts"]][names].copy() if self._size else np.empty(0)

    @property
    def has_stamps(self) -> bool:
        """Whether measurements have stamps."""
        return self._stated is not None and "stamps_ns" in self._stated

    def moments(self, factors: VarianceFactors) -> Problem:
        """The moments of all that counts, with weights by variance factors."""
        there = np.flatnonzero(self._sums.count)
        s, root = self._sums.rows(there), np.sqrt(factors.translation)
        weighed = replace(
            s,
            kappa=s.kappa / factors.rotation,
            rotation=s.rotation / factors.rotation,
            front=s.front / factors.translation,
            back=None if s.back is None else s.back / factors.translation,
            magnitude_as_summed=s.magnitude_as_summed / root,
            error_as_summed=s.error_as_summed / root,
        )
        return of_moments(self.knowledge, [self.pairs[e] for e in there], weighed, self._gauge)

    def as_now(self) -> Store:
        """What is kept now, to be read: poses are shared, and what comes later does not change it."""
        now = copy.copy(self)
        now._rows, now.pairs = self.rows, list(self.pairs)
        return now

    def sorted_rows(self, places: np.ndarray | None = None) -> list[tuple[Pair, np.ndarray]]:
        """By pair, in the order of names: the places of its rows by stamp, or by arrival where there are no stamps.

        All of them, or those among some ``places``.
        """
        if not self._size:
            return []
        order = np.lexsort((self.rows["number"], self.rows["stamp_ns"]))
        if places is not None:
            order = order[np.isin(order, places)]
        of_order = self.rows["pair"][order]
        pairs = sorted(enumerate(self.pairs), key=lambda item: [natural_key(name) for name in item[1]])
        by_pair = ((pair, order[of_order == e]) for e, pair in pairs)
        return [(pair, places) for pair, places in by_pair if len(places)]

    def problem(self, places: np.ndarray | None = None) -> Problem:
        """A problem of all rows, also of those that do not count, or of some: the same in whatever order they came."""
        stated = self._stated or frozenset()
        result = copy.deepcopy(self.knowledge)  # which has no measurements
        for pair, own in self.sorted_rows(places):
            raw = self.measurements(own)
            add = partial(result.add_motion, pair.sensor) if pair.is_motion else partial(result.add, *pair)
            add(raw.A, raw.B, **{name: getattr(raw, name) for name in stated})
        return result

    def measurements(self, places: np.ndarray) -> Measurements:
        """Some rows."""
        own = self.rows[places]
        covariances = own["covariance"] if "covariance" in (own.dtype.names or ()) else None
        return Measurements(own["A"], own["B"], own["sigma"], own["kappa"], own["stamp_ns"], covariances)

    # -- sums -----------------------------------------------------------------------------------------------------

    def _summed(self, pair: Pair, raw: Measurements) -> MomentStack:
        return Sorted.of(pair, raw).moments(self._gauge, with_R_B=self._with_R_B)

    def _sum_again(self, pairs: np.ndarray) -> None:
        """Sum some pairs again from what is kept, so that what was taken back leaves no rounding behind."""
        for e in pairs:
            for name in (field.name for field in fields(MomentStack) if field.name not in ("a", "c")):
                if getattr(self._sums, name) is not None:
                    getattr(self._sums, name)[e] = getattr(self._folded, name)[e]
            own = np.flatnonzero((self.rows["pair"] == e) & self.rows["counts"])
            if len(own):
                self._sums.add_to(np.array([e]), self._summed(self.pairs[e], self.measurements(own)))
