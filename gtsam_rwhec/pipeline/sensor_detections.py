"""The detections of one sensor, from its images or from a driver, and what the report says of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from gtsam_rwhec.logs import DetectionRecord, Log
from gtsam_rwhec.results.log_history import DetectionReport, TrackCount
from gtsam_rwhec.rig import Rig


@dataclass(frozen=True, eq=False)
class SensorDetections:
    """The detections of one sensor.

    Attributes
    ----------
    records : list of DetectionRecord
        Of the targets; those that are not used have a reason.
    count : int
        Images, or messages of the driver, that the log has.
    strangers : Counter
        How often tags that are no target were seen, by family and id.
    faults : tuple of str
        Why an image could not be used, one sentence for each such image.
    corner_px : dict of str to float
        Standard deviation of a corner along each axis, pixels, by target/sensor, as measured.
    """

    records: list[DetectionRecord]
    count: int
    strangers: Counter[tuple[str, str]]
    faults: tuple[str, ...] = ()
    corner_px: Mapping[str, float] = field(default_factory=dict)


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
        corner_px={key: value for of_sensor in found.values() for key, value in of_sensor.corner_px.items()},
    )


def _counts(sensor: str, records: list[DetectionRecord]) -> list[TrackCount]:
    counts = []
    for target in sorted({record.id for record in records}):
        reasons = Counter(record.reason for record in records if record.id == target)
        used = reasons.pop("", 0)
        counts.append(TrackCount(target=target, sensor=sensor, used=used, removed=dict(reasons)))
    return counts
