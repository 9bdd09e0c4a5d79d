"""What a partial result says of its log, beside measurements: where it is from, what was removed, what was found."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.fitting.fit_options import About
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.log_history import (
    CleaningReport,
    DetectionReport,
    LogFields,
    OutlierCount,
    TimeOffsetFields,
    TrackCount,
)

#: How the measurements of a log were weighted: as the rig file states the noise, by covariances from corners, or alike.
Weighting = Literal["stated", "covariances", "none"]


class LogFacts(BaseModel):
    """The facts of one log.

    Attributes
    ----------
    url, stamp : str
        The log, without credentials, and what changes when it does.
    rig_sha256, version : str
        Of the rig file with the files that it names; of the library.
    begin_ns, end_ns : int
        The first and the last measurement that is used, UTC nanoseconds.
    sensor_carrier, target_carrier : str
    about : "targetcarrier" or "sensorcarrier"
        The carrier in whose axes A is noisy.
    weighting : "stated", "covariances" or "none"
    cameras : dict
        Intrinsics by sensor.
    detection, cleaning
        The reports of the stages.
    poses : dict of str to int
        At how many poses of the carriers each frame is used.
    findings : list of (ground, words)
        What the log itself says against the poses.
    warnings : list of str
    measurements_sha256 : str
        Checksum of the file with the measurements.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    url: str
    stamp: str
    rig_sha256: str
    version: str
    begin_ns: int
    end_ns: int
    sensor_carrier: str
    target_carrier: str
    about: About
    weighting: Weighting
    cameras: dict[str, dict[str, Any]]
    detection: DetectionReport
    cleaning: CleaningReport
    poses: dict[str, int]
    findings: list[tuple[Ground, str]] = []
    warnings: list[str] = []
    measurements_sha256: str = ""

    def camera(self, sensor: str) -> Camera:
        """The intrinsics of a sensor."""
        c = self.cameras[sensor]
        return Camera.of(c["width"], c["height"], c["model"], c["K"], c["D"], f"{self.url}: {sensor}")


def camera_fields(camera: Camera) -> dict[str, Any]:
    """What `LogFacts.camera` reads."""
    return {
        "width": camera.width,
        "height": camera.height,
        "model": camera.model,
        "K": camera.K.tolist(),
        "D": camera.D.tolist(),
    }


def renamed(facts: LogFacts, names: Mapping[str, str]) -> LogFacts:
    """The facts with other names of sensors."""

    def track(one: TrackCount) -> TrackCount:
        return one.model_copy(update={"sensor": names.get(one.sensor, one.sensor)})

    def by_name(values: Mapping[str, object]) -> dict[str, object]:
        return {names.get(name, name): value for name, value in values.items()}

    detection = facts.detection.model_copy(
        update={
            "images": by_name(facts.detection.images),
            "undecoded": by_name(facts.detection.undecoded),
            "tracks": tuple(map(track, facts.detection.tracks)),
            "corner_px": {
                "/".join((key.partition("/")[0], names.get(key.partition("/")[2], key.partition("/")[2]))): value
                for key, value in facts.detection.corner_px.items()
            },
        }
    )
    cleaning = facts.cleaning.model_copy(
        update={
            "tracks": tuple(map(track, facts.cleaning.tracks)),
            "time_offsets_s": by_name(facts.cleaning.time_offsets_s),
            "coarse_sigma_s": by_name(facts.cleaning.coarse_sigma_s),
        }
    )
    updated = {"detection": detection, "cleaning": cleaning}
    return facts.model_copy(update=updated | {"cameras": by_name(facts.cameras), "poses": by_name(facts.poses)})


def merged_fields(logs: Sequence[LogFacts], outliers: Mapping[Pair, tuple[int, int]]) -> LogFields:
    """The history of all logs of a unit in one, as a result file has it.

    Parameters
    ----------
    logs : sequence of LogFacts
        At least one; of one robot, or with the sensors' names in the unit.
    outliers : dict of Pair to (int, int)
        Of each pair in the answer, how many measurements are used, and how many there were.
    """
    detections, cleanings = [log.detection for log in logs], [log.cleaning for log in logs]
    offsets: dict[str, list[float]] = {}
    for cleaning in cleanings:
        for name, offset_s in cleaning.time_offsets_s.items():
            offsets.setdefault(name, []).append(offset_s)
    mean_s = {name: float(np.mean(values)) for name, values in offsets.items()}
    sigmas: dict[str, float] = {}
    for cleaning in cleanings:
        for name, sigma_s in cleaning.coarse_sigma_s.items():
            sigmas[name] = max(sigmas.get(name, 0.0), sigma_s)
    first = logs[0]
    seen = {track.target for report in detections for track in report.tracks}
    return LogFields(
        sensor_carrier=first.sensor_carrier,
        target_carrier=first.target_carrier,
        detection=DetectionReport(
            sources=tuple(name for report in detections for name in report.sources),
            images=_sums(report.images for report in detections),
            undecoded={
                name: tuple(words for report in detections for words in report.undecoded.get(name, ()))
                for name in dict.fromkeys(name for report in detections for name in report.undecoded)
            },
            tracks=_tracks(track for report in detections for track in report.tracks),
            strangers=_sums(report.strangers for report in detections),
            unseen=tuple(dict.fromkeys(n for report in detections for n in report.unseen if n not in seen)),
            likely=tuple(dict.fromkeys(words for report in detections for words in report.likely)),
            remarks=tuple(dict.fromkeys(words for report in detections for words in report.remarks)),
            blurred=tuple(dict.fromkeys(words for report in detections for words in report.blurred)),
            corner_px={key: value for report in reversed(detections) for key, value in report.corner_px.items()},
        ),
        cleaning=CleaningReport(
            tracks=_tracks(track for cleaning in cleanings for track in cleaning.tracks),
            time_offsets_s=mean_s,
            coarse_sigma_s=sigmas,
        ),
        outliers=tuple(
            OutlierCount(target=pair.target, sensor=pair.sensor, used=used, left_out=there - used)
            for pair, (used, there) in sorted(outliers.items())
        ),
        sizes=(),
        time_offsets=tuple(
            TimeOffsetFields(sensor=name, offset_s=offset_s, sigma_s=sigmas.get(name))
            for name, offset_s in mean_s.items()
        ),
    )


def findings_of_logs(logs: Sequence[LogFacts]) -> list[Finding]:
    """What the logs say against the poses, with their names where there are several."""
    found: dict[tuple[Ground, str], list[str]] = {}
    for log in logs:
        for ground, words in log.findings:
            found.setdefault((ground, words), []).append(log.url.rpartition("/")[2])
    return [
        Finding(ground, words if len(names) == len(logs) else f"{', '.join(names[:3])}: {words}")
        for (ground, words), names in found.items()
    ]


def removed_of(logs: Sequence[LogFacts]) -> dict[str, int]:
    """How many measurements cleaning left out, by reason."""
    return _sums(track.removed for log in logs for track in log.cleaning.tracks)


def _sums(several: Iterable[Mapping[str, int]]) -> dict[str, int]:
    total: Counter[str] = Counter()
    for counts in several:
        total.update(counts)
    return dict(total)


def _tracks(tracks: Iterable[TrackCount]) -> tuple[TrackCount, ...]:
    """Counts of one pair added."""
    used: Counter[Pair] = Counter()
    removed: dict[Pair, Counter[str]] = {}
    for track in tracks:
        used[track.pair] += track.used
        removed.setdefault(track.pair, Counter()).update(track.removed)
    return tuple(
        TrackCount(target=pair.target, sensor=pair.sensor, used=used[pair], removed=dict(removed[pair]))
        for pair in sorted(removed)
    )
