"""Moments of all pairs of a problem, about one gauge that the first measurements determine."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from gtsam_rwhec.problem.many_measurements import Sorted
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.moment_stack import MomentStack
from gtsam_rwhec.problem.moments import Gauge, Moments

#: Up to this number of measurements the gauge moves and all moments are summed again, as one measurement does not show
#: the centre of a trajectory. Then the gauge is fixed, and later measurements are summed about it.
OPENING = 64


@dataclass(frozen=True, slots=True)
class Row:
    """The moments of one pair in a stack."""

    many: MomentStack
    index: int


class Accumulator:
    """Moments by pair. An accumulator does not change: adding measurements makes a new accumulator."""

    def __init__(self, gauge: Gauge | None = None, held: dict[Pair, Row] | None = None) -> None:
        self.gauge = gauge or Gauge()
        self._held = held or {}
        self._opening: list[Sorted] | None = [] if gauge is None else None

    def moments(self, pair: Pair) -> Moments:
        """The moments of a pair."""
        return self._held[pair].many.one(self._held[pair].index)

    def count(self, pair: Pair) -> int:
        """The number of measurements of a pair."""
        return int(self._held[pair].many.count[self._held[pair].index])

    @property
    def number_of_measurements(self) -> int:
        """The number of measurements of all pairs."""
        return sum(map(self.count, self._held))

    def stack(self, pairs: Sequence[Pair]) -> MomentStack:
        """The moments of some pairs in their order; a view where they are the pairs of one call, in its order."""
        stacks: list[MomentStack] = []
        for _, group in groupby((self._held[pair] for pair in pairs), lambda row: id(row.many)):
            rows = list(group)
            many, index = rows[0].many, [row.index for row in rows]
            if index == list(range(len(many))):
                stacks.append(many)
                continue
            is_run = index == list(range(index[0], index[0] + len(index)))
            stacks.append(many.rows(slice(index[0], index[-1] + 1) if is_run else np.array(index)))
        return MomentStack.joined(stacks)

    def added(self, batch: Sorted, *, with_R_B: bool) -> tuple[Accumulator, int]:
        """The accumulator with measurements added, and how many of their rotations were projected to SO(3).

        ``with_R_B``: whether sums of B's rotations are kept, as an unknown scale may need. A PoseError names a pose
        that is not valid.
        """
        if self._opening is None:
            gauge = self.gauge
            if not batch.motion.all() and not self._has_targets():
                gauge = replace(gauge, target_carrier=Gauge.target_origin(batch.sample()[0], gauge.sensor_carrier))
            return Accumulator(gauge, self._held)._with(batch, with_R_B=with_R_B)
        opening = [*self._opening, batch]
        samples, motion = zip(*(each.sample() for each in opening), strict=True)
        before = Accumulator.of(opening[:-1], Gauge.of(np.concatenate(samples), np.concatenate(motion)))
        result, projected = before._with(batch, with_R_B=with_R_B)
        if sum(len(each.A) for each in opening) < OPENING:
            # Copied: the caller's arrays may change before the gauge settles.
            result._opening = [*self._opening, batch.copied()]
        return result, projected

    @staticmethod
    def of(batches: Iterable[Sorted], gauge: Gauge) -> Accumulator:
        """The moments of some batches about a gauge, with the sums of B's rotations."""
        result = Accumulator(gauge)
        for batch in batches:
            result, _ = result._with(batch, with_R_B=True)
        return result

    def _with(self, batch: Sorted, *, with_R_B: bool) -> tuple[Accumulator, int]:
        fresh = batch.moments(self.gauge, with_R_B=with_R_B)
        projected = int(fresh.projected.sum())  # of the batch alone
        return Accumulator(self.gauge, self._joined(batch.pairs, fresh)), projected

    def _joined(self, pairs: Sequence[Pair], fresh: MomentStack) -> dict[Pair, Row]:
        """What is held, and the moments of some pairs added to it; ``fresh`` is changed."""
        known = np.flatnonzero([pair in self._held for pair in pairs])
        if len(known):
            fresh.add_to(known, self.stack([pairs[i] for i in known.tolist()]))
        return self._held | {pair: Row(fresh, i) for i, pair in enumerate(pairs)}

    def _has_targets(self) -> bool:
        return any(not pair.is_motion for pair in self._held)

    def merged(self, other: Accumulator) -> Accumulator:
        """Both accumulators' moments, about the gauge of the accumulator whose gauge has settled."""
        settled, rest = (self, other) if self._opening is None or other._opening is not None else (other, self)
        if rest._opening is not None:
            for batch in rest._opening:
                settled, _ = settled.added(batch, with_R_B=True)
            return settled
        gauge = settled.gauge
        if not settled._has_targets():
            gauge = replace(gauge, target_carrier=rest.gauge.target_carrier)
        a, c = (getattr(gauge, of) - getattr(rest.gauge, of) for of in ("sensor_carrier", "target_carrier"))
        pairs = list(rest._held)
        moved = rest.stack(pairs).shifted(a, c if rest._has_targets() else np.zeros(3)).as_summed()
        return Accumulator(gauge, settled._joined(pairs, moved))
