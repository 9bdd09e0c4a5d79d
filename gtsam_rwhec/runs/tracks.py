"""Tracks: all measurements of one target by one sensor, in order of time, with the reason if one is not used."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Self

import numpy as np

from gtsam_rwhec.cameras.targets import Bundle, Tag, Target, is_same_print
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.errors import FrameError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import DetectionRecord, Log
from gtsam_rwhec.results.log_history import TrackCount
from gtsam_rwhec.results.removed_measurements import Kept, RemovalReason
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.carrier_motion import check_order
from gtsam_rwhec.runs.run_log import detections_topic, records_of


@dataclass(frozen=True, eq=False)
class Track:
    """All measurements of one target by one sensor."""

    target: str
    sensor: str
    stamps_ns: np.ndarray  #: (N,) integers: the sensor's stamps, increasing
    B: Array  #: (N, 4, 4): T_sensor_target, metres; the identity for a measurement without a pose, which has a reason
    covariance: Array | None  #: (N, 6, 6), of B; None if a measurement has no covariance
    reasons: tuple[str, ...]  #: N reasons why a measurement is not used (`Rejection`, `RemovalReason`); empty if it is

    @property
    def used(self) -> np.ndarray:
        """Which measurements are used, (N,) booleans."""
        return np.array([not reason for reason in self.reasons], dtype=bool)

    @property
    def count(self) -> TrackCount:
        """How many measurements are used, and how many are removed for each reason."""
        removed = Counter(reason for reason in self.reasons if reason)
        return TrackCount(target=self.target, sensor=self.sensor, used=int(self.used.sum()), removed=dict(removed))

    def without(self, reason: str) -> Self:
        """The track with all measurements removed, for this reason if they had none before."""
        return replace(self, reasons=tuple(why or reason for why in self.reasons))

    def marked(self, kept: Kept, at: np.ndarray) -> Self:
        """The track after a step of cleaning on the measurements `at`; a measurement keeps its first reason."""
        reasons = list(self.reasons)
        for item in kept.removed:
            i = int(at[item.index])
            reasons[i] = reasons[i] or item.reason
        return replace(self, reasons=tuple(reasons))


def read_tracks(log: Log, rig: Rig, sensor: str) -> list[Track]:
    """Read the detections of a sensor, one track for each target. Raises `StampError` as `check_order`."""
    of_target: dict[str, list[DetectionRecord]] = defaultdict(list)
    stamps = []
    targets = rig.target_list
    for record in records_of(log, [detections_topic(sensor)], DetectionRecord):
        stamps.append(record.stamp_ns)
        target = target_of(record, targets)
        if target is not None:
            of_target[target.name].append(record)
    # All tags of an image have the same stamp.
    check_order(np.array([stamp for stamp, _ in groupby(stamps)], dtype=np.int64), f"detections of {sensor}")
    return [_track(name, sensor, of_target[name]) for name in sorted(of_target)]


def _track(target: str, sensor: str, records: list[DetectionRecord]) -> Track:
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
    return Track(target, sensor, stamps, B, covariance, tuple(reasons))


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
