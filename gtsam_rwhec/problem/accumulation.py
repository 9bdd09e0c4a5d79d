"""Moments of all pairs of a problem, about one gauge that the first measurements determine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.many_measurements import Sorted
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.moment_stack import MomentStack
from gtsam_rwhec.problem.moments import BLOCK, Gauge, Moments

#: Up to this number of measurements the gauge moves and all moments are summed again, as one measurement does not show
#: the centre of a trajectory. Then the gauge is fixed, and later measurements are summed about it.
OPENING = 64


@dataclass(frozen=True)
class Batch:
    """Measurements as they were added: A, B (N, 4, 4); weight 1/sigma^2 and kappa, () or (N,); where, for messages."""

    pair: Pair
    A: Array
    B: Array
    weight: Array
    kappa: Array
    where: str

    @property
    def sample(self) -> Array:
        """At most `BLOCK` poses spread over all of A: a log begins at rest, so its first poses are not enough."""
        return self.A[:: -(-len(self.A) // BLOCK)]

    def moments(self, gauge: Gauge) -> Moments:
        """The moments about a gauge, with every pose checked."""
        return Moments.of(self.A, self.B, self.weight, self.kappa, gauge, self.pair.is_motion, self.where)


@dataclass(frozen=True, slots=True)
class Row:
    """The moments of one pair, in a stack that was summed for many pairs at once."""

    many: MomentStack
    index: int


class Accumulator:
    """Moments by pair. An accumulator does not change: adding a batch makes a new accumulator."""

    def __init__(self, gauge: Gauge | None = None, held: dict[Pair, Moments | Row] | None = None) -> None:
        self.gauge = gauge or Gauge()
        self._held: dict[Pair, Moments | Row] = {} if held is None else held
        self._opening: list[Batch] | None = [] if gauge is None else None

    def moments(self, pair: Pair) -> Moments:
        """The moments of a pair."""
        held = self._held[pair]
        return held.many.one(held.index) if isinstance(held, Row) else held

    def count(self, pair: Pair) -> int:
        """The number of measurements of a pair."""
        held = self._held[pair]
        return int(held.many.count[held.index]) if isinstance(held, Row) else held.count

    @property
    def number_of_measurements(self) -> int:
        """The number of measurements of all pairs."""
        return sum(map(self.count, self._held))

    def stack(self, pairs: Sequence[Pair]) -> MomentStack:
        """The moments of some pairs in their order; a view where they are the pairs of one call, in its order."""
        stacks: list[MomentStack] = []
        of_pairs = zip(pairs, (self._held[pair] for pair in pairs), strict=True)
        for many, group in groupby(of_pairs, lambda each: each[1].many if isinstance(each[1], Row) else None):
            if many is None:
                alone = [(held, pair.is_motion) for pair, held in group if isinstance(held, Moments)]
                stacks.append(MomentStack.of(*zip(*alone, strict=True)))
                continue
            rows = np.array([held.index for _, held in group if isinstance(held, Row)])
            is_run = bool((np.diff(rows) == 1).all())
            stacks.append(many.rows(slice(rows[0], rows[-1] + 1) if is_run else rows))
        return MomentStack.joined(stacks)

    def added(self, batch: Batch) -> tuple[Accumulator, int]:
        """The accumulator with a batch added, and how many of the batch's rotations were projected to SO(3).

        A PoseError names a pose that is not valid.
        """
        if self._opening is None:
            gauge = self.gauge
            if not batch.pair.is_motion and not self._has_targets():
                gauge = replace(gauge, target_carrier=Gauge.target_origin(batch.sample, gauge.sensor_carrier))
            fresh = batch.moments(gauge)
            total = self.moments(batch.pair) + fresh if batch.pair in self._held else fresh
            return Accumulator(gauge, {**self._held, batch.pair: total}), fresh.projected
        batches = [*self._opening, batch]
        gauge = Gauge.of(
            np.concatenate([b.sample for b in batches]),
            np.concatenate([np.full(len(b.sample), b.pair.is_motion) for b in batches]),
        )
        held: dict[Pair, Moments | Row] = {}
        result = Accumulator(gauge, held)
        fresh = Moments.none()
        for b in batches:
            fresh = b.moments(gauge)
            held[b.pair] = result.moments(b.pair) + fresh if b.pair in held else fresh
        if sum(len(b.A) for b in batches) < OPENING:
            # Copied: the caller's arrays may change before the gauge settles.
            result._opening = [*self._opening, replace(batch, A=batch.A.copy(), B=batch.B.copy())]
        return result, fresh.projected

    def added_many(self, batch: Sorted, *, with_R_B: bool) -> tuple[Accumulator, int]:
        """The accumulator with the measurements of many pairs, and how many rotations were projected.

        ``with_R_B``: whether sums of B's rotations are kept, as an unknown scale may need.
        """
        before, gauge = self, self.gauge
        still = ~batch.motion
        if self._opening is not None:
            step = -(-len(batch.A) // BLOCK)
            sample, motion = batch.A[::step], np.repeat(batch.motion, batch.counts)[::step]
            if self._opening:
                sample = np.concatenate([*(b.sample for b in self._opening), sample])
                motion = np.concatenate([*(np.full(len(b.sample), b.pair.is_motion) for b in self._opening), motion])
            gauge = Gauge.of(sample, motion)
            before = Accumulator(gauge)
            for b in self._opening:
                before, _ = before.added(b)
        elif still.any() and not self._has_targets():
            of_targets = batch.A[np.repeat(still, batch.counts)]
            sample = of_targets[:: -(-len(of_targets) // BLOCK)]
            gauge = replace(gauge, target_carrier=Gauge.target_origin(sample, gauge.sensor_carrier))
        fresh = batch.moments(gauge, with_R_B=with_R_B)
        projected = int(fresh.projected.sum())
        known = np.flatnonzero([pair in before._held for pair in batch.pairs])
        if len(known):
            fresh.add_to(known, before.stack([batch.pairs[i] for i in known]))
        rows = {pair: Row(fresh, i) for i, pair in enumerate(batch.pairs)}
        return Accumulator(gauge, {**before._held, **rows}), projected

    def _has_targets(self) -> bool:
        return any(not pair.is_motion for pair in self._held)

    def merged(self, other: Accumulator) -> Accumulator:
        """Both accumulators' moments, about the gauge of the accumulator whose gauge has settled."""
        settled, rest = (self, other) if self._opening is None or other._opening is not None else (other, self)
        if rest._opening is not None:
            result = settled
            for batch in rest._opening:
                result, _ = result.added(batch)
            return result
        gauge = settled.gauge
        if not settled._has_targets():
            gauge = replace(gauge, target_carrier=rest.gauge.target_carrier)
        a = gauge.sensor_carrier - rest.gauge.sensor_carrier
        c = gauge.target_carrier - rest.gauge.target_carrier if rest._has_targets() else np.zeros(3)
        held = dict(settled._held)
        for pair in rest._held:
            moved = rest.moments(pair).shifted(a, a if pair.is_motion else c)
            held[pair] = settled.moments(pair) + moved if pair in held else moved
        return Accumulator(gauge, held)
