"""The log road of sensors that know only their own motion: from a log, or files of poses, to a folder of files."""

from __future__ import annotations

from pathlib import Path

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.errors import LogError, RwhecError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.logs import LogWriter, open_log
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.rig.exported_files import FILES, export_all
from gtsam_rwhec.runs.changed_rig import changes
from gtsam_rwhec.runs.cleaning_stage import clean_log
from gtsam_rwhec.runs.detection_stage import detect_log
from gtsam_rwhec.runs.odometry_solving import (
    OdometrySolved,
    frames_of_odometries,
    read_odometries,
    solve_odometries_into,
)
from gtsam_rwhec.runs.odometry_tracks import files_of, write_files
from gtsam_rwhec.runs.output_folder import check_is_not_read, list_written, log_name, made_folder, output_folder
from gtsam_rwhec.runs.run_log import (
    CLEAN_LOG,
    CLEANING_METADATA,
    DETECTED_LOG,
    RECORDED_LOG,
    is_from_stage,
    read_embedded_rig,
    read_metadata,
)


def is_of_odometries(rig: Rig | None, source: str | Path | None = None) -> bool:
    """Whether a rig file, or the one in a log that a stage wrote, has odometries alone and one of them as reference."""
    if rig is not None:
        return rig.is_of_odometries
    if source is None or not Path(source).is_file():
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

    The folder gets ``clean.mcap``, ``result.json``, ``report.html``, and the frames for ROS and URDF.

    Parameters
    ----------
    log_path
        As for ``open_log``; or a folder with the odometries in files (TUM), which the rig file names.
    rig : Rig or None
        With ``reference:``, and all sensors with ``odometry:``. None: the rig file of a log that a stage wrote.
    out
        The folder; it is made if it does not exist.
    anyway : bool
        Whether to write the frames of poses that are not to be used too, with the reason in the head of each file.
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
        files = [file.path for file in log.files]
        is_raw = not is_from_stage(log)
        if is_raw and rig is None:
            raise LogError(f"{files[0]}: a raw log needs a rig file (--rig); gtsam-rwhec init LOG makes a first one")
        if is_raw:
            for name in (DETECTED_LOG, CLEAN_LOG):
                check_is_not_read(log, Path(out) / name)
        is_cleaned = CLEANING_METADATA in log.metadata() and (
            rig is None or not changes(read_embedded_rig(log), rig).cleaning
        )
        sources = tuple(file.name for file in files) if is_raw else read_metadata(log).detection.sources
    with output_folder(out, log_name(sources), replace=replace, sources=files) as output:
        output.begin()
        return _stages(files, rig, output.path, is_raw=is_raw, is_cleaned=is_cleaned, anyway=anyway, progress=progress)


def _calibrate_files(
    folder: Path, rig: Rig, out: str | Path, *, anyway: bool, replace: bool, progress: Progress | None
) -> OdometrySolved:
    """By way of a log of the files, which is removed at the end."""
    rig = rig.model_copy(update={"folder": folder})
    in_files = {name for name, _ in files_of(rig)}
    others = [name for name in rig.odometries if name not in in_files]
    if others:
        raise LogError(
            f"{folder} has no MCAP file, and {rig.source.place(('sensors', others[0], 'odometry'))} is of a log; write "
            "odometry: {file: NAME} for a file of poses in this folder"
        )
    name = f"{folder.resolve().name}{RECORDED_LOG}"
    with output_folder(out, name, replace=replace) as output:
        recorded = output.path / name
        output.begin()
        try:
            with LogWriter(recorded) as log:
                write_files(log, None, rig)
            return _stages(
                [recorded], rig, output.path, is_raw=True, is_cleaned=False, anyway=anyway, progress=progress
            )
        finally:
            recorded.unlink(missing_ok=True)


def _stages(
    files: list[Path],
    rig: Rig | None,
    out: Path,
    *,
    is_raw: bool,
    is_cleaned: bool,
    anyway: bool,
    progress: Progress | None,
) -> OdometrySolved:
    if is_raw:
        assert rig is not None
        detect_log(list(files), rig, out / DETECTED_LOG, progress=progress)
        files = [out / DETECTED_LOG]
    if not is_cleaned:
        clean_log(files[0], out / CLEAN_LOG, rig, images="leave_out", progress=progress)
        files = [out / CLEAN_LOG]
    solved = solve_odometries_into(files[0], rig, out, progress=progress)
    export_odometries(out / CLEAN_LOG, out, anyway=anyway, progress=progress)
    return solved


def export_odometries(
    solved_path: str | Path, out: str | Path, *, anyway: bool = False, progress: Progress | None = None
) -> list[Path]:
    """Write the frames for other programs from a solved log of odometries; none of poses that are not to be used."""
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
