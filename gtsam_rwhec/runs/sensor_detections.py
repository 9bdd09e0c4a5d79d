"""The detections of one sensor, from its images or from a driver, and the report on the detections of all sensors."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from gtsam_rwhec.logs import DetectionRecord, Log
from gtsam_rwhec.results.log_history import DetectionReport, TrackCount
from gtsam_rwhec.rig import Rig


@dataclass(frozen=True)
class LookedAt:
    """One image that was searched for targets."""

    logged_ns: int  #: its log time, by which it is found again
    fault: str = ""  #: why it could not be used; empty if it could


@dataclass(frozen=True, eq=False)
class SensorDetections:
    """The detections of one sensor."""

    records: list[DetectionRecord]  #: detections of the targets; one that is not used has a reason
    count: int  #: number of images, or of messages of the driver, in the log
    strangers: Counter[tuple[str, str]]  #: how often each tag that belongs to no target was seen, by family and id
    faults: tuple[str, ...] = ()  #: one sentence for each image that could not be used
    #: Measured standard deviation of a corner along each axis, pixels, by target/sensor.
    corner_px: Mapping[str, float] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()  #: what was found out about targets
    images: Mapping[int, LookedAt] = field(default_factory=dict)  #: every image, by stamp; none of a driver's


def detection_report(log: Log, rig: Rig, found: Mapping[str, SensorDetections]) -> DetectionReport:
    """The report on the detections of all sensors."""
    strangers = sum((of_sensor.strangers for of_sensor in found.values()), Counter[tuple[str, str]]())
    seen = {record.id for of_sensor in found.values() for record in of_sensor.records}
    return DetectionReport(
        sources=tuple(file.path.name for file in log.files),
        images={sensor: of_sensor.count for sensor, of_sensor in found.items()},
        undecoded={sensor: of_sensor.faults for sensor, of_sensor in found.items() if of_sensor.faults},
        tracks=tuple(count for sensor, of_sensor in found.items() for count in _counts(sensor, of_sensor.records)),
        strangers={f"{family} {number}": count for (family, number), count in sorted(strangers.items())},
        unseen=tuple(name for name in rig.targets if name not in seen),
        remarks=tuple(dict.fromkeys(remark for of_sensor in found.values() for remark in of_sensor.remarks)),
        corner_px={key: value for of_sensor in found.values() for key, value in of_sensor.corner_px.items()},
    )


def _counts(sensor: str, records: list[DetectionRecord]) -> Iterator[TrackCount]:
    reasons: dict[str, Counter[str]] = defaultdict(Counter)
    for record in records:
        reasons[record.id][record.reason] += 1
    for target, removed in sorted(reasons.items()):
        yield TrackCount(target=target, sensor=sensor, used=removed.pop("", 0), removed=dict(removed))
