"""Make a partial result of one log with the stages that ``calibrate`` runs, in a folder of the worker."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.errors import LogError, RigError, RwhecError, RwhecWarning, StoreInterruptedError
from gtsam_rwhec.fleet.manifest import RigSource
from gtsam_rwhec.fleet.partial_result import FORMAT_VERSION, LogFacts, PairMeasurements, PartialResult
from gtsam_rwhec.fleet.stores import shown, stamp_of
from gtsam_rwhec.fleet.tasks import Receipt, filed, key_of
from gtsam_rwhec.fleet.topic_copy import local_copy_of_topics
from gtsam_rwhec.logs import Log, open_log
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.rig.sections import Sensor
from gtsam_rwhec.runs.carrier_motion import CarrierMotion, read_carrier_motion
from gtsam_rwhec.runs.cleaning_stage import clean_log
from gtsam_rwhec.runs.clocks_by_turning import late_clocks
from gtsam_rwhec.runs.detection_stage import detect_log
from gtsam_rwhec.runs.doubted_statements import continued_boards, doubted_intrinsics, doubted_shapes, finding_against
from gtsam_rwhec.runs.log_corners import LogCorners
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs, poses_used, read_pairs
from gtsam_rwhec.runs.run_log import CALIBRATION_LOG, DETECTED_LOG, LogMetadata, is_from_stage, read_metadata
from gtsam_rwhec.runs.topics_of_rig import wanted_topics

#: The folder of partial results in the output.
FOLDER = "partials"


@dataclass(frozen=True)
class LogTask:
    """One log to read: its URL, a stamp that changes when the log changes, and its rig file."""

    url: str
    stamp: str
    rig: RigSource

    @property
    def key(self) -> str:
        """A checksum of all that the partial result depends on."""
        return key_of(self.url, self.stamp, self.rig.sha256, FORMAT_VERSION, version("gtsam-rwhec"))

    @property
    def file(self) -> str:
        """The path of the partial result in the output."""
        return f"{FOLDER}/{self.key}.partial"


def map_log(task: LogTask, output: str) -> Receipt:
    """Read a log, detect, clean, and write its measurements to the output (a folder or a URL).

    Raises `RwhecError` as ``detect_log`` and ``clean_log`` do, or if the log changed while it was read; `OSError` if
    the store broke off.
    """
    return filed(output, task.key, task.file, lambda folder: _partial(task, folder).packed())


def _partial(task: LogTask, folder: Path) -> PartialResult:
    """The partial result of a log. Messages about the worker's files name the log instead."""
    rig = task.rig.rig(folder)
    _refuse_odometry_and_clouds(rig)
    detected, cleaned = folder / DETECTED_LOG, folder / CALIBRATION_LOG
    places = [str(detected), str(cleaned)]

    def in_words(said: object) -> str:
        words = str(said)
        for place in places:
            words = words.replace(place, shown(task.url))
        return words

    with warnings.catch_warnings(record=True, action="always", category=RwhecWarning) as caught:
        try:
            path = local_copy_of_topics(task.url, wanted_topics(rig), folder)
            places.append(str(path))
            if stamp_of(task.url) != task.stamp:
                raise LogError(f"{shown(task.url)} changed while it was read; run again when it is whole")
            partial = _of_stages(task, path, rig, detected, cleaned)
        except StoreInterruptedError:
            raise
        except RwhecError as error:
            raise type(error)(in_words(error)) from error
    said: dict[str, None] = {}
    for warning in caught:
        if isinstance(warning.message, RwhecWarning):
            said[in_words(warning.message)] = None
        else:
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    return replace(partial, facts=partial.facts.model_copy(update={"warnings": list(said)}))


def _refuse_odometry_and_clouds(rig: Rig) -> None:
    """A RigError for what partial results have no place for: motions, and an object, whose frame each log makes."""
    names = list(rig.odometries)
    if names:
        raise RigError(
            f"{rig.source.place(('sensors', names[0]))}: {names[0]} knows only its own motion, and a fleet's partial "
            "results have no motions: leave it out of the fleet's rig file, or run gtsam-rwhec calibrate on each log"
        )
    if rig.object is not None:
        raise RigError(
            f"{rig.source.place(('targets', rig.object))}: {rig.object} is an object in clouds, whose frame is another "
            "in each log: leave it out of the fleet's rig file, or run gtsam-rwhec calibrate on each log"
        )


def _of_stages(task: LogTask, path: Path, rig: Rig, detected: Path, cleaned: Path) -> PartialResult:
    """Run the stages that the log has not been through."""
    with open_log(path) as log:
        is_detected = is_from_stage(log)
    if is_detected:
        detected = path
    else:
        has_images = any(sensor.images is not None for sensor in rig.sensors.values() if isinstance(sensor, Sensor))
        detect_log(path, rig, detected, workers=1 if has_images else None)
    clean_log(detected, cleaned, rig if is_detected else None, images="leave_out")
    with open_log(cleaned) as log:
        return _of_cleaned(task, log, rig)


def _of_cleaned(task: LogTask, log: Log, rig: Rig) -> PartialResult:
    metadata, motion = read_metadata(log), read_carrier_motion(log, rig)
    assert metadata.cleaning is not None
    pairs = {pair: measured for pair, measured in read_pairs(log, rig).items() if measured.used.any()}
    corners = LogCorners.of(log, rig, metadata.cameras)
    kept = {pair: _kept(one, corners, metadata.cleaning.time_offsets_s) for pair, one in pairs.items()}
    has_clocks = any(sensor.time_offset == "estimate" for sensor in rig.sensors.values())
    facts = LogFacts(
        url=shown(task.url),
        begin_ns=min(int(one.stamps_ns[0]) for one in kept.values()),
        end_ns=max(int(one.stamps_ns[-1]) for one in kept.values()),
        about=motion.about,
        cameras={sensor: camera.numbers for sensor, camera in metadata.cameras.items()},
        detection=metadata.detection.model_copy(update={"sources": (shown(task.url).rpartition("/")[2],)}),
        cleaning=metadata.cleaning,
        poses=poses_used(pairs.values()),
        findings=[(f.ground, f.words) for f in _findings(log, rig, metadata, motion, pairs)],
    )
    return PartialResult(facts, kept, (motion.trajectory.stamps_ns, motion.trajectory.T) if has_clocks else None)


def _kept(measured: MeasuredPairs, corners: LogCorners, offsets_s: Mapping[str, float]) -> PairMeasurements:
    used = np.flatnonzero(measured.used)
    with_corners, pixels = corners.seen(measured)
    of_used = None
    if len(with_corners):
        of_used = np.full((len(used), *pixels.shape[1:]), np.nan)
        of_used[np.searchsorted(used, with_corners)] = pixels
    return PairMeasurements(
        measured.stamps_ns[used] + round(1e9 * offsets_s.get(measured.sensor, 0.0)),
        measured.A[used],
        measured.B[used],
        None if measured.covariance is None else measured.covariance[used],
        of_used,
    )


def _findings(
    log: Log, rig: Rig, metadata: LogMetadata, motion: CarrierMotion, pairs: Mapping[Pair, MeasuredPairs]
) -> list[Finding]:
    """Findings in the log that speak against the poses: clocks, intrinsics, boards, blurred images."""
    stated_s = {
        name: float(sensor.time_offset) for name, sensor in rig.sensors.items() if sensor.time_offset != "estimate"
    }
    doubted = doubted_intrinsics(log, rig, metadata.cameras)
    return [
        *late_clocks(dict(pairs), motion.trajectory, rig, stated_s),
        *(finding_against(name, found, rig) for name, found in doubted.items()),
        *doubted_shapes(log, rig, metadata.cameras),
        *continued_boards(metadata.detection.strangers, rig),
        *(Finding(Ground.IMAGES_BLURRED, words) for words in metadata.detection.blurred),
    ]
