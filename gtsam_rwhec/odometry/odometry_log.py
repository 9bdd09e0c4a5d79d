"""Calibrates sensors that know only their own motion: from a cleaned log to the joint answer and its files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from gtsam_rwhec.calibration.verdict import Judgement, Verdict
from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.clouds.named_fields import cloud_of_record
from gtsam_rwhec.errors import LogError, OptionError, RwhecError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.logs import CloudRecord, Log, LogWriter, open_log
from gtsam_rwhec.odometry import (
    Given,
    Ground,
    KnownDirection,
    OdometryCalibration,
    OdometryOptions,
    OdometryTrack,
    calibrate_odometries,
)
from gtsam_rwhec.odometry.odometry_report import write_odometry_page
from gtsam_rwhec.odometry.odometry_result import (
    OdometryResult,
    parse_odometry_result,
    result_json,
    result_of,
    write_odometry_result,
)
from gtsam_rwhec.results.log_history import CleaningReport
from gtsam_rwhec.rig import Rig, RigFrames
from gtsam_rwhec.rig.exported_files import FILES, export_all
from gtsam_rwhec.runs.changed_rig import rig_for_solving
from gtsam_rwhec.runs.cleaning_stage import cleaned
from gtsam_rwhec.runs.detection_stage import detected
from gtsam_rwhec.runs.measured_pairs import read_pairs, write_pairs
from gtsam_rwhec.runs.odometry_cleaning import gates_of
from gtsam_rwhec.runs.odometry_motions import files_of, read_odometry, records_of_files
from gtsam_rwhec.runs.output_folder import list_written, log_name, made_folder, made_output_folder, output_folder
from gtsam_rwhec.runs.run_log import (
    CALIBRATION_LOG,
    OF_DETECTION,
    REPORT_FILE,
    RESULT_FILE,
    SOLUTION_TOPIC,
    clouds_topic,
    is_from_stage,
    read_embedded_rig,
    read_metadata,
    topics_up_to_detection,
    write_run_log,
)
from gtsam_rwhec.runs.whole_runs import checked_sources, is_cleaned, log_of_files


@dataclass(frozen=True, eq=False)
class OdometrySolved:
    """A calibration of odometries from a log."""

    result: OdometryResult  #: The content of ``result.json``
    rig: Rig  #: The rig file that was used
    cleaning: CleaningReport  #: What cleaning removed
    #: What ``calibrate_odometries`` returned; None where the log was solved before
    calibration: OdometryCalibration | None = None

    @property
    def judgement(self) -> Judgement:
        """The verdict, with its grounds."""
        return self.result.judgement


@one_blas_thread()
def solve_odometries(
    clean_path: str | Path, rig: Rig | None = None, *, progress: Progress | None = None
) -> OdometrySolved:
    """Calibrate from the cleaned log of odometries. Raises as `calibrate_odometry_log`."""
    with open_log(clean_path) as log:
        rig = rig_for_solving(log, rig)
        if not rig.is_of_odometries:
            raise OptionError(f"{clean_path}: its rig file has sensors that see targets; solve it with solve_log")
        metadata = read_metadata(log)
        if metadata.cleaning is None:
            raise LogError(f"{clean_path} was not cleaned: gtsam-rwhec clean {clean_path} -o cleaned.mcap")
        tracks = [_on_reference_clock(read_odometry(log, rig, name), rig) for name in rig.odometries]
        maps = {name: _maps_of(log, rig, name) for name, one in rig.odometries.items() if one.odometry.registers}
    assert rig.reference is not None
    options = options_of(rig)
    found = calibrate_odometries(
        tracks, reference=rig.reference, given=given_of(rig), options=options, maps=maps, progress=progress
    )
    stated = {name: float(one.time_offset) for name, one in rig.odometries.items() if one.time_offset != "estimate"}
    offsets = {name: value + stated.get(name, 0.0) for name, value in found.time_offsets_s.items()}
    found = replace(found, time_offsets_s=offsets)
    frames = {name: rig.frame_of(name) for name in rig.odometries}
    return OdometrySolved(result_of(found, frames, metadata.detection.sources), rig, metadata.cleaning, found)


def _stated_ns(rig: Rig, sensor: str) -> int:
    """The stated time offset, which is added to stamps; none where it is estimated."""
    offset = rig.odometries[sensor].time_offset
    return 0 if offset == "estimate" else round(1e9 * float(offset))


def _on_reference_clock(track: OdometryTrack, rig: Rig) -> OdometryTrack:
    """The track with its stated time offset added to the stamps."""
    return replace(track, stamps_ns=np.asarray(track.stamps_ns) + _stated_ns(rig, track.sensor))


def _maps_of(log: Log, rig: Rig, sensor: str) -> list[Cloud]:
    """What detection kept of a LiDAR's clouds, on the reference's clock as its track is."""
    there = {clouds_topic(sensor)} & {topic.name for topic in log.topics()}  # a log of an earlier version has none
    records = [each for each in log.records(there) if isinstance(each, CloudRecord)] if there else []
    return [replace(cloud_of_record(each), stamp_ns=each.stamp_ns + _stated_ns(rig, sensor)) for each in records]


def given_of(rig: Rig) -> Given:
    """The prior knowledge in the rig file's ``given`` section, in SI units."""
    said = rig.given
    ground = said.ground
    return Given(
        heights_m={name: (height, 1e-3 * said.height_sigma_mm) for name, height in said.heights_m.items()},
        ground=None
        if ground is None
        else Ground(ground.up, ground.below_m, float(np.radians(ground.sigma_deg)), 1e-3 * ground.sigma_mm),
        directions=tuple(
            KnownDirection(one.sensor, one.of, one.in_reference, float(np.radians(one.sigma_deg)))
            for one in said.directions
        ),
        distances_m={one.between: (one.distance_m, 1e-3 * one.sigma_mm) for one in said.distances},
    )


def options_of(rig: Rig) -> OdometryOptions:
    """The options: the widest gates of all sensors; time offsets are estimated if any sensor needs it."""
    gates = gates_of(rig)
    return OdometryOptions(
        estimate_time_offsets=any(one.time_offset == "estimate" for one in rig.odometries.values()),
        max_speed_m_per_s=gates.max_speed_m_per_s,
        max_turn_rad_per_s=gates.max_turn_rad_per_s,
        max_gap_s=max(one.odometry.max_gap_s for one in rig.odometries.values()),
        reject_outliers=gates.reject_jumps,
    )


def solve_odometries_into(
    clean_path: str | Path, rig: Rig | None, out: str | Path, *, progress: Progress | None = None
) -> OdometrySolved:
    """Solve; write ``result.json``, ``report.html``, and ``calibration.mcap`` with the solution, into a folder."""
    out = made_output_folder(out)
    solved = solve_odometries(clean_path, rig, progress=progress)
    write_odometry_result(solved.result, out / RESULT_FILE)
    write_odometry_page(solved.result, out / REPORT_FILE)
    with open_log(clean_path) as log, LogWriter(out / CALIBRATION_LOG) as writer:
        writer.copy(log, topics_up_to_detection(log), "leave_out", of_stages=OF_DETECTION)
        pairs = read_pairs(log, solved.rig)
        write_pairs(writer, pairs.values())
        replace(read_metadata(log), rig=solved.rig).write(writer)
        first_ns = min(int(one.stamps_ns[0]) for one in pairs.values())
        frames = frames_of_odometries(solved)
        named = [(parent, child, np.asarray(T, dtype=np.float64)) for parent, child, T in frames.sensor_frames()]
        writer.transforms(SOLUTION_TOPIC, first_ns, named)
        writer.attachment(RESULT_FILE, "application/json", result_json(solved.result), first_ns)
    list_written(out, solved.result.sources, [out / name for name in (RESULT_FILE, REPORT_FILE, CALIBRATION_LOG)])
    return solved


def read_odometries(path: str | Path) -> OdometrySolved:
    """Read the log that `solve_odometries_into` wrote; `LogError` if it has no result."""
    with open_log(path) as log:
        content = log.attachment(RESULT_FILE)
        if content is None:
            raise LogError(f"{path} has no {RESULT_FILE} attached: gtsam-rwhec solve or calibrate did not write it")
        result = parse_odometry_result(content, f"{path}, attachment {RESULT_FILE}")
        metadata = read_metadata(log)
    if metadata.cleaning is None or {one.sensor for one in result.tracks} != set(metadata.rig.odometries):
        raise LogError(
            f"{path} has a {RESULT_FILE} of other sensors than its rig file: they are not of one calibration"
        )
    return OdometrySolved(result, metadata.rig, metadata.cleaning)


def frames_of_odometries(solved: OdometrySolved) -> RigFrames:
    """The calibrated frames: sensors on the reference."""
    result, rig = solved.result, solved.rig
    warnings = () if result.verdict is Verdict.USE else (str(result.judgement), *result.not_determined)
    return RigFrames(
        sensor_carrier=rig.carriers.sensors,
        target_carrier=rig.carriers.targets,
        sensors={rig.frame_of(one.sensor): result.pose(one.sensor) for one in result.sensors},
        targets={},
        time_offsets_s={rig.frame_of(one.sensor): one.time_offset_s for one in result.sensors},
        warnings=warnings,
    )


def is_of_odometries(rig: Rig | None, source: str | Path | None = None) -> bool:
    """Whether a rig file (or that in a stage's log or folder) has odometries only, and one of them as reference."""
    if rig is not None:
        return rig.is_of_odometries
    if source is None or not Path(source).exists():
        return False
    try:
        with open_log(source) as log:
            return is_from_stage(log) and read_embedded_rig(log).is_of_odometries
    except RwhecError:
        return False  # the stage that reads it says why


@one_blas_thread()
def calibrate_odometry_log(
    log_path: str | Path,
    rig: Rig | None,
    out: str | Path,
    *,
    anyway: bool = False,
    replace: bool = True,
    progress: Progress | None = None,
) -> OdometrySolved:
    """Calibrate sensors that know only their own motion, from a log and a rig file to a folder of files.

    The folder gets ``calibration.mcap``, ``result.json``, ``report.html``, and the frames for ROS and URDF.

    Parameters
    ----------
    log_path
        As for ``open_log``; or a folder with the odometries in files (TUM), which the rig file names.
    rig : Rig or None
        With ``reference:``, and all sensors with ``odometry:``. None: the rig file of a log that a stage wrote.
    out
        The folder; it is made if it does not exist.
    anyway : bool
        Whether to also write frames whose poses must not be used, with the reason in the head of each file.
    replace : bool
        As for ``calibrate_log``.
    progress : callable, optional

    Raises
    ------
    LogError, StampError, TransformError
        The log lacks what the rig file names.
    RwhecError
        As ``calibrate_odometries`` does.
    """
    source = Path(log_path)
    if rig is not None and source.is_dir() and not any(source.glob("*.mcap")):
        return _calibrate_files(source, rig, out, anyway=anyway, replace=replace, progress=progress)
    with open_log(source) as log:
        sources, files = checked_sources(log, rig, out), [file.path for file in log.files]
    with output_folder(out, log_name(sources), replace=replace, sources=files) as output:
        output.begin()
        return _stages(files, rig, output.path, anyway=anyway, progress=progress)


def _calibrate_files(
    folder: Path, rig: Rig, out: str | Path, *, anyway: bool, replace: bool, progress: Progress | None
) -> OdometrySolved:
    """Calibrate from files: a temporary log is made of them, and removed at the end."""
    rig = rig.model_copy(update={"folder": folder})
    in_files = {name for name, _ in files_of(rig)}
    others = [name for name in rig.odometries if name not in in_files]
    if others:
        raise LogError(
            f"{folder} has no MCAP file, and {rig.source.place(('sensors', others[0], 'odometry'))} is of a log; write "
            "odometry: {file: NAME} for a file of poses in this folder"
        )
    with log_of_files(folder, out, replace=replace) as (output, recorded):
        with LogWriter(recorded) as log:
            for pose in chain.from_iterable(records_of_files(rig).values()):
                log.pose(pose.topic, pose.stamp_ns, pose.parent, pose.T)
        return _stages([recorded], rig, output.path, anyway=anyway, progress=progress)


def _stages(
    files: list[Path], rig: Rig | None, out: Path, *, anyway: bool, progress: Progress | None
) -> OdometrySolved:
    with open_log(files) as log:
        if not is_cleaned(log, rig):
            found = log
            if not is_from_stage(log):
                assert rig is not None
                found = detected(log, rig, progress=progress)
            write_run_log(cleaned(found, rig, progress), out / CALIBRATION_LOG, "leave_out")
            files = [out / CALIBRATION_LOG]
    solved = solve_odometries_into(files[0], rig, out, progress=progress)
    export_odometries(out / CALIBRATION_LOG, out, anyway=anyway, progress=progress)
    return solved


def export_odometries(
    solved_path: str | Path, out: str | Path, *, anyway: bool = False, progress: Progress | None = None
) -> list[Path]:
    """Write the frames from a solved log of odometries for other programs; none if the poses must not be used."""
    out = made_folder(out)
    (progress or silent)("exporting")
    solved = read_odometries(solved_path)
    if solved.judgement.verdict is Verdict.DO_NOT_USE and not anyway:
        for name in FILES:
            (out / name).unlink(missing_ok=True)
        return []
    written = export_all(frames_of_odometries(solved), out)
    list_written(out, solved.result.sources, written)
    return written
