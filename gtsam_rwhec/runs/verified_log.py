"""Whether an old calibration still holds, or is to be accepted, by a new log: detect, clean, and test."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import FrameError, LogError, LogWarning, StampError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.logs import Log, open_log
from gtsam_rwhec.problem.knowledge import scale_at
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.results.acceptance import LEVEL as PROBABILITY
from gtsam_rwhec.results.acceptance import accept
from gtsam_rwhec.results.acceptance_record import Acceptance, Volume
from gtsam_rwhec.results.change_test import LEVEL, checked_level
from gtsam_rwhec.results.log_history import DetectionReport, RemovalReason
from gtsam_rwhec.results.result_file import Result, parse_result, read_result, result_path
from gtsam_rwhec.results.verification import Verification, verify
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.rig.sections import Intrinsics
from gtsam_rwhec.runs.carrier_motion import CarrierMotion, read_carrier_motion
from gtsam_rwhec.runs.changed_rig import rig_for_cleaning, rig_for_solving
from gtsam_rwhec.runs.cleaning_stage import cleaned
from gtsam_rwhec.runs.detection_stage import detected
from gtsam_rwhec.runs.log_corners import LogCorners, with_intrinsics
from gtsam_rwhec.runs.measured_pairs import Pairs, at_offsets, problem_of, read_pairs, without_marks
from gtsam_rwhec.runs.recorded_logs import is_file_of_samples, is_folder_of_images, write_folder_log, write_samples_log
from gtsam_rwhec.runs.run_log import (
    CALIBRATION_LOG,
    CLEANING_METADATA,
    RECORDED_LOG,
    RESULT_FILE,
    RunLog,
    is_from_stage,
    read_cameras,
    read_cleaning_report,
    read_embedded_rig,
    read_metadata,
)

#: Standard deviation in pixels of a corner along each axis, for an old calibration that is not from corners. Detection
#: assumes the same until it has measured it. The test estimates the noise of poses itself.
CORNER_PX = 0.1


@dataclass(frozen=True, eq=False)
class OldCalibration:
    """An old calibration of a log, as its output folder holds it."""

    result: Result
    rig: Rig | None  #: The rig file in its solved log
    cameras: dict[str, Camera]  #: Intrinsics as it has them: estimated where they were

    @staticmethod
    def read(path: str | Path) -> OldCalibration:
        """Read it from an output folder, its ``calibration.mcap``, or a result file (the solved log may be beside it).

        Raises
        ------
        FileFormatError, LogError
            The files cannot be read, or hold no calibration.
        """
        path = Path(path)
        if path.suffix.lower() == ".mcap":
            with open_log(path) as log:
                content = log.attachment(RESULT_FILE)
            if content is None:
                raise LogError(f"{path} has no {RESULT_FILE} attached: gtsam-rwhec solve or calibrate did not write it")
            result, solved = parse_result(content, f"{path}, attachment {RESULT_FILE}"), path
        else:
            file = result_path(path)
            result, solved = read_result(file), file.with_name(CALIBRATION_LOG)
        rig, cameras = None, {}
        if solved.is_file():
            with open_log(solved) as log:
                rig, cameras = read_embedded_rig(log), read_cameras(log)
        estimated = {} if result.refined is None else result.refined.intrinsics
        return OldCalibration(result, rig, cameras | {name: one.camera for name, one in estimated.items()})


def with_cameras(rig: Rig, cameras: Mapping[str, Camera]) -> Rig:
    """The rig file with the intrinsics of an old calibration as numbers, for the sensors that have images."""
    sensors = {}
    for name, sensor in rig.sensors.items():
        camera = cameras.get(name)
        if camera is not None and sensor.images is not None:
            (fx, _, cx), (_, fy, cy) = camera.K[:2].tolist()
            numbers = Intrinsics(
                model=camera.model, size=(camera.width, camera.height), K=(fx, fy, cx, cy),
                D=tuple(camera.D.tolist()) or None, stated="calibration",
            )  # fmt: skip
            sensor = sensor.model_copy(update={"intrinsics": numbers})
        sensors[name] = sensor
    return rig.model_copy(update={"sensors": sensors})


@one_blas_thread()
def verify_log(
    old: str | Path,
    log_path: str | Path | list[str | Path],
    rig: Rig | None = None,
    *,
    level: float = LEVEL,
    targets_may_move: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Verification:
    """Whether the calibration in an output folder still holds on a new log.

    Targets are detected with the intrinsics of the old calibration, and the measurements cleaned as for a calibration.
    Nothing is written.

    Parameters
    ----------
    old
        The output folder of a calibration, its ``calibration.mcap`` or its ``result.json``.
    log_path
        As for ``calibrate_log``; of a log that a stage wrote, only the stages after it run.
    rig : Rig, optional
        By default the rig file of the old calibration, or, for a log that a stage wrote, the log's own.
    level : float
    targets_may_move : bool
        As in ``rw.results.verify``.
    workers : int, optional
        As in ``calibrate_log``.
    progress : callable, optional

    Raises
    ------
    RwhecError
        A file cannot be read, the rigs differ, or the new log has too few measurements; the message says which.
    """
    checked_level(level)
    tell = progress or silent
    calibration = OldCalibration.read(old)
    with _new_log(calibration, log_path, rig, workers, tell) as (log, given):
        return _verified(calibration, log, given, level=level, targets_may_move=targets_may_move, tell=tell)


@one_blas_thread()
def accept_log(
    result: str | Path,
    log_path: str | Path | list[str | Path],
    rig: Rig | None = None,
    *,
    limit_mm: float,
    sensor: str | None = None,
    volume: Volume | None = None,
    level: float = PROBABILITY,
    noise_mm: float | tuple[float, float] | None = None,
    known_to_mm: float = 0.0,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Acceptance:
    """Whether the calibration in an output folder is off by less than a limit, from a log that is new to it.

    The log and the rig are read as by `verify_log`, and tested as by ``rw.accept``, whose options these are. The boards
    may stand anywhere on the targets' carrier.

    Raises
    ------
    RwhecError
        A file cannot be read, the rigs differ, or the log is the one that was calibrated; the message says which.
    """
    tell = progress or silent
    calibration = OldCalibration.read(result)
    history = calibration.result.log
    with _new_log(calibration, log_path, rig, workers, tell) as (log, given):
        new = _NewMeasurements.read(calibration, log, given)
        same = history is not None and are_same_images(history.detection, read_metadata(log).detection)
        if same or _is_solved_in(log, calibration.result):
            raise LogError("the calibration was made from this very log, which proves nothing of it: give a new one")
        tell("testing the poses")
        found = accept(
            calibration.result, new.problem, limit_mm=limit_mm, sensor=sensor, volume=volume, level=level,
            noise_mm=noise_mm, known_to_mm=known_to_mm,
        )  # fmt: skip
    source = log_path[0] if isinstance(log_path, list) else log_path
    return replace(found, source=Path(source).name)


@contextmanager
def _new_log(
    old: OldCalibration, log_path: str | Path | list[str | Path], rig: Rig | None, workers: int | None, tell: Progress
) -> Iterator[tuple[Log, Rig | None]]:
    """The new log, detected with the old intrinsics and cleaned, and the rig file where it is not the log's own."""
    given = rig
    rig = rig or old.rig
    with TemporaryDirectory(prefix="gtsam-rwhec-verify-") as folder:
        if rig is not None and not isinstance(log_path, list):
            source, recorded = Path(log_path), Path(folder) / f"new{RECORDED_LOG}"
            if is_folder_of_images(source, rig):
                rig = rig.model_copy(update={"folder": source})
                write_folder_log(source, rig, recorded, progress=tell)
                log_path = recorded
            elif is_file_of_samples(source, rig):
                tell(write_samples_log(source, rig, recorded))
                log_path = recorded
        with open_log(log_path) as log:
            found: Log = log
            if not is_from_stage(log):
                if rig is None:
                    raise LogError(
                        f"{log.files[0].path}: a raw log needs a rig file, and the old calibration has no "
                        f"{CALIBRATION_LOG} that holds one: give --rig FILE"
                    )
                found = detected(log, with_cameras(rig, old.cameras), workers=workers, progress=tell)
                given = None
            if CLEANING_METADATA not in found.metadata():
                found, given = _cleaned(found, given, old, tell), None
            yield found, given


def _cleaned(detections: Log, given: Rig | None, old: OldCalibration, tell: Progress) -> RunLog:
    """Clean the log. If its motion does not determine a sensor's time offset, the old offset is taken as stated."""
    before = {} if old.result.log is None else {one.sensor: one.offset_s for one in old.result.log.time_offsets}
    rig = rig_for_cleaning(detections, given)
    free = [name for name, sensor in rig.sensors.items() if sensor.time_offset == "estimate" and name in before]
    found: RunLog | None = None
    try:
        with warnings.catch_warnings(action="ignore", category=LogWarning):
            found = cleaned(detections, rig, tell)
    except StampError:
        if not free:
            raise
    offsets_s = {} if found is None else read_cleaning_report(found).time_offsets_s
    untold = [name for name in free if name not in offsets_s]
    if found is not None and not untold:
        return found
    sensors = {
        name: sensor.model_copy(update={"time_offset": before[name]}) if name in untold else sensor
        for name, sensor in rig.sensors.items()
    }
    return cleaned(detections, rig.model_copy(update={"sensors": sensors}), tell)


@dataclass(frozen=True, eq=False)
class _NewMeasurements:
    """What the new log measures, with the intrinsics of the old calibration."""

    rig: Rig
    pairs: Pairs
    motion: CarrierMotion
    corners: LogCorners
    cameras: dict[str, Camera]
    free: tuple[str, ...]  #: Sensors whose time offset the rig file leaves to the data
    problem: Problem

    @staticmethod
    def read(old: OldCalibration, log: Log, given: Rig | None) -> _NewMeasurements:
        """Read the cleaned log."""
        rig, metadata, cleaning = rig_for_solving(log, given), read_metadata(log), read_cleaning_report(log)
        pairs, motion = without_marks(read_pairs(log, rig), (RemovalReason.OUTLIER,)), read_carrier_motion(log, rig)
        corners = LogCorners.of(log, rig, metadata.cameras)
        _check_carriers(old.result, rig)
        used = {measured.sensor for measured in pairs.values() if measured.used.any()}
        free = tuple(name for name, sensor in rig.sensors.items() if sensor.time_offset == "estimate" and name in used)
        pairs = at_offsets(pairs, motion.trajectory, cleaning.time_offsets_s, free)
        cameras = {**metadata.cameras, **old.cameras}
        refined = old.result.refined
        if refined is not None and any(_differ(cameras[name], metadata.cameras[name]) for name in metadata.cameras):
            px = CORNER_PX if refined.reprojection is None else refined.reprojection.corner_px
            pairs = with_intrinsics(pairs, corners, cameras, refined.X, refined.Y, px)
        return _NewMeasurements(
            rig, pairs, motion, corners, cameras, free, problem_of(pairs, rig, cleaning.time_offsets_s)
        )


def _verified(
    old: OldCalibration, log: Log, given: Rig | None, *, level: float, targets_may_move: bool, tell: Progress
) -> Verification:
    new, refined = _NewMeasurements.read(old, log, given), old.result.refined
    tell("testing the old poses")
    found = verify(
        old.result, new.problem, level=level, targets_may_move=targets_may_move, carrier_noise=new.motion.noise,
        time_offsets=new.free, carrier_path=new.motion.trajectory if new.free else None, progress=tell,
    )  # fmt: skip
    if refined is None:
        return found
    taken = _taken_offsets(old.result, new.rig)
    if taken:
        found = replace(found, remarks=(*found.remarks, *taken))
    if old.result.log is not None and are_same_images(old.result.log.detection, read_metadata(log).detection):
        remark = "the new log is the one that the old calibration comes from, so that it holds as a matter of course"
        found = replace(found, remarks=(remark, *found.remarks))
    pixels = {
        name: pixel_errors(refined, new.pairs, new.corners, new.cameras, name)
        for name in found.sensors
        if name in new.cameras
    }
    held_px = {name: float(np.median(errors)) for name, errors in pixels.items() if len(errors)}
    sensors = {name: replace(check, held_px=held_px.get(name)) for name, check in found.sensors.items()}
    return replace(found, sensors=sensors)


def _is_solved_in(log: Log, result: Result) -> bool:
    """Whether a log is the one that this result was written into."""
    content = log.attachment(RESULT_FILE)
    if content is None:
        return False
    inside = parse_result(content, RESULT_FILE).solution.Y
    return inside.keys() == result.solution.Y.keys() and all(
        np.array_equal(inside[name].matrix(), pose.matrix()) for name, pose in result.solution.Y.items()
    )


def _taken_offsets(old: Result, rig: Rig) -> list[str]:
    """The sensors whose old time offset was taken."""
    offsets = [] if old.log is None else [one for one in old.log.time_offsets if one.sigma_s is not None]
    return [
        f"the new motion does not tell the time offset of {shown(one.sensor)}, and the old one was taken: "
        f"{1e3 * one.offset_s:.1f} ms"
        for one in offsets
        if one.sensor in rig.sensors and rig.sensors[one.sensor].time_offset == one.offset_s
    ]


def are_same_images(one: DetectionReport, other: DetectionReport) -> bool:
    """Whether two detections are of the same images: the noise of their corners is the same to the last digit."""
    return bool(one.corner_px) and one.corner_px == other.corner_px and len(set(one.corner_px.values())) > 1


def _check_carriers(old: Result, rig: Rig) -> None:
    if old.log is None:
        return
    for what, name, now in (
        ("sensors", old.log.sensor_carrier, rig.carriers.sensors),
        ("targets", old.log.target_carrier, rig.carriers.targets),
    ):
        if name != now:
            raise FrameError(
                f"the carrier of the {what} is {shown(name)} in the old calibration and {shown(now)} in the new log: "
                "they are of different rigs. Give a log of the same rig"
            )


def _differ(one: Camera, other: Camera) -> bool:
    return one.model != other.model or not np.allclose(one.parameters, other.parameters, rtol=1e-12, atol=0.0)


def pixel_errors(
    answer: RefinedPoses, pairs: Pairs, corners: LogCorners, cameras: Mapping[str, Camera], sensor: str
) -> Array:
    """How far (n,) each corner is from where the poses say that it is, pixels.

    A target's corners are given with its stated size; the scale of the answer corrects it to the true size.
    """
    found = []
    for pair, measured in pairs.items():
        if pair.sensor != sensor or pair.target not in answer.X or sensor not in answer.Y:
            continue
        seen, pixels = corners.seen(measured)
        if not len(seen):
            continue
        scale = scale_at(answer.scale, pair.target)
        T = answer.Y[sensor].inverse().matrix() @ measured.A[seen] @ answer.X[pair.target].matrix()
        points = np.einsum("nij,kj->nki", T[:, :3, :3], corners.targets[pair.target] / scale) + T[:, None, :3, 3]
        projected = cameras[sensor].project(points.reshape(-1, 3)).reshape(pixels.shape)
        lengths = np.linalg.norm(projected - pixels, axis=2)
        found.append(lengths[np.isfinite(lengths)])
    return np.concatenate(found) if found else np.zeros(0)
