"""The map: one log becomes one partial result, by the stages that ``calibrate`` runs, in a folder of the worker."""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.errors import LogError, RigError, RwhecError, RwhecWarning, StoreInterruptedError
from gtsam_rwhec.fleet.container import FORMAT_VERSION
from gtsam_rwhec.fleet.log_facts import LogFacts, Weighting, camera_fields
from gtsam_rwhec.fleet.log_parts import local_copy_of_topics
from gtsam_rwhec.fleet.measured_task import measured_task
from gtsam_rwhec.fleet.pair_moments import PairMoments
from gtsam_rwhec.fleet.partial import FOLDER, KeptLog, KeptPair, Partial, checksum, in_single
from gtsam_rwhec.fleet.receipts import below, keep_receipt, kept_receipt
from gtsam_rwhec.fleet.rig_source import RigSource
from gtsam_rwhec.fleet.stores import stamp_of, write_once
from gtsam_rwhec.fleet.tasks import Receipt
from gtsam_rwhec.fleet.without_secrets import shown
from gtsam_rwhec.logs import Log, open_log
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.rig.odometry_sections import OdometrySensor
from gtsam_rwhec.rig.sections import Sensor
from gtsam_rwhec.runs.carrier_motion import CarrierMotion, read_carrier_motion
from gtsam_rwhec.runs.cleaning_stage import clean_log
from gtsam_rwhec.runs.clocks_by_turning import late_clocks
from gtsam_rwhec.runs.detection_stage import detect_log
from gtsam_rwhec.runs.doubted_intrinsics import doubted_intrinsics, finding_against
from gtsam_rwhec.runs.doubted_shapes import continued_boards, doubted_shapes
from gtsam_rwhec.runs.log_corners import LogCorners
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs, poses_used, problem_of, read_pairs
from gtsam_rwhec.runs.run_log import CLEAN_LOG, DETECTED_LOG, LogMetadata, is_from_stage, read_metadata
from gtsam_rwhec.runs.topics_of_rig import wanted_topics


@dataclass(frozen=True)
class LogTask:
    """One log to be mapped.

    Attributes
    ----------
    url, stamp : str
        The log, and what changes when it does.
    rig : RigSource
    """

    url: str
    stamp: str
    rig: RigSource

    @property
    def key(self) -> str:
        """A checksum of all that the partial result depends on."""
        parts = [self.url, self.stamp, self.rig.sha256, FORMAT_VERSION, version("gtsam-rwhec")]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:40]

    @property
    def file(self) -> str:
        """The place of the partial result below the output."""
        return partial_file(self.key)


def partial_file(key: str) -> str:
    """The place of a partial result below the output."""
    return f"{FOLDER}/{key}.partial"


def measurements_file(partial: str) -> str:
    """The place of the measurements of a partial result."""
    return partial.removesuffix(".partial") + ".measurements"


def map_log(task: LogTask, output: str) -> Receipt:
    """Read a log, detect, clean, and keep its moments and measurements.

    Parameters
    ----------
    task : LogTask
    output : str
        URL of the run's output.

    Raises
    ------
    RwhecError
        As ``detect_log`` and ``clean_log`` do; the log has changed while it was read.
    OSError
        The store stopped.
    """
    earlier = kept_receipt(output, task.file)
    if earlier is not None:
        return earlier
    with measured_task(task.key) as measured, TemporaryDirectory(prefix="gtsam-rwhec-") as temporary:
        folder = Path(temporary)
        partial, kept = _partial(task, folder)
        measurements = kept.packed()
        facts = partial.facts.model_copy(update={"measurements_sha256": checksum(measurements)})
        content = replace(partial, facts=facts).packed()
        write_once(below(output, measurements_file(task.file)), measurements)
        write_once(below(output, task.file), content)
        receipt = measured.receipt(task.file, checksum(content))
    return keep_receipt(output, receipt)


def _partial(task: LogTask, folder: Path) -> tuple[Partial, KeptLog]:
    """The partial result of a log. What is said of files of the worker is said of the log."""
    rig = task.rig.rig(folder)
    _refuse_odometry(rig)
    detected, cleaned = folder / DETECTED_LOG, folder / CLEAN_LOG
    places = [str(detected), str(cleaned)]

    def in_words(said: object) -> str:
        words = str(said)
        for place in places:
            words = words.replace(place, shown(task.url))
        return words

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", RwhecWarning)
        try:
            path, _ = local_copy_of_topics(task.url, wanted_topics(rig), folder)
            places.append(str(path))
            if stamp_of(task.url) != task.stamp:
                raise LogError(f"{shown(task.url)} changed while it was read; run again when it is whole")
            partial, kept = _summed(task, path, rig, detected, cleaned)
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
    return replace(partial, facts=partial.facts.model_copy(update={"warnings": list(said)})), kept


def _refuse_odometry(rig: Rig) -> None:
    """A RigError for sensors that know only their own motion: their motions are not in partial results."""
    names = [name for name, sensor in rig.sensors.items() if isinstance(sensor, OdometrySensor)]
    if names:
        raise RigError(
            f"{rig.source.place(('sensors', names[0]))}: {names[0]} knows only its own motion, and a fleet's partial "
            "results have no motions: leave it out of the fleet's rig file, or run gtsam-rwhec calibrate on each log"
        )


def _summed(task: LogTask, path: Path, rig: Rig, detected: Path, cleaned: Path) -> tuple[Partial, KeptLog]:
    """The stages, where they have not been, and their sums."""
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


def _of_cleaned(task: LogTask, log: Log, rig: Rig) -> tuple[Partial, KeptLog]:
    """Moments, measurements and facts of a cleaned log."""
    metadata, motion = read_metadata(log), read_carrier_motion(log, rig)
    cleaning = metadata.cleaning
    assert cleaning is not None
    pairs = {
        pair: measured if measured.covariance is None else replace(measured, covariance=in_single(measured.covariance))
        for pair, measured in read_pairs(log, rig).items()
        if measured.used.any()
    }
    offsets_s = cleaning.time_offsets_s
    free_sizes = rig.targets if rig.sizes == "estimate" else ()
    problem = problem_of(pairs, rig, offsets_s, free_sizes)
    corners = LogCorners.of(log, rig, metadata.cameras)
    kept = _kept(pairs, corners, offsets_s)
    if any(sensor.time_offset == "estimate" for sensor in rig.sensors.values()):
        kept = replace(kept, path=(motion.trajectory.stamps_ns, motion.trajectory.T))
    stamps = [one.stamps_ns for one in kept.pairs.values()]
    sources = (shown(task.url).rpartition("/")[2],)
    facts = LogFacts(
        url=shown(task.url),
        stamp=task.stamp,
        rig_sha256=task.rig.sha256,
        version=version("gtsam-rwhec"),
        begin_ns=min(int(each[0]) for each in stamps),
        end_ns=max(int(each[-1]) for each in stamps),
        sensor_carrier=rig.carriers.sensors,
        target_carrier=rig.carriers.targets,
        about=motion.about,
        weighting=_weighting(pairs, rig, is_relative=problem.is_relative),
        cameras={sensor: camera_fields(camera) for sensor, camera in metadata.cameras.items()},
        detection=metadata.detection.model_copy(update={"sources": sources}),
        cleaning=cleaning,
        poses=poses_used(pairs.values()),
        findings=[(f.ground, f.words) for f in _findings(log, rig, metadata, motion, pairs)],
    )
    return Partial(facts, PairMoments.of(problem)), kept


def _kept(pairs: Mapping[Pair, MeasuredPairs], corners: LogCorners, offsets_s: Mapping[str, float]) -> KeptLog:
    found = {}
    for pair, measured in pairs.items():
        used = np.flatnonzero(measured.used)
        seen, pixels = corners.seen(measured)
        of_used = None
        if len(seen):
            of_used = np.full((len(used), *pixels.shape[1:]), np.nan)
            of_used[np.searchsorted(used, seen)] = pixels
        found[pair] = KeptPair(
            measured.stamps_ns[used] + round(1e9 * offsets_s.get(pair.sensor, 0.0)),
            measured.A[used],
            measured.B[used],
            None if measured.covariance is None else measured.covariance[used],
            of_used,
        )
    return KeptLog(found)


def _weighting(pairs: Mapping[Pair, MeasuredPairs], rig: Rig, *, is_relative: bool) -> Weighting:
    """As `problem_of` weights them."""
    if is_relative:
        return "none"
    is_stated = rig.noise != "estimate" and rig.noise.rotation_deg is not None and rig.noise.translation_mm is not None
    return "stated" if is_stated else "covariances"


def _findings(
    log: Log, rig: Rig, metadata: LogMetadata, motion: CarrierMotion, pairs: Mapping[Pair, MeasuredPairs]
) -> list[Finding]:
    """What the log itself says against the poses: its clocks, intrinsics and boards, and blurred images."""
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
