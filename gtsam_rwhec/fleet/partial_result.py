"""The partial result of one log: its cleaned measurements with their corners, and facts about the log, in one file.

A file has about 260 bytes for each measurement (of single tags).
"""

from __future__ import annotations

import io
import json
import zipfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError
from rwhec_factors.se3 import pose

from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.fitting.fit_options import About
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.log_history import (
    CleaningReport,
    DetectionReport,
    LogFields,
    OutlierCount,
    TimeOffsetFields,
    TrackCount,
)

#: The version of these files. The keys depend on it, and the files' names are made of the keys.
FORMAT_VERSION = 1
_TRIANGLE = np.triu_indices(6)


class LogFacts(BaseModel):
    """The facts about one log in its file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    url: str  #: Without credentials
    #: begin_ns, end_ns: the first and the last measurement that is used, UTC nanoseconds
    begin_ns: int
    end_ns: int
    about: About  #: The carrier in whose axes A is noisy
    cameras: dict[str, dict[str, Any]]  #: Intrinsics by sensor
    #: detection, cleaning: the reports of the stages
    detection: DetectionReport
    cleaning: CleaningReport
    poses: dict[str, int]  #: by frame: the number of the carriers' poses at which it is used
    findings: list[tuple[Ground, str]] = []  #: Findings in the log that speak against the poses
    warnings: list[str] = []

    def camera(self, sensor: str) -> Camera:
        """The intrinsics of a sensor."""
        return Camera.of(**self.cameras[sensor], where=f"{self.url}: {sensor}")


@dataclass(frozen=True, eq=False)
class PairMeasurements:
    """The cleaned measurements of one pair of a log."""

    stamps_ns: np.ndarray  #: (N,): on the carriers' clock
    #: A, B: (N, 4, 4)
    A: Array
    B: Array
    covariances: Array | None  #: (N, 6, 6): of B. The file has them in single precision
    #: (N, n, 2): the target's corners, nan where one was not seen. The file has them in single precision
    pixels: Array | None


@dataclass(frozen=True, eq=False)
class PartialResult:
    """The measurements and facts that are kept of a log."""

    facts: LogFacts
    pairs: Mapping[Pair, PairMeasurements]  #: by Pair
    #: T_sensorcarrier_targetcarrier over time, where a clock is to be estimated
    path: tuple[np.ndarray, Array] | None = None

    def packed(self) -> bytes:
        """The bytes of its file; equal content gives equal bytes."""
        arrays: dict[str, np.ndarray] = {}
        # Targets in one image share one A, which is stored once.
        stacked = [one.A[:, :3] for one in self.pairs.values()]
        poses, which = np.unique(np.concatenate(stacked).reshape(-1, 12), axis=0, return_inverse=True)
        arrays["poses"] = poses
        ends = np.cumsum([0, *map(len, stacked)])
        for i, one in enumerate(self.pairs.values()):
            arrays[f"{i}.A"] = which.ravel()[ends[i] : ends[i + 1]].astype(np.uint32)
            arrays[f"{i}.B"] = one.B[:, :3].reshape(-1, 12)
            arrays[f"{i}.stamps_ns"] = np.diff(one.stamps_ns, prepend=0)
            if one.covariances is not None:
                arrays[f"{i}.covariances"] = one.covariances[:, _TRIANGLE[0], _TRIANGLE[1]].astype(np.float32)
            if one.pixels is not None:
                arrays[f"{i}.pixels"] = one.pixels.astype(np.float32)
        if self.path is not None:
            arrays["path.stamps_ns"] = np.diff(self.path[0], prepend=0)
            arrays["path.T"] = self.path[1][:, :3].reshape(-1, 12)
        facts = {"log": self.facts.model_dump(mode="json"), "pairs": [list(pair) for pair in self.pairs]}
        stream = io.BytesIO()
        text = np.frombuffer(json.dumps(facts, sort_keys=True, allow_nan=False).encode(), np.uint8)
        np.savez_compressed(stream, facts=text, **arrays)  # type: ignore[arg-type]
        return stream.getvalue()


def read_partial(content: bytes, where: str) -> PartialResult:
    """A partial result from the bytes of its file; `where` names the file in the FileFormatError if it is invalid."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = dict(file)
        facts = json.loads(arrays["facts"].tobytes())
        pairs = {Pair(*pair): _pair(arrays, i) for i, pair in enumerate(facts["pairs"])}
        path = None
        if "path.T" in arrays:
            path = np.cumsum(arrays["path.stamps_ns"]), _poses(arrays["path.T"])
        return PartialResult(LogFacts.model_validate(facts["log"]), pairs, path)
    except (ValidationError, KeyError, ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise FileFormatError(f"{where} is no partial result of this version; remove it, and run again") from error


def _pair(arrays: Mapping[str, np.ndarray], i: int) -> PairMeasurements:
    triangle, pixels = arrays.get(f"{i}.covariances"), arrays.get(f"{i}.pixels")
    covariances = None
    if triangle is not None:
        covariances = np.empty((len(triangle), 6, 6))
        covariances[:, _TRIANGLE[0], _TRIANGLE[1]] = covariances[:, _TRIANGLE[1], _TRIANGLE[0]] = triangle
    return PairMeasurements(
        np.cumsum(arrays[f"{i}.stamps_ns"]),
        _poses(arrays["poses"][arrays[f"{i}.A"]]),
        _poses(arrays[f"{i}.B"]),
        covariances,
        None if pixels is None else pixels.astype(float),
    )


def _poses(rows: Array) -> Array:
    T = rows.reshape(-1, 3, 4)
    return pose(T[..., :3], T[..., 3])


def with_sensor_names(facts: LogFacts, names: Mapping[str, str]) -> LogFacts:
    """The facts with new names of sensors."""

    def track(one: TrackCount) -> TrackCount:
        return one.model_copy(update={"sensor": names.get(one.sensor, one.sensor)})

    def by_name(values: Mapping[str, object]) -> dict[str, object]:
        return {names.get(name, name): value for name, value in values.items()}

    detection, cleaning = facts.detection, facts.cleaning
    corner_px = {}
    for key, value in detection.corner_px.items():
        target, _, sensor = key.partition("/")
        corner_px[f"{target}/{names.get(sensor, sensor)}"] = value
    return facts.model_copy(
        update={
            "cameras": by_name(facts.cameras),
            "poses": by_name(facts.poses),
            "detection": detection.model_copy(
                update={
                    "images": by_name(detection.images),
                    "undecoded": by_name(detection.undecoded),
                    "tracks": tuple(map(track, detection.tracks)),
                    "corner_px": corner_px,
                }
            ),
            "cleaning": cleaning.model_copy(
                update={
                    "tracks": tuple(map(track, cleaning.tracks)),
                    "time_offsets_s": by_name(cleaning.time_offsets_s),
                    "coarse_sigma_s": by_name(cleaning.coarse_sigma_s),
                }
            ),
        }
    )


def history_of_logs(
    logs: Sequence[LogFacts], carriers: tuple[str, str], outliers: Mapping[Pair, tuple[int, int]]
) -> LogFields:
    """The histories of all logs of a unit (one at least) joined into one, in the form of a result file.

    The logs have the sensors' names in the unit; ``carriers`` are those of the sensors and of the targets. ``outliers``
    has for each pair in the answer how many measurements are used, and how many there were.
    """
    detections, cleanings = [log.detection for log in logs], [log.cleaning for log in logs]
    offsets: dict[str, list[float]] = {}
    sigmas: dict[str, float] = {}
    for cleaning in cleanings:
        for name, offset_s in cleaning.time_offsets_s.items():
            offsets.setdefault(name, []).append(offset_s)
        for name, sigma_s in cleaning.coarse_sigma_s.items():
            sigmas[name] = max(sigmas.get(name, 0.0), sigma_s)
    mean_s = {name: float(np.mean(values)) for name, values in offsets.items()}
    seen = {track.target for report in detections for track in report.tracks}
    return LogFields(
        sensor_carrier=carriers[0],
        target_carrier=carriers[1],
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
            likely=_once(report.likely for report in detections),
            remarks=_once(report.remarks for report in detections),
            blurred=_once(report.blurred for report in detections),
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
    """Findings of the logs that speak against the poses, with the logs' names if there are several."""
    found: dict[tuple[Ground, str], list[str]] = {}
    for log in logs:
        for ground, words in log.findings:
            found.setdefault((ground, words), []).append(log.url.rpartition("/")[2])
    return [
        Finding(ground, words if len(names) == len(logs) else f"{', '.join(names[:3])}: {words}")
        for (ground, words), names in found.items()
    ]


def removed_in_logs(logs: Sequence[LogFacts]) -> dict[str, int]:
    """How many measurements cleaning left out, by reason."""
    return _sums(track.removed for log in logs for track in log.cleaning.tracks)


def _sums(several: Iterable[Mapping[str, int]]) -> dict[str, int]:
    total: Counter[str] = Counter()
    for counts in several:
        total.update(counts)
    return dict(total)


def _once(several: Iterable[tuple[str, ...]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(words for each in several for words in each))


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
