"""What a problem holds: the frames, the pairs, raw measurements of each and their moments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from gtsam_rwhec.errors import CountError, FrameError, MeasurementsNotKeptError
from gtsam_rwhec.problem.accumulation import Accumulator
from gtsam_rwhec.problem.knowledge import Knowledge, ScaleMode, check_name
from gtsam_rwhec.problem.measurements import KeptMeasurements, Measurements, Section
from gtsam_rwhec.problem.moment_stack import MomentStack
from gtsam_rwhec.problem.moments import Gauge, Moments
from gtsam_rwhec.problem.pairs import Pair


class Contents(Knowledge):
    """What was added to a problem, to be read. ``is_relative``: the noise of some measurements is not stated."""

    def __init__(self, scale: ScaleMode, keep_measurements: bool) -> None:
        super().__init__(scale)
        self.keep_measurements = keep_measurements
        self.is_relative = False
        self._kind: dict[str, Literal["target", "sensor"]] = {}
        self._kept: dict[Pair, KeptMeasurements] = {}
        self._accumulator = Accumulator()

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the targets, in order of first appearance."""
        return tuple(name for name, kind in self._kind.items() if kind == "target")

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors, in order of first appearance."""
        return tuple(name for name, kind in self._kind.items() if kind == "sensor")

    @property
    def pairs(self) -> tuple[Pair, ...]:
        """The pairs that have measurements, in order of first appearance."""
        return tuple(self._kept)

    @property
    def number_of_measurements(self) -> int:
        """The number of measurements of all pairs."""
        return self._accumulator.number_of_measurements

    @property
    def has_covariances(self) -> bool:
        """Whether any measurement has a full covariance (refinement alone uses it)."""
        return any(kept.has_covariances for kept in self._kept.values())

    @property
    def has_measurements(self) -> bool:
        """Whether every raw measurement was kept."""
        return all(kept.count == self._accumulator.count(pair) for pair, kept in self._kept.items())

    def require_pairs(self) -> None:
        """Raise a CountError where the problem has no measurements."""
        if not self._kept:
            raise CountError("the problem is empty; add measurements with problem.add(target, sensor, A, B, ...)")

    def require_raw_measurements(self, what: str) -> None:
        """Raise a MeasurementsNotKeptError where raw measurements, which ``what`` needs, were not kept."""
        if not self.has_measurements:
            raise MeasurementsNotKeptError(
                f"{what} needs the raw measurements, and they were not kept (keep_measurements=False); make the "
                "problem with keep_measurements=True"
            )

    @property
    def gauge(self) -> Gauge:
        """The reference points that the moments are summed about."""
        return self._accumulator.gauge

    def moments(self, target: str, sensor: str) -> Moments:
        """Moments of a pair, about ``gauge``."""
        return self._accumulator.moments(self._pair(target, sensor))

    def moment_stack(self, pairs: Sequence[Pair]) -> MomentStack:
        """Moments of some pairs in their order, about ``gauge``, without a copy of what is long."""
        return self._accumulator.stack(pairs)

    def measurements(self, target: str, sensor: str) -> Measurements:
        """Raw measurements of a pair, in the order in which they were added.

        Raises
        ------
        MeasurementsNotKeptError
            The problem was made with ``keep_measurements=False``.
        """
        pair = self._pair(target, sensor)
        kept = self._kept[pair]
        if kept.count != self._accumulator.count(pair):
            raise MeasurementsNotKeptError(
                f"the raw measurements of {pair} were not kept (keep_measurements=False); "
                "make the problem with keep_measurements=True"
            )
        return kept.joined()

    def batches(self, target: str, sensor: str) -> tuple[Measurements, ...]:
        """Raw measurements of a pair as they were added, batch by batch, without a copy; only what was kept."""
        return self._kept[self._pair(target, sensor)].batches

    def stored(self, pair: Pair) -> tuple[Measurements | Section, ...]:
        """What was kept of a pair, batch by batch, as it is stored."""
        return self._kept[pair].stored

    def _pair(self, target: str, sensor: str) -> Pair:
        check_name(target, "the target's name")
        check_name(sensor, "the sensor's name")
        pair = Pair(target, sensor)
        if pair not in self._kept:
            raise FrameError(f"no measurements of {pair}; there are {', '.join(map(str, self.pairs))}")
        return pair
