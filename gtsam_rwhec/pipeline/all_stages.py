"""All stages in a row: from a log and a rig file to a folder with everything that people take away."""

from __future__ import annotations

from pathlib import Path

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.export import export_all
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.logs.mcap_writer import Images
from gtsam_rwhec.pipeline.changed_rig import changes
from gtsam_rwhec.pipeline.cleaning_stage import clean_log
from gtsam_rwhec.pipeline.detection_stage import detect_log
from gtsam_rwhec.pipeline.log_metadata import CLEANING, DETECTION, read_embedded_rig
from gtsam_rwhec.pipeline.solution_frames import frames_of
from gtsam_rwhec.pipeline.solution_plots import plot_all
from gtsam_rwhec.pipeline.solved_log import read_solved, write_solved
from gtsam_rwhec.pipeline.solving_stage import Calibrated, solve_log
from gtsam_rwhec.pipeline.stage_output import check_not_onto, check_writable
from gtsam_rwhec.results.refined_file import write_refined
from gtsam_rwhec.rig import Rig

DETECTED, CLEAN, RESULT, PLOTS = "detected.mcap", "clean.mcap", "result.json", "plots"


def calibrate_log(
    log_path: str | Path | list[str | Path],
    rig: Rig | None,
    out: str | Path,
    *,
    images: Images = "leave_out",
    workers: int | None = None,
    progress: Progress | None = None,
) -> Calibrated:
    """Detect, clean, solve and export.

    Writes ``clean.mcap``, ``result.json``, ``static_tf.launch.py``, ``tf.yaml``, ``rig.urdf.xacro``, ``camchain.yaml``
    and ``plots/`` into a folder. While it works there is a ``detected.mcap``, from which an interrupted run goes on:
    give that as the log. A log that a stage of this library wrote is taken up where that stage ended; or cleaned anew,
    where `rig` has other settings for that than the log was cleaned with.

    Parameters
    ----------
    log_path
        As for ``open_log``.
    rig : Rig or None
        None: the one embedded in a log that a stage wrote.
    out
        The folder; made if it is not there.
    images : "copy" or "leave_out"
        Whether ``clean.mcap`` has the images too.
    workers : int, optional
        Threads for detection; left out, one for each core.
    progress : callable, optional

    Raises
    ------
    RwhecError
        As each stage does.
    """
    detected, clean = Path(out) / DETECTED, Path(out) / CLEAN
    with open_log(log_path) as log:
        source = log.files[0].path
        stages = set(log.metadata()) & {DETECTION, CLEANING}
        if stages and len(log.files) > 1:
            raise LogError(
                f"{', '.join(str(file.path) for file in log.files[:10])}: of several files one or more were written by "
                "a stage; give that one alone, or the raw ones"
            )
        is_cleaned = CLEANING in stages and (rig is None or not changes(read_embedded_rig(log), rig).cleaning)
        if not stages:
            if rig is None:
                raise LogError(f"{source}: a raw log needs a rig file (--rig); gtsam-rwhec init LOG makes a first one")
            check_not_onto(log, detected)
            check_not_onto(log, clean)
    out = made_folder(out)
    if not stages:
        assert rig is not None
        detect_log(log_path, rig, detected, images=images, workers=workers, progress=progress)
        source = detected
    if not is_cleaned:
        clean_log(source, clean, rig, images=images, progress=progress)
        source = clean
    calibrated = solve_into(source, rig, out, images=images, progress=progress)
    export_solved(out / CLEAN, out, progress=progress)
    if not stages:
        detected.unlink(missing_ok=True)  # all of it is in clean.mcap
    return calibrated


def solve_into(
    clean_path: str | Path,
    rig: Rig | None,
    out: str | Path,
    *,
    images: Images = "copy",
    progress: Progress | None = None,
) -> Calibrated:
    """Solve from a cleaned log; write ``result.json``, and ``clean.mcap`` with the solution in it, into a folder.

    Raises
    ------
    RwhecError
        As `solve_log` does.
    """
    out = made_folder(out)
    calibrated = solve_log(clean_path, rig, progress=progress)
    write_refined(calibrated.refined, out / RESULT, calibrated.log)
    write_solved(clean_path, calibrated, out / CLEAN, images=images)
    return calibrated


def export_solved(solved_path: str | Path, out: str | Path, *, progress: Progress | None = None) -> list[Path]:
    """Write what others read, and plots, from a solved log into a folder; the files' paths.

    Raises
    ------
    LogError
        The log has no solution in it.
    FileFormatError
        A file cannot be written.
    """
    out = made_folder(out)
    if progress is not None:
        progress("exporting")
    solved = read_solved(solved_path)
    written = export_all(frames_of(solved), out)
    if progress is not None:
        progress("plotting")
    return written + plot_all(solved, solved_path, made_folder(out / PLOTS))


def made_folder(path: str | Path) -> Path:
    """The folder, made if it is not there.

    Raises
    ------
    LogError
        It cannot be made, or not be written into.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogError(f"{path} cannot be made a folder: {error.strerror}.") from error
    check_writable(path / CLEAN)
    return path
