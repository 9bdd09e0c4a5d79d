"""Moments of all pairs of a problem, about one gauge that the first measurements determine."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.moments import BLOCK, Gauge, Moments
from gtsam_rwhec.problem.pairs import Pair

#: Up to this number of measurements the gauge moves and all moments are summed again, as one measurement does not tell
#: the centre of a trajectory. Later measurements are summed about the gauge as it then is.
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
        """At most `BLOCK` poses from all over A: a log begins at rest, and its first poses tell no centre."""
        return self.A[:: -(-len(self.A) // BLOCK)]

    def moments(self, gauge: Gauge) -> Moments:
        """The moments about a gauge, with every pose checked."""
        return Moments.of(self.A, self.B, self.weight, self.kappa, gauge, self.pair.is_motion, self.where)


class Accumulator:
    """Moments by pair. An accumulator does not change: adding a batch makes a new accumulator."""

    def __init__(self, gauge: Gauge | None = None, moments: dict[Pair, Moments] | None = None) -> None:
        self.gauge = gauge or Gauge()
        self.moments = moments or {}
        self._opening: list[Batch] | None = [] if gauge is None else None

    def added(self, batch: Batch) -> tuple[Accumulator, int]:
        """The accumulator with a batch added, and how many of the batch's rotations were projected to SO(3).

        A PoseError names a pose that is not valid.
        """
        if self._opening is None:
            gauge = self.gauge
            if not batch.pair.is_motion and not self._has_targets():
                gauge = replace(gauge, target_carrier=Gauge.target_origin(batch.sample, gauge.sensor_carrier))
            fresh = batch.moments(gauge)
            known = self.moments.get(batch.pair)
            return Accumulator(gauge, {**self.moments, batch.pair: known + fresh if known else fresh}), fresh.projected
        batches = [*self._opening, batch]
        gauge = Gauge.of(
            np.concatenate([b.sample for b in batches]),
            np.concatenate([np.full(len(b.sample), b.pair.is_motion) for b in batches]),
        )
        moments: dict[Pair, Moments] = {}
        fresh = Moments.none()
        for b in batches:
            fresh = b.moments(gauge)
            moments[b.pair] = moments[b.pair] + fresh if b.pair in moments else fresh
        result = Accumulator(gauge, moments)
        if sum(len(b.A) for b in batches) < OPENING:
            # Copied: the caller's arrays may change before the gauge settles.
            result._opening = [*self._opening, replace(batch, A=batch.A.copy(), B=batch.B.copy())]
        return result, fresh.projected

    def _has_targets(self) -> bool:
        return any(not pair.is_motion for pair in self.moments)

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
        moments = dict(settled.moments)
        for pair, edge in rest.moments.items():
            moved = edge.shifted(a, a if pair.is_motion else c)
            moments[pair] = moments[pair] + moved if pair in moments else moved
        return Accumulator(gauge, moments)
