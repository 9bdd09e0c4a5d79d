"""The problem as the user states it: measurements by pair, and the knowledge of frames and scales."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence

import numpy as np

from gtsam_rwhec.errors import CountError, FrameError, MeasurementsNotKeptError, OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.accumulation import Accumulator
from gtsam_rwhec.problem.additions import Additions
from gtsam_rwhec.problem.directions import axes_told, unseen_by
from gtsam_rwhec.problem.knowledge import check_name
from gtsam_rwhec.problem.many_measurements import KeptMeasurements, Section, Sorted
from gtsam_rwhec.problem.measurements import Kind, Measurements, Pair
from gtsam_rwhec.problem.moment_stack import MomentStack
from gtsam_rwhec.problem.moments import Gauge, Moments


def check_measurements(measurements: object) -> None:
    """Raise an OptionError for anything but raw measurements by pair."""
    if not isinstance(measurements, Mapping):
        raise OptionError(f"measurements is a {type(measurements).__name__}; give {{pair: Measurements}}")
    for pair, raw in measurements.items():
        if not isinstance(pair, Pair) or not isinstance(raw, Measurements):
            raise OptionError(
                f"measurements has a {type(raw).__name__} for {brief(pair)}; give "
                "{Pair(target, sensor): Measurements}"
            )


class Problem(Additions):
    """A calibration problem: A_i X_j = Y_k B_i for targets j, sensors k and measurements i.

    A = T_sensorcarrier_targetcarrier (known: kinematics, motion capture, SLAM), B = T_sensor_target (measured),
    X = T_targetcarrier_target and Y = T_sensorcarrier_sensor (unknown). Translations are in metres.

    Parameters
    ----------
    scale : "known", "shared" or "per_target"
        Lengths in B are true, or true times one unknown factor, or true times one unknown factor per target (t_B =
        scale * true length). With "per_target", ``fix_scale`` names targets of known size.
    sensor_carrier, target_carrier : str, optional
        Your names for the two things that carry the sensors and the targets, such as "hand" and "base": reports and
        ``Calibration.uncertainty_at`` use them.
    keep_measurements : bool
        Whether raw measurements are kept beside the moments. Refinement with covariances, time offsets or outliers
        needs them; the certified solution does not. Without them memory does not grow with their number.
    """

    def with_measurements(self, measurements: Mapping[Pair, Measurements]) -> Problem:
        """A problem with the same knowledge and other measurements of the same frames.

        The moments are summed again, about the same gauge. A frame without a measurement is not in the new problem,
        and neither are its fixed pose, priors and fixed scale.

        Raises
        ------
        CountError
            There are no measurements.
        """
        check_measurements(measurements)
        if not measurements:
            raise CountError(f"nothing is left of {self}: keep at least one measurement")
        own = {pair: Sorted.of(pair, raw) for pair, raw in measurements.items()}
        lost_frames = self._kind.keys() - {name for pair in measurements for name in pair}
        # A scale belongs to the first name of a pair: the target, or the sensor of motions.
        lost_scales = {pair.target for pair in self.pairs} - {pair.target for pair in measurements}
        result = copy.copy(self)
        result._kind = {name: kind for name, kind in self._kind.items() if name not in lost_frames}
        result._kept = {
            pair: KeptMeasurements((Section(many, 0),), many.covariances is not None) for pair, many in own.items()
        }
        result._accumulator = Accumulator.of(Sorted.for_moments(measurements), self.gauge)
        result._take_knowledge(self, frames=lost_frames, scales=lost_scales)
        return result

    # -- what it holds -------------------------------------------------------------------------------------------

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
    def directed(self) -> frozenset[Pair]:
        """The pairs with measurements that weigh by direction; all of such a pair's measurements do."""
        return frozenset(pair for pair, kept in self._kept.items() if kept.has_kinds)

    @property
    def alike_of_sensors(self) -> dict[str, Array]:
        """By sensor what all of its views are off by alike, where all of its targets have such: that of the best."""
        seen = {name: [pair for pair in self.pairs if pair.sensor == name] for name in self.sensors}
        of_clouds = {name: pairs for name, pairs in seen.items() if pairs and self.alike.keys() >= {*pairs}}
        return {name: min((self.alike[p] for p in pairs), key=np.linalg.norm) for name, pairs in of_clouds.items()}

    @property
    def is_of_registrations(self) -> bool:
        """Whether every measurement is a pose with directions, as clouds give it: its noise is known, A's is not."""
        batches = [batch for kept in self._kept.values() for batch in kept.batches]
        return bool(batches) and all(batch.is_of(Kind.DIRECTIONAL).all() for batch in batches)

    @property
    def number_of_equations(self) -> int:
        """Six for each measurement, and for those that weigh by direction as many as they tell."""
        of_directed = sum(int(axes_told(batch).sum()) for pair in self.directed for batch in self._kept[pair].batches)
        others = self.number_of_measurements - sum(self._kept[pair].count for pair in self.directed)
        return 6 * others + of_directed

    def unseen(self, name: str) -> np.ndarray:
        """(6,): which directions [omega, v] of a frame's own axes mean nothing: nothing that was stated sees them."""
        kept = [kept for pair, kept in self._kept.items() if name in pair]
        of_target = name not in self.fixed and self._kind.get(name) == "target"
        if not of_target or not all(each.has_kinds for each in kept):
            return np.zeros(6, dtype=bool)
        unseen: np.ndarray = np.all([unseen_by(batch) for each in kept for batch in each.batches], axis=0)
        for prior in self.priors.get(name, []):
            unseen &= ~np.repeat([prior.kappa is not None, prior.sigma is not None], 3)
        return unseen

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
                f"{what} needs the raw measurements, and they were not kept: make the problem with "
                "keep_measurements=True"
            )

    @property
    def gauge(self) -> Gauge:
        """The reference points that the moments are summed about."""
        return self._accumulator.gauge

    def moments(self, target: str, sensor: str) -> Moments:
        """Moments of a pair, about ``gauge``."""
        return self._accumulator.moments(self._pair(target, sensor))

    def moment_stack(self, pairs: Sequence[Pair]) -> MomentStack:
        """Moments of some pairs in their order, about ``gauge``, without a copy of large arrays."""
        return self._accumulator.stack(pairs)

    def measurements(self, target: str, sensor: str) -> Measurements:
        """Raw measurements of a pair, in the order in which they were added.

        Raises
        ------
        MeasurementsNotKeptError
            The problem was made with ``keep_measurements=False``.
        """
        pair = self._pair(target, sensor)
        if self._kept[pair].count != self._accumulator.count(pair):
            raise MeasurementsNotKeptError(
                f"the raw measurements of {pair} were not kept: make the problem with keep_measurements=True"
            )
        return self._kept[pair].joined()

    def batches(self, target: str, sensor: str) -> tuple[Measurements, ...]:
        """Raw measurements of a pair as they were added, batch by batch, without a copy; only what was kept."""
        return self._kept[self._pair(target, sensor)].batches

    def stored(self, pair: Pair) -> tuple[Section, ...]:
        """What was kept of a pair, batch by batch, as it is stored."""
        return self._kept[pair].stored

    def _pair(self, target: str, sensor: str) -> Pair:
        check_name(target, "the target's name")
        check_name(sensor, "the sensor's name")
        pair = Pair(target, sensor)
        if pair not in self._kept:
            raise FrameError(f"no measurements of {pair}; there are {', '.join(map(str, self.pairs))}")
        return pair

    # -- joining ------------------------------------------------------------------------------------------------

    def __add__(self, other: Problem) -> Problem:
        """One problem with the measurements and knowledge of both: logs can be processed separately and joined."""
        if not isinstance(other, Problem):
            return NotImplemented
        if self.scale != other.scale:
            raise OptionError(f"a problem with scale={self.scale!r} cannot join one with scale={other.scale!r}")
        merged = copy.copy(self)
        merged.keep_measurements &= other.keep_measurements
        merged.is_relative |= other.is_relative
        merged.sensor_carrier = self.sensor_carrier or other.sensor_carrier
        merged.target_carrier = self.target_carrier or other.target_carrier
        merged._take_knowledge(self)
        merged._kind = dict(self._kind)
        merged._kept = dict(self._kept)
        for name, kind in other._kind.items():
            if merged._kind.setdefault(name, kind) != kind:
                raise FrameError(
                    f"{name!r} is a {kind} in one problem and a {merged._kind[name]} in the other; rename one of them"
                )
        merged._accumulator = self._accumulator.merged(other._accumulator)
        for pair, kept in other._kept.items():
            merged._kept[pair] = merged._kept.get(pair, KeptMeasurements()) + kept
        merged._learn(other)
        return merged

    def __radd__(self, other: object) -> Problem:
        """0 + problem, so that ``sum(problems)`` joins them."""
        return self if other == 0 else NotImplemented

    def __repr__(self) -> str:
        return (
            f"Problem({len(self.targets)} targets, {len(self.sensors)} sensors, {len(self._kept)} pairs, "
            f"{self.number_of_measurements} measurements, scale={self.scale!r})"
        )
