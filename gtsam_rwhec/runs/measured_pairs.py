"""Measured pairs (A, B): made of detections, written into a cleaned log, read back, and stated as a problem."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np

from gtsam_rwhec.cameras.targets import Bundle, Tag, Target, is_same_print
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.errors import FrameError, NoiseError
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.logs import DetectionRecord, Log, LogWriter, PairRecord
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.results.linear_model import MeasuredRows
from gtsam_rwhec.results.log_history import Kept, RemovalReason, TrackCount
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.carrier_motion import check_order
from gtsam_rwhec.runs.run_log import detections_topic, pairs_topic, records_of

#: Noise of a target's poses where nothing is known yet: 5 mm and half a degree. It is estimated from there.
BEFORE_ESTIMATE = {"sigma": 0.005, "kappa": 1.0 / (2.0 * np.radians(0.5) ** 2)}


@dataclass(frozen=True, eq=False)
class MeasuredPairs(MeasuredRows):
    """All measurements of one target by one sensor, in order of time, with the reason if one is not used.

    A is nan before synchronisation, and B the identity for a measurement without a pose. For a sensor with odometry, A
    and B are motions over windows that end at the stamps; `target` is the sensor's name.
    """

    stamps_ns: np.ndarray  #: (N,) integers: the sensor's stamps
    target: str
    sensor: str

    @property
    def count(self) -> TrackCount:
        """How many measurements are used, and how many are removed for each reason."""
        removed = Counter(self.reasons)
        return TrackCount(target=self.target, sensor=self.sensor, used=removed.pop("", 0), removed=dict(removed))

    def without(self, reason: str) -> MeasuredPairs:
        """All measurements removed, for this reason if they had none before."""
        return replace(self, reasons=tuple(why or reason for why in self.reasons))

    def marked(self, kept: Kept, at: np.ndarray) -> MeasuredPairs:
        """After a step of cleaning on the measurements `at`; a measurement keeps its first reason."""
        reasons = list(self.reasons)
        for item in kept.removed:
            i = int(at[item.index])
            reasons[i] = reasons[i] or item.reason
        return replace(self, reasons=tuple(reasons))

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


def detected_pairs(log: Log, rig: Rig, sensor: str) -> list[MeasuredPairs]:
    """The detections of a sensor, by target, not synchronised yet. Raises `StampError` as `check_order`."""
    of_target: dict[str, list[DetectionRecord]] = defaultdict(list)
    stamps = []
    targets = rig.target_list
    for record in records_of(log, [detections_topic(sensor)], DetectionRecord):
        stamps.append(record.stamp_ns)
        target = target_of(record, targets)
        if target is not None or record.id == rig.object:
            of_target[record.id if target is None else target.name].append(record)
    # All tags of an image have the same stamp.
    check_order(np.array([stamp for stamp, _ in groupby(stamps)], dtype=np.int64), f"detections of {sensor}")
    return [_of_detections(name, sensor, of_target[name]) for name in sorted(of_target)]


def _of_detections(target: str, sensor: str, records: list[DetectionRecord]) -> MeasuredPairs:
    records = sorted(records, key=lambda record: record.stamp_ns)
    stamps = np.array([record.stamp_ns for record in records], dtype=np.int64)
    poses = [record.T_camera_tag for record in records]
    reasons = [r.reason or (Rejection.NO_POSE if r.T_camera_tag is None else "") for r in records]
    usable = Counter(stamp for stamp, reason in zip(stamps.tolist(), reasons, strict=True) if not reason)
    # If a message has two measurements of one target, at least one of them is wrong.
    reasons = [
        RemovalReason.SEEN_TWICE if not why and usable[s] > 1 else why
        for s, why in zip(stamps.tolist(), reasons, strict=True)
    ]
    known = [r.covariance for r, why in zip(records, reasons, strict=True) if not why]
    covariance = None
    if known and all(c is not None for c in known):
        covariance = np.array([np.eye(6) if r.covariance is None else r.covariance for r in records])
    B = np.array([np.eye(4) if pose is None else pose for pose in poses])
    return MeasuredPairs(np.full(B.shape, np.nan), B, stamps, covariance, tuple(reasons), target, sensor)


def target_of(record: DetectionRecord, targets: Iterable[Target]) -> Target | None:
    """The target of a detection, found by its name (which this library writes), by family and id, or a bundle's ids.

    Raises `FrameError` if the driver does not say the family, and two targets have the id.
    """
    targets = list(targets)
    mine = [t for t in targets if t.name == record.id] or [
        t
        for t in targets
        if isinstance(t, Tag)
        and record.id == str(t.id)
        and (not record.family or is_same_print(record.family, t.family))
    ]
    if "," in record.id:  # a bundle of apriltag_ros, whose pose is of the layout's frame
        ids = record.id.split(",")
        mine = mine or [t for t in targets if isinstance(t, Bundle) and sorted(map(str, t.ids)) == sorted(ids)]
    if len(mine) > 1:
        raise FrameError(
            f"topic {record.topic}: a tag with id {record.id} and no family could be "
            f"{' or '.join(t.name for t in mine)}; have the driver say the family, or leave one "
            "of these targets out of the rig file"
        )
    return mine[0] if mine else None


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
    stated: dict[str, Any] = {}
    if noise != "estimate" and noise.rotation_deg is not None and noise.translation_mm is not None:
        stated = {"sigma": 1e-3 * noise.translation_mm, "kappa": 1.0 / (2.0 * np.radians(noise.rotation_deg) ** 2)}
    has_covariances = all(measured.covariance is not None for measured in pairs.values())
    if (rig.odometries or rig.object) and not has_covariances and noise == "estimate":
        stated = BEFORE_ESTIMATE  # motions and clouds have weights, beside which measurements without any are lost
    for pair, measured in pairs.items():
        used = measured.used
        if not used.any():
            continue
        A, B = measured.A[used], measured.B[used]
        covariances = None if measured.covariance is None else measured.covariance[used]
        stamps_ns = measured.stamps_ns[used] + round(1e9 * offsets_s.get(pair.sensor, 0.0))
        given: dict[str, Any] = {"stamps_ns": stamps_ns, "source": "the cleaned log"}
        if pair.is_motion:
            problem.add_motion(pair.sensor, A, B, covariances=covariances, **given)
            continue
        weights, is_of_clouds = stated, pair.target == rig.object
        if is_of_clouds or (not stated and has_covariances):  # clouds slide on each other, whatever the rig file states
            weights = {"covariances": covariances}
        elif not stated and noise != "estimate":
            raise NoiseError(
                f"{pair}: noise: {{corner_px: ...}} needs corners, and the detections of {pair.sensor} are poses "
                "without a covariance; give rotation_deg and translation_mm, or estimate"
            )
        try:
            problem.add(pair.target, pair.sensor, A, B, directional=is_of_clouds, **given, **weights)
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
