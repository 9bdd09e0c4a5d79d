"""Measured pairs (A, B): written into a cleaned log, read back as arrays, and stated as a problem."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.errors import NoiseError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.logs import Log, LogWriter, PairRecord
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.run_log import pairs_topic, records_of
from gtsam_rwhec.runs.tracks import Track

#: Noise of a target's poses where nothing is known yet: 5 mm and half a degree. It is estimated from there.
BEFORE_ESTIMATE = {"sigma": 0.005, "kappa": 1.0 / (2.0 * np.radians(0.5) ** 2)}


@dataclass(frozen=True, eq=False)
class MeasuredPairs(Track):
    """A track with the carriers' pose at each stamp: A (N, 4, 4), T_sensorcarrier_targetcarrier, metres.

    For a sensor with odometry, A and B are motions over windows that end at the stamps; `target` is the sensor's name.
    """

    A: Array

    def at(self, path: Trajectory, offset_s: float) -> MeasuredPairs:
        """The pairs with A at another time offset: the sensor's stamp t is the carriers' t + offset."""
        A, _ = path.at(self.stamps_ns + round(1e9 * offset_s))
        return replace(self, A=A)


#: Measured pairs by (target, sensor).
Pairs = dict[Pair, MeasuredPairs]


def without_marks(pairs: Mapping[Pair, MeasuredPairs], reasons: Collection[str]) -> Pairs:
    """The pairs, in which measurements that were removed for these reasons count as used again."""
    return {
        pair: replace(measured, reasons=tuple("" if why in reasons else why for why in measured.reasons))
        for pair, measured in pairs.items()
    }


def at_offsets(
    pairs: Mapping[Pair, MeasuredPairs], path: Trajectory, offsets_s: Mapping[str, float], sensors: Collection[str]
) -> Pairs:
    """The pairs with A taken from a path at the time offsets of some sensors; pairs of other sensors do not change."""
    return {
        pair: measured.at(path, offsets_s[pair.sensor]) if pair.sensor in sensors else measured
        for pair, measured in pairs.items()
    }


def pair_records(pairs: Iterable[MeasuredPairs]) -> list[PairRecord]:
    """Every measurement that has a pose, in order of time."""
    records = [
        PairRecord(
            logged_ns=stamp,
            stamp_ns=stamp,
            topic=pairs_topic(measured.sensor),
            target=measured.target,
            sensor=measured.sensor,
            A=measured.A[i],
            B=measured.B[i],
            is_inlier=not reason,
            reason=reason,
            covariance=None if measured.covariance is None else measured.covariance[i],
        )
        for measured in pairs
        for i, (stamp, reason) in enumerate(zip(measured.stamps_ns.tolist(), measured.reasons, strict=True))
        if reason != Rejection.NO_POSE
    ]
    return sorted(records, key=lambda record: record.stamp_ns)


def write_pairs(out: LogWriter, pairs: Iterable[MeasuredPairs]) -> None:
    """Write every measurement that has a pose, in order of time."""
    for record in pair_records(pairs):
        out.pair(record)


def read_pairs(log: Log, rig: Rig) -> dict[Pair, MeasuredPairs]:
    """Read the pairs of the rig file's sensors and targets from a cleaned log, in order of time."""
    found: dict[Pair, list[PairRecord]] = defaultdict(list)
    for record in records_of(log, map(pairs_topic, rig.all_sensors), PairRecord):
        of_motion = record.target == record.sensor and record.sensor in rig.odometries
        if of_motion or (record.target in rig.targets and record.sensor in rig.sensors):
            found[Pair(record.target, record.sensor)].append(record)
    return {pair: _stacked(pair, sorted(found[pair], key=lambda r: r.stamp_ns)) for pair in sorted(found)}


def _stacked(pair: Pair, records: list[PairRecord]) -> MeasuredPairs:
    covariances = [record.covariance for record in records]
    return MeasuredPairs(
        target=pair.target,
        sensor=pair.sensor,
        stamps_ns=np.array([record.stamp_ns for record in records], dtype=np.int64),
        A=np.array([record.A for record in records]),
        B=np.array([record.B for record in records]),
        covariance=None if any(c is None for c in covariances) else np.array(covariances),
        reasons=tuple(record.reason for record in records),
    )


def poses_used(pairs: Iterable[MeasuredPairs]) -> dict[str, int]:
    """The number of carrier poses (different stamps) at which each sensor and each target is used."""
    stamps: dict[str, set[int]] = defaultdict(set)
    for measured in pairs:
        used = measured.stamps_ns[measured.used].tolist()
        stamps[measured.sensor].update(used)
        stamps[measured.target].update(used)
    return {name: len(found) for name, found in stamps.items()}


def problem_of(
    pairs: Mapping[Pair, MeasuredPairs], rig: Rig, offsets_s: Mapping[str, float], free_sizes: Collection[str] = ()
) -> Problem:
    """The problem that the used pairs state, with stamps on the carriers' clock.

    `rig` states the noise. `offsets_s` has the time offset of each sensor at which A was taken, seconds. The sizes of
    the targets in `free_sizes` are estimated. Raises `NoiseError` if the rig file says ``noise: {corner_px: ...}`` and
    a measurement has no covariance, or a covariance is not positive definite.
    """
    free = {*free_sizes, *(name for name, one in rig.odometries.items() if one.odometry.scale == "estimate")}
    problem = Problem("per_target" if free else "known")
    noise = rig.noise
    stated: dict[str, object] = {}
    if noise != "estimate" and noise.rotation_deg is not None and noise.translation_mm is not None:
        stated = {"sigma": 1e-3 * noise.translation_mm, "kappa": 1.0 / (2.0 * np.radians(noise.rotation_deg) ** 2)}
    has_covariances = all(measured.covariance is not None for measured in pairs.values())
    if rig.odometries and not has_covariances and noise == "estimate":
        stated = BEFORE_ESTIMATE  # motions have weights, beside which measurements without any are lost
    for pair, measured in pairs.items():
        used = measured.used
        if not used.any():
            continue
        if pair.is_motion:
            problem.add_motion(
                pair.sensor,
                measured.A[used],
                measured.B[used],
                stamps_ns=measured.stamps_ns[used] + round(1e9 * offsets_s.get(pair.sensor, 0.0)),
                covariances=measured.covariance[used] if measured.covariance is not None else None,
                source="the cleaned log",
            )
            continue
        weights = stated
        if not stated and has_covariances:
            assert measured.covariance is not None
            weights = {"covariances": measured.covariance[used]}
        elif not stated and noise != "estimate":
            raise NoiseError(
                f"{pair}: noise: {{corner_px: ...}} needs corners, and the detections of {pair.sensor} are poses "
                "without a covariance; give rotation_deg and translation_mm, or estimate"
            )
        try:
            problem.add(
                *pair,
                measured.A[used],
                measured.B[used],
                stamps_ns=measured.stamps_ns[used] + round(1e9 * offsets_s.get(pair.sensor, 0.0)),
                source="the cleaned log",
                **weights,  # type: ignore[arg-type]
            )
        except NoiseError as error:
            raise NoiseError(
                f"{error}. The covariances are the log's; to replace them, give noise: {{rotation_deg: ..., "
                "translation_mm: ...}} in the rig file"
            ) from error
    if free:
        for name in dict.fromkeys(pair.target for pair in problem.pairs):
            if name not in free:
                problem.fix_scale(name)
    return problem
