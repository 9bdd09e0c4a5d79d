"""Moments of all pairs of a problem, about one gauge that the first measurements choose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.poses import Array
from gtsam_rwhec.statistics import BLOCK, Gauge, Moments

Pair = tuple[str, str]

#: The gauge may move, and everything be summed anew, until this many measurements are there: a single one says nothing
#: of where a trajectory is centred. Later ones are summed about the gauge as it then is.
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
    def is_motion(self) -> bool:
        """Whether both ends are one sensor (AX = XB)."""
        return self.pair[0] == self.pair[1]

    def moments(self, gauge: Gauge) -> Moments:
        """Checked and summed about a gauge."""
        return Moments.of(self.A, self.B, self.weight, self.kappa, gauge, self.is_motion, self.where)


class Accumulator:
    """Moments by pair. Adding a batch either succeeds or changes nothing."""

    def __init__(self) -> None:
        self.gauge = Gauge()
        self.moments: dict[Pair, Moments] = {}
        self._opening: list[Batch] | None = []

    def add(self, batch: Batch) -> int:
        """Add a batch; the number of its rotations that had to be projected to SO(3).

        Raises
        ------
        PoseError
            For a pose that is none.
        """
        if self._opening is None:
            gauge = self.gauge
            if not batch.is_motion and not self._has_targets():
                gauge = replace(gauge, target_carrier=Gauge.target_origin(batch.A[:BLOCK], gauge.sensor_carrier))
            fresh = batch.moments(gauge)
            self.gauge = gauge
            self.moments[batch.pair] = self.moments[batch.pair] + fresh if batch.pair in self.moments else fresh
            return fresh.projected
        batches = [*self._opening, batch]
        gauge = Gauge.of(
            np.concatenate([b.A[:BLOCK] for b in batches]),
            np.concatenate([np.full(len(b.A[:BLOCK]), b.is_motion) for b in batches]),
        )
        moments: dict[Pair, Moments] = {}
        fresh = Moments.none()
        for b in batches:
            fresh = b.moments(gauge)
            moments[b.pair] = moments[b.pair] + fresh if b.pair in moments else fresh
        self.gauge, self.moments = gauge, moments
        if sum(len(b.A) for b in batches) >= OPENING:
            self._opening = None
        else:  # kept for a while: the caller's arrays may change meanwhile
            self._opening.append(replace(batch, A=batch.A.copy(), B=batch.B.copy()))
        return fresh.projected

    def _has_targets(self) -> bool:
        return any(target != sensor for target, sensor in self.moments)

    def copy(self) -> Accumulator:
        """An independent one; moments themselves never change."""
        other = Accumulator()
        other.gauge, other.moments = self.gauge, dict(self.moments)
        other._opening = None if self._opening is None else list(self._opening)
        return other

    def merged(self, other: Accumulator) -> Accumulator:
        """Both together, about the gauge of the one that has settled."""
        settled, rest = (self, other) if self._opening is None or other._opening is not None else (other, self)
        result = settled.copy()
        if rest._opening is not None:
            for batch in rest._opening:
                result.add(batch)
            return result
        if not result._has_targets():
            result.gauge = replace(result.gauge, target_carrier=rest.gauge.target_carrier)
        a = result.gauge.sensor_carrier - rest.gauge.sensor_carrier
        c = result.gauge.target_carrier - rest.gauge.target_carrier
        if not rest._has_targets():
            c = np.zeros(3)
        for pair, moments in rest.moments.items():
            moved = moments.shifted(a, a if pair[0] == pair[1] else c)
            result.moments[pair] = result.moments[pair] + moved if pair in result.moments else moved
        return result
