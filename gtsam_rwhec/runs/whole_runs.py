"""All stages, one after the other: from a log and a rig file to a folder with the calibration in every form."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from dataclasses import replace as replaced
from pathlib import Path
from typing import TYPE_CHECKING

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.errors import LogError, RigError
from gtsam_rwhec.files.progress import Progress, Remark, silent
from gtsam_rwhec.files.terminal_text import shown_path
from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.logs import Log, LogWriter, PoseRecord, open_log
from gtsam_rwhec.logs.mcap_writer import Images
from gtsam_rwhec.results.result_file import parse_result, result_json
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.rig.exported_files import FILES, FOLDERS, export_all
from gtsam_rwhec.rig.folder_contents import cloud_folders, is_folder_without_logs
from gtsam_rwhec.rig.rig_file import parse_rig, todo_lines
from gtsam_rwhec.runs.changed_rig import changes
from gtsam_rwhec.runs.cleaning_stage import cleaned
from gtsam_rwhec.runs.detection_stage import check_image_options, detected
from gtsam_rwhec.runs.image_pictures import has_images
from gtsam_rwhec.runs.kept_detections import inputs_of
from gtsam_rwhec.runs.log_evidence import Pictures, frames_of, write_report
from gtsam_rwhec.runs.measured_pairs import read_pairs, write_pairs
from gtsam_rwhec.runs.output_folder import (
    WRITTEN,
    OutputFolder,
    check_is_not_read,
    list_written,
    log_name,
    made_folder,
    made_output_folder,
    output_folder,
    remove_unchanged,
)
from gtsam_rwhec.runs.recorded_logs import (
    check_is_no_other_folder,
    is_file_of_samples,
    is_folder_of_images,
    write_folder_log,
    write_samples_log,
)
from gtsam_rwhec.runs.run_log import (
    CALIBRATION_LOG,
    CERTIFICATE_METADATA,
    CLEANING_METADATA,
    RECORDED_LOG,
    RESULT_FILE,
    SEEN_SHEET,
    SOLUTION_TOPIC,
    LogMetadata,
    image_names,
    is_from_stage,
    read_cameras,
    read_embedded_rig,
    read_metadata,
    records_of,
    write_up_to_detection,
)
from gtsam_rwhec.runs.sensor_detections import image_count
from gtsam_rwhec.runs.sensor_intrinsics import check_intrinsics_files
from gtsam_rwhec.runs.solving_stage import Calibrated, Solved, solve_log

if TYPE_CHECKING:
    from gtsam_rwhec.clouds.object_views import SeenObject  # needs an extra that images do without

#: Names of all that `calibrate_log` leaves in its folder, beside the list of them.
OUTPUTS = tuple(dict.fromkeys([*(name.partition("/")[0] for name in WRITTEN), *FOLDERS]))


@dataclass(frozen=True)
class _Choices:
    """The options of `calibrate_log` that are the same for all kinds of input."""

    images: Images
    workers: int | None
    anyway: bool
    report_images: bool
    #: Clouds of the input that were registered already.
    registered: SeenObject | None = None


@one_blas_thread()
def calibrate_log(
    log_path: str | Path | list[str | Path],
    rig: Rig | None,
    out: str | Path,
    *,
    images: Images = "leave_out",
    workers: int | None = None,
    anyway: bool = False,
    replace: bool = True,
    report_images: bool = True,
    progress: Progress | None = None,
) -> Calibrated:
    """Detect, clean, solve and export: from a log and a rig file to a folder with the calibration.

    The folder gets ``calibration.mcap``, ``result.json``, ``static_tf.launch.py``, ``tf.yaml``, ``rig.urdf.xacro``,
    ``camchain.yaml``, ``cameras.opencv.yaml``, ``cameras.txt`` (COLMAP's), ``camera_info/`` (ROS's, one file a camera),
    ``seen.png`` (a contact sheet of the images), and ``report.html`` with its ``evidence.json``. For a log
    that a stage wrote, only the stages after it run. A cleaned log is cleaned again if the settings for cleaning in
    `rig` differ from those that the log was cleaned with.

    During the work the folder has the detections so far. A run that was interrupted, or killed, goes on from them when
    it is started again: what it finds is the same as without the interruption. Images, sensors, targets and options of
    detection must be the same; the rest of the rig file may change.

    Parameters
    ----------
    log_path
        As for ``open_log``; or, for a rig file with poses in files (``frames``), a folder of images, from which its
        paths then start, or a file of samples of a hand-eye tool.
    rig : Rig or None
        None: the rig file embedded in a log that a stage wrote; or, of a folder of clouds with poses beside them, the
        one that ``gtsam-rwhec init`` proposes, if it leaves nothing to a person.
    out
        The folder; it is made if it does not exist.
    images : "copy" or "leave_out"
        Whether ``calibration.mcap`` has the images too.
    workers : int, optional
        Threads, and for long logs processes, for detection; by default one for each core.
    anyway : bool
        As for `export_solved`.
    replace : bool
        Whether a finished calibration in the folder, or an unfinished run of other inputs, is replaced: by default yes,
        so that a script can be run again. False refuses both, as the command does without ``--force``. In either case
        an unfinished run of the same inputs is continued, and only files that a calibration wrote are replaced: a
        folder with other files, and without a calibration, is refused.
    report_images : bool
        Whether ``report.html`` shows images. They may be confidential, as the contact sheet ``seen.png`` then is.
    progress : callable, optional

    Raises
    ------
    OptionError
        `workers` is given, and no images will be searched; or ``images="copy"``, and the log has none.
    LogError
        The folder is not free for this calibration; nothing was changed.
    RwhecError
        As each stage does.
    """
    if rig is not None and rig.is_of_odometries:
        raise LogError(
            f"{rig.source.place(('sensors',))}: no sensor sees a target, and each knows only its own motion; calibrate "
            "with rw.odometry.calibrate_odometry_log"
        )
    check_is_no_other_folder(log_path, rig)
    choices = _Choices(images, workers, anyway, report_images)
    folder = Path(log_path) if rig is None and isinstance(log_path, str | Path) else None
    if folder is not None and is_folder_without_logs(folder) and cloud_folders(folder):
        rig, registered = _proposed(folder, progress or silent)
        choices = replaced(choices, registered=registered)
    if rig is not None and (is_folder_of_images(log_path, rig) or is_file_of_samples(log_path, rig)):
        source = Path(str(log_path))
        return _calibrate_files(source, rig, out, choices, replace=replace, progress=progress)
    with open_log(log_path) as log:
        sources = checked_sources(log, rig, out)
        check_image_options(log, None if is_from_stage(log) else rig, images=images, workers=workers)
        files = [file.path for file in log.files]
        with output_folder(out, log_name(sources), replace=replace, sources=files) as output:
            return _stages(log, rig, output, choices, progress=progress)


def checked_sources(log: Log, rig: Rig | None, out: str | Path) -> tuple[str, ...]:
    """The names of the recorded files of a log; a `LogError` where it cannot be calibrated into a folder."""
    files = [file.path for file in log.files]
    if not is_from_stage(log):
        if rig is None:
            raise LogError(f"{files[0]}: a raw log needs a rig file (--rig); gtsam-rwhec init LOG makes a first one")
        check_is_not_read(log, Path(out) / CALIBRATION_LOG)
        return tuple(file.name for file in files)
    if len(files) > 1:
        raise LogError(
            f"{', '.join(map(str, files[:10]))}: a stage wrote at least one of these files; give that file alone, or "
            "only raw logs"
        )
    return read_metadata(log).detection.sources


@contextmanager
def log_of_files(source: Path, out: str | Path, *, replace: bool) -> Iterator[tuple[OutputFolder, Path]]:
    """The folder of a calibration, and where a log of files is written in it, which is removed at the end."""
    name = f"{source.resolve().name}{RECORDED_LOG}"
    with output_folder(out, name, replace=replace) as output:
        recorded = output.path / name
        output.begin()
        try:
            yield output, recorded
        finally:
            recorded.unlink(missing_ok=True)


def _proposed(folder: Path, tell: Progress) -> tuple[Rig, SeenObject | None]:
    """The rig file that is proposed for a folder, where nothing in it is left to a person, and what was registered."""
    from gtsam_rwhec.rig.cloud_proposal import propose_cloud_rig  # needs an extra that images do without

    proposal = propose_cloud_rig(folder, cloud_folders(folder), tell)
    for note in proposal.notes:
        tell(Remark(note))
    if todo_lines(proposal.text):
        raise RigError(
            f"{shown_path(folder)}: the folder does not tell how its poses are to be read. gtsam-rwhec init "
            f"{shown_path(folder)} -o rig.yaml writes a rig file; complete it, and give it with --rig"
        )
    return parse_rig(proposal.text, f"the rig file that was made of {folder}", folder), proposal.registered


def _calibrate_files(
    source: Path, rig: Rig, out: str | Path, choices: _Choices, *, replace: bool, progress: Progress | None
) -> Calibrated:
    """As `calibrate_log`, for a folder of images or a file of samples: a log is made of it, and removed at the end."""
    folder = source if source.is_dir() else None
    if folder is not None:
        rig = rig.model_copy(update={"folder": folder})
    check_intrinsics_files(rig)  # before anything is copied
    with log_of_files(source, out, replace=replace) as (output, recorded):
        if folder is not None:
            write_folder_log(folder, rig, recorded, progress=progress)
        else:
            (progress or silent)(write_samples_log(source, rig, recorded))
        with open_log(recorded) as log:
            return _stages(log, rig, output, choices, folder, progress=progress)


def _stages(
    log: Log,
    rig: Rig | None,
    output: OutputFolder,
    choices: _Choices,
    folder: Path | None = None,
    *,
    progress: Progress | None,
) -> Calibrated:
    """The stages that a log still needs, and what is written; `folder` is the one whose images the log has."""
    out, sources = output.path, [file.path for file in log.files]
    if is_from_stage(log):
        output.begin()
        found, sheet = log, sources[0].parent / SEEN_SHEET
    else:
        assert rig is not None
        sheet = out / SEEN_SHEET
        found = detected(
            log,
            rig,
            workers=choices.workers,
            sheet=sheet,
            progress=progress,
            keep=lambda cameras: output.kept_detections(inputs_of(log, rig, cameras, folder), image_count(log, rig)),
            registered=choices.registered,
        )
        if folder is not None:
            sources = sorted(path for path in folder.rglob("*") if path.is_file())
    if not is_cleaned(found, rig):
        found = cleaned(found, rig, progress)
    calibrated = solve_log(found, rig, progress=progress)
    result = _write_solution(found, calibrated, out, choices.images)
    _export(calibrated, out, anyway=choices.anyway, progress=progress)
    # A log of a driver's detections has no sheet; one in the folder is of an earlier calibration.
    pictures = Pictures(log, sheet if has_images(calibrated.rig) else None, choices.report_images)
    write_report(calibrated, found, out, sources, pictures, result, progress)
    return calibrated


def is_cleaned(log: Log, rig: Rig | None) -> bool:
    """Whether a log was cleaned as the rig file says."""
    return CLEANING_METADATA in log.metadata() and (rig is None or not changes(read_embedded_rig(log), rig).cleaning)


def solve_into(
    clean_path: str | Path,
    rig: Rig | None,
    out: str | Path,
    *,
    images: Images = "copy",
    progress: Progress | None = None,
) -> Calibrated:
    """Solve from a cleaned log; write ``result.json``, and ``calibration.mcap`` with the solution, into a folder.

    Raises as `solve_log` does.
    """
    out = made_output_folder(out)
    with open_log(clean_path) as log:
        calibrated = solve_log(log, rig, progress=progress)
        _write_solution(log, calibrated, out, images)
    list_written(out, calibrated.log.detection.sources, [out / RESULT_FILE, out / CALIBRATION_LOG])
    return calibrated


def _write_solution(log: Log, calibrated: Calibrated, out: Path, images: Images) -> bytes:
    """Write the result, and the log with all that was found; return the result's content."""
    content = result_json(calibrated.calibration, calibrated.log, out / RESULT_FILE)
    write_atomically(out / RESULT_FILE, content)
    write_solved(log, calibrated, out / CALIBRATION_LOG, result=content, images=images)
    return content


@one_blas_thread()
def export_solved(
    solved_path: str | Path, out: str | Path, *, anyway: bool = False, progress: Progress | None = None
) -> list[Path]:
    """Write the files for other programs from a solved log into a folder; return their paths.

    For poses that are not to be used no files are written, and those of an earlier calibration in this folder are
    removed.

    `solved_path` is the log that ``solve_into`` wrote; the folder is made if it does not exist. With `anyway` the files
    of poses that are not to be used are written too, each with the reason as a comment in its head.

    Raises
    ------
    LogError
        The log has no solution.
    FileFormatError
        A file cannot be written.
    """
    out = made_folder(out)
    solved = read_solved(solved_path)
    written = _export(solved, out, anyway=anyway, progress=progress)
    list_written(out, solved.log.detection.sources, written)
    return written


def _export(solved: Solved, out: Path, *, anyway: bool, progress: Progress | None) -> list[Path]:
    """The files for other programs."""
    (progress or silent)("exporting")
    written = []
    if solved.judgement.verdict is Verdict.DO_NOT_USE and not anyway:
        for name in FILES:
            (out / name).unlink(missing_ok=True)
    else:
        written = export_all(frames_of(solved), out)
    remove_unchanged(out, FOLDERS, keep=written)
    return written


#: A calibrated frame's name gets this ending if the raw log has transforms of a frame with the same name.
CALIBRATED = "_calibrated"


def write_solved(log: Log, calibrated: Calibrated, out_path: str | Path, *, result: bytes, images: Images) -> None:
    """Write a log with its solution: frames as static transforms, certificate as metadata, result attached.

    `log` is the cleaned log, whose file may be `out_path`, the MCAP file to write; `images` says whether its images are
    written too. Raises `LogError` if the file cannot be written.
    """
    rig, refined, pairs = calibrated.rig, calibrated.refined, calibrated.pairs.values()
    with LogWriter(out_path) as out:
        write_up_to_detection(log, out, images)
        write_pairs(out, pairs)
        first_ns = min(int(measured.stamps_ns.min()) for measured in pairs)
        raw = [t.name for t in log.topics() if t.is_tf and not t.unreadable and t.name != SOLUTION_TOPIC]
        taken = {record.child for record in records_of(log, raw, PoseRecord)}
        frames = [(rig.carriers.sensors, rig.frame_of(name), pose.matrix()) for name, pose in refined.Y.items()]
        frames += [(rig.carriers.targets, name, pose.matrix()) for name, pose in refined.X.items()]
        # A calibrated frame gets a name of its own if the raw log has one of its name.
        named = [(parent, child + CALIBRATED if child in taken else child, T) for parent, child, T in frames]
        out.transforms(SOLUTION_TOPIC, first_ns, named)
        history = calibrated.log
        LogMetadata(rig, calibrated.cameras, history.detection, history.cleaning, image_names(log)).write(out)
        certificate = refined.solution.certificate
        out.metadata(
            CERTIFICATE_METADATA,
            {
                "status": certificate.status.value,
                "objective": str(certificate.objective),
                "cost": repr(certificate.cost),
                "lower_bound": repr(certificate.lower_bound),
                "relative_gap": repr(certificate.relative_gap),
                "free_directions": "; ".join(map(str, refined.free_directions)),
            },
        )
        out.attachment(RESULT_FILE, "application/json", result, first_ns)


def read_solved(path: str | Path) -> Solved:
    """Read the log that `write_solved` wrote.

    Raises
    ------
    LogError
        The log has no result in it, or a result that is not of its measurements.
    """
    with open_log(path) as log:
        content = log.attachment(RESULT_FILE)
        if content is None:
            raise LogError(f"{path} has no {RESULT_FILE} attached: gtsam-rwhec solve or calibrate did not write it")
        result = parse_result(content, f"{path}, attachment {RESULT_FILE}")
        if result.log is None or result.refined is None:
            raise LogError(f"{path}, attachment {RESULT_FILE}: it is not the refined calibration of a log")
        rig = read_embedded_rig(log)
        refined, pairs = result.refined, read_pairs(log, rig)
    strangers = [*(set(refined.X) - set(rig.targets)), *(set(refined.Y) - set(rig.all_sensors))]
    if strangers or not pairs:
        why = f"frames that its rig file lacks: {', '.join(sorted(strangers)[:10])}" if strangers else "no measurements"
        raise LogError(f"{path} has a {RESULT_FILE}, and {why}: they are not of one calibration")
    return Solved(refined, result.solution, pairs, result.log, read_cameras(log), rig, result.judgement)
