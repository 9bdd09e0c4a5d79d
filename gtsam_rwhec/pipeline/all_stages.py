"""All stages, one after the other: from a log and a rig file to a folder with the calibration in every form."""

from __future__ import annotations

from pathlib import Path

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.errors import LogError
from gtsam_rwhec.export import export_all
from gtsam_rwhec.export.files import FILES
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.logs import Log, open_log
from gtsam_rwhec.logs.mcap_writer import Images
from gtsam_rwhec.pipeline.changed_rig import changes
from gtsam_rwhec.pipeline.cleaning_stage import clean_log
from gtsam_rwhec.pipeline.detection_stage import detect_log
from gtsam_rwhec.pipeline.folder_log import check_is_no_other_folder, is_folder_of_images, write_folder_log
from gtsam_rwhec.pipeline.image_options import check_image_options
from gtsam_rwhec.pipeline.intrinsics import check_intrinsics_files
from gtsam_rwhec.pipeline.log_contract import (
    CLEAN_LOG,
    CLEANING_METADATA,
    DETECTED_LOG,
    PLOTS_FOLDER,
    RECORDED_LOG,
    RESULT_FILE,
    SEEN_SHEET,
    is_from_stage,
)
from gtsam_rwhec.pipeline.log_metadata import read_embedded_rig
from gtsam_rwhec.pipeline.output_paths import check_is_not_read, made_folder, made_output_folder
from gtsam_rwhec.pipeline.samples_log import is_file_of_samples, write_samples_log
from gtsam_rwhec.pipeline.solution_frames import frames_of
from gtsam_rwhec.pipeline.solution_plots import plot_all
from gtsam_rwhec.pipeline.solved_log import read_solved, write_solved
from gtsam_rwhec.pipeline.solving_stage import Calibrated, solve_log
from gtsam_rwhec.results.written_result import write_calibration
from gtsam_rwhec.rig import Rig

#: Names of all that `calibrate_log` leaves in its folder.
OUTPUTS = (CLEAN_LOG, RESULT_FILE, *FILES, SEEN_SHEET, PLOTS_FOLDER)


@one_blas_thread()
def calibrate_log(
    log_path: str | Path | list[str | Path],
    rig: Rig | None,
    out: str | Path,
    *,
    images: Images = "leave_out",
    workers: int | None = None,
    anyway: bool = False,
    progress: Progress | None = None,
) -> Calibrated:
    """Detect, clean, solve and export: from a log and a rig file to a folder with the calibration.

    The folder gets ``clean.mcap``, ``result.json``, ``static_tf.launch.py``, ``tf.yaml``, ``rig.urdf.xacro``,
    ``camchain.yaml``, ``seen.png`` (a contact sheet of the images) and ``plots/``. During the work it has a
    ``detected.mcap`` too. To go on after an interruption, give ``detected.mcap`` as the log. For a log that a stage
    wrote, only the stages after it run. A cleaned log is cleaned again if the settings for cleaning in `rig` differ
    from those that the log was cleaned with.

    Parameters
    ----------
    log_path
        As for ``open_log``; or, for a rig file with poses in files (``frames``), a folder of images, from which its
        paths then start, or a file of samples of a hand-eye tool.
    rig : Rig or None
        None: the rig file embedded in a log that a stage wrote.
    out
        The folder; it is made if it does not exist.
    images : "copy" or "leave_out"
        Whether ``clean.mcap`` has the images too.
    workers : int, optional
        Threads, and for long logs processes, for detection; by default one for each core.
    anyway : bool
        As for `export_solved`.
    progress : callable, optional

    Raises
    ------
    OptionError
        `workers` is given, and no images will be searched; or ``images="copy"``, and the log has none.
    RwhecError
        As each stage does.
    """
    detected, clean = Path(out) / DETECTED_LOG, Path(out) / CLEAN_LOG
    check_is_no_other_folder(log_path, rig)
    if rig is not None and (is_folder_of_images(log_path, rig) or is_file_of_samples(log_path, rig)):
        return _calibrate_files(
            Path(str(log_path)), rig, out, images=images, workers=workers, anyway=anyway, progress=progress
        )
    with open_log(log_path) as log:
        source = log.files[0].path
        is_raw = not is_from_stage(log)
        if is_raw:
            if rig is None:
                raise LogError(f"{source}: a raw log needs a rig file (--rig); gtsam-rwhec init LOG makes a first one")
            check_is_not_read(log, detected)
            check_is_not_read(log, clean)
        else:
            _check_is_alone(log)
        check_image_options(log, rig if is_raw else None, images=images, workers=workers)
        is_cleaned = CLEANING_METADATA in log.metadata() and (
            rig is None or not changes(read_embedded_rig(log), rig).cleaning
        )
    out = made_output_folder(out)
    if is_raw:
        assert rig is not None
        detect_log(log_path, rig, detected, images=images, workers=workers, sheet=out / SEEN_SHEET, progress=progress)
        source = detected
    if not is_cleaned:
        clean_log(source, clean, rig, images=images, progress=progress)
        source = clean
    calibrated = solve_into(source, rig, out, images=images, progress=progress)
    export_solved(out / CLEAN_LOG, out, anyway=anyway, progress=progress)
    if is_raw:
        detected.unlink(missing_ok=True)  # clean.mcap has all that was in it
    return calibrated


def _calibrate_files(
    source: Path,
    rig: Rig,
    out: str | Path,
    *,
    images: Images,
    workers: int | None,
    anyway: bool,
    progress: Progress | None,
) -> Calibrated:
    """As `calibrate_log`, by way of a log of a folder's images or of samples, which is removed at the end."""
    has_images = source.is_dir()
    if has_images:
        rig = rig.model_copy(update={"folder": source})
    check_intrinsics_files(rig)  # before anything is copied
    made = made_output_folder(out)
    recorded = made / f"{source.resolve().name}{RECORDED_LOG}"
    try:
        if has_images:
            write_folder_log(source, rig, recorded, progress=progress)
        else:
            (progress or silent)(write_samples_log(source, rig, recorded))
        return calibrate_log(recorded, rig, made, images=images, workers=workers, anyway=anyway, progress=progress)
    finally:
        recorded.unlink(missing_ok=True)
        if not any(made.iterdir()):
            made.rmdir()


def _check_is_alone(log: Log) -> None:
    """Refuse a log of a stage that is one of several files."""
    if len(log.files) > 1:
        raise LogError(
            f"{', '.join(str(file.path) for file in log.files[:10])}: a stage wrote at least one of these files; give "
            "that file alone, or only raw logs"
        )


def solve_into(
    clean_path: str | Path,
    rig: Rig | None,
    out: str | Path,
    *,
    images: Images = "copy",
    progress: Progress | None = None,
) -> Calibrated:
    """Solve from a cleaned log; write ``result.json``, and ``clean.mcap`` with the solution, into a folder.

    Raises
    ------
    RwhecError
        As `solve_log` does.
    """
    out = made_output_folder(out)
    calibrated = solve_log(clean_path, rig, progress=progress)
    write_calibration(calibrated.calibration, out / RESULT_FILE, calibrated.log)
    write_solved(clean_path, calibrated, out / CLEAN_LOG, images=images)
    return calibrated


@one_blas_thread()
def export_solved(
    solved_path: str | Path, out: str | Path, *, anyway: bool = False, progress: Progress | None = None
) -> list[Path]:
    """Write the files for other programs, and plots, from a solved log into a folder; return their paths.

    Poses that are not to be used get plots only, and no files for other programs: those of an earlier calibration in
    this folder are removed.

    Parameters
    ----------
    solved_path
        The log that ``solve_into`` wrote.
    out
        The folder; it is made if it does not exist.
    anyway : bool
        Whether to write the files of poses that are not to be used too, each with the reason as a comment in its head.
    progress : callable, optional

    Raises
    ------
    LogError
        The log has no solution.
    FileFormatError
        A file cannot be written.
    """
    out = made_folder(out)
    tell = progress or silent
    tell("exporting")
    solved = read_solved(solved_path)
    written = []
    if solved.judgement.verdict is Verdict.DO_NOT_USE and not anyway:
        for name in FILES:
            (out / name).unlink(missing_ok=True)
    else:
        written = export_all(frames_of(solved), out)
    tell("plotting")
    return written + plot_all(solved, solved_path, made_folder(out / PLOTS_FOLDER))
