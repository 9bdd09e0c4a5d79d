"""The first stage: from images, clouds, or a driver's detections, to a log with the poses of the targets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import LogError, OptionError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.logs import CloudRecord, Log, PoseRecord, open_log
from gtsam_rwhec.logs.mcap_writer import Images
from gtsam_rwhec.results.log_history import DetectionReport
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.rig.odometry_sections import odometry_topic
from gtsam_rwhec.runs.carrier_motion import read_carrier_motion
from gtsam_rwhec.runs.image_pictures import draw_images, has_images, write_contact_sheet
from gtsam_rwhec.runs.kept_detections import KeptDetections, KeptOfLog
from gtsam_rwhec.runs.odometry_motions import records_of_files
from gtsam_rwhec.runs.output_folder import check_is_not_read, check_writable
from gtsam_rwhec.runs.recorded_logs import check_is_no_other_folder, is_folder_of_images, write_folder_log
from gtsam_rwhec.runs.run_log import RECORDED_LOG, LogMetadata, RunLog, image_names, write_run_log
from gtsam_rwhec.runs.sensor_detections import check_usable, detect_in_log, detection_report, read_driver_detections
from gtsam_rwhec.runs.sensor_intrinsics import (
    estimate_intrinsics,
    in_words,
    read_intrinsics,
    refuse_not_estimated,
    with_shared,
)
from gtsam_rwhec.runs.topics_of_rig import check_topics
from gtsam_rwhec.runs.unread_targets import blurred_images, likely_causes, no_detections

if TYPE_CHECKING:
    from gtsam_rwhec.clouds.object_views import SeenObject  # needs an extra that images do without


def check_image_options(
    log: Log, rig: Rig | None, *, images: Images, workers: int | None, draw: str | Path | None = None
) -> None:
    """Raise `OptionError` for `workers` and `draw` without images to search, and for images to copy without any.

    `rig` is the rig file for detection; None if the log already has detections.
    """
    path = log.files[0].path
    given = f"workers={workers} (--workers)" if workers is not None else f"{draw} (--draw)" if draw is not None else ""
    if given and rig is None:
        raise OptionError(
            f"{given} counts only in detection, and the detections are already in {path}: leave the option out, or "
            "give the raw log"
        )
    if given and rig is not None and not has_images(rig):
        raise OptionError(
            f"{given} counts only for images, and no sensor of the rig file has images: leave the option out"
        )
    if images == "copy" and not any(topic.has_images or topic.has_clouds for topic in log.topics()):
        other = "the raw log, if it has images" if rig is None else "a log with images"
        raise OptionError(
            f'images="copy" (--images): {path} has no images or clouds to copy. Leave the option out, or give {other}'
        )


@one_blas_thread()
def detect_log(
    log_path: str | Path | list[str | Path],
    rig: Rig,
    out_path: str | Path,
    *,
    images: Images = "leave_out",
    workers: int | None = None,
    sheet: str | Path | None = None,
    draw: str | Path | None = None,
    progress: Progress | None = None,
) -> DetectionReport:
    """Detect the targets, and write a log with the detections.

    Raw messages are copied as they are (images on request). The stage adds the topics
    ``/calibration/<sensor>/detections``, ``.../annotations`` and ``.../poses``, and metadata: the rig file, the
    intrinsics and a report.

    Parameters
    ----------
    log_path
        As for ``open_log``.
    rig : Rig
    out_path
        The MCAP file to write.
    images : "copy" or "leave_out"
        Whether the written log has the images too.
    workers : int, optional
        Threads, and for long logs processes; by default one for each core.
    sheet, draw : path, optional
        A PNG file for a contact sheet of the images, and a folder for a picture of each: written also where no target
        was detected. A sheet needs images; without any it is not written.
    progress : callable, optional

    Raises
    ------
    OptionError
        `workers` or `draw` is given, and no sensor has images; or ``images="copy"``, and the log has none.
    CameraError
        Intrinsics are to be estimated and the images determine none; or stated intrinsics cannot be used.
    LogError, StampError, TransformError, FrameError
        The log lacks a topic of the rig file or the carriers' poses, or no target was detected.
    """
    check_writable(out_path)
    with open_log(log_path) as log:
        check_is_not_read(log, out_path)
        check_image_options(log, rig, images=images, workers=workers, draw=draw)
        found = detected(log, rig, workers=workers, sheet=sheet, draw=draw, progress=progress)
        (progress or silent)("writing detections")
        write_run_log(found, out_path, images)
    return found.stages.detection


def detected(
    log: Log,
    rig: Rig,
    *,
    workers: int | None = None,
    sheet: str | Path | None = None,
    draw: str | Path | None = None,
    progress: Progress | None = None,
    keep: Callable[[Mapping[str, Camera]], KeptOfLog] | None = None,
    registered: SeenObject | None = None,
) -> RunLog:
    """The log with the detections, as `detect_log` writes it.

    `keep` is called with the cameras before anything is written. It returns what keeps the detections so far.
    `registered` is what `detect_in_clouds` need not do again.
    """
    tell = progress or silent
    check_topics(log, rig)
    cameras = read_intrinsics(log, rig)
    tell("reading the carriers' poses")  # before the images: a log without poses is refused at once
    moving, maps = _motions_made(log, rig, tell)
    motion = read_carrier_motion(log, rig, moving)
    estimated, failed = estimate_intrinsics(log, rig, workers=workers, progress=tell)
    if failed:
        refuse_not_estimated(log, rig, failed, motion, sheet)
    cameras = with_shared(cameras | {sensor: of_sensor.camera for sensor, of_sensor in estimated.items()}, rig)
    kept = None if keep is None else keep(cameras)
    found = detect_in_log(log, rig, cameras, motion, workers=workers, progress=tell, kept=kept)
    for sensor, of_camera in estimated.items():
        found[sensor] = replace(found[sensor], remarks=(in_words(sensor, of_camera), *found[sensor].remarks))
    for sensor, source in rig.sensors.items():
        if source.detections is not None:
            found[sensor] = read_driver_detections(log, rig, sensor, cameras.get(sensor))
    in_clouds = {}
    for sensor in (name for name, source in rig.sensors.items() if source.clouds is not None):
        from gtsam_rwhec.runs.cloud_detections import detect_in_clouds  # needs an extra that images do without

        in_file = kept if isinstance(kept, KeptDetections) else None  # a session in memory has no clouds
        camera = cameras.pop(sensor, None)
        in_clouds[sensor] = detect_in_clouds(
            log, rig, sensor, camera, motion, progress=tell, kept=in_file, registered=registered
        )
    found |= {sensor: of_clouds.seen for sensor, of_clouds in in_clouds.items()}
    report = detection_report(log, rig, found)
    report = report.model_copy(update={"objects": tuple(of_clouds.report for of_clouds in in_clouds.values())})
    has_sheet = False
    if sheet is not None:
        tell("drawing the contact sheet")
        has_sheet = write_contact_sheet(Path(sheet), log, rig, cameras, found)
    if draw is not None:
        draw_images(log, rig, cameras, {sensor: of.records for sensor, of in found.items()}, draw, tell)
    check_usable(log, rig, found, cameras)  # after the pictures: they show what is wrong
    tell("looking for what hides targets")
    blurred, likely = blurred_images(log, rig, cameras, found), likely_causes(log, rig, cameras, found)
    report = report.model_copy(update={"likely": likely, "blurred": blurred})
    if rig.sensors and not any(track.used for track in report.tracks):
        report = report.model_copy(update={"likely": (*(f"{words}." for words in blurred), *likely)})
        shown = f" {sheet} shows some of the images." if has_sheet else ""
        raise LogError(f"{no_detections(log, report)}{shown}")
    stages = LogMetadata(rig, cameras, report, image_names=image_names(log))
    records = {sensor: of.records for sensor, of in found.items()}
    others: list[Sequence[CloudRecord] | Sequence[PoseRecord]] = [of_clouds.clouds for of_clouds in in_clouds.values()]
    others += [*moving.values(), *maps]
    return RunLog.with_detections(log, stages, records, others)


def _motions_made(log: Log, rig: Rig, tell: Progress) -> tuple[dict[str, list[PoseRecord]], list[list[CloudRecord]]]:
    """The poses of sensors whose odometry is in a file or in their clouds, by topic, and maps of clouds; what the log
    has is there."""
    there = {topic.name for topic in log.topics()}
    made = {topic: records for topic, records in records_of_files(rig).items() if topic not in there}
    maps = []
    for sensor in (name for name, each in rig.odometries.items() if each.odometry.clouds is not None):
        if odometry_topic(sensor) not in there:
            from gtsam_rwhec.runs.cloud_detections import motion_by_clouds

            made[odometry_topic(sensor)], of_sensor = motion_by_clouds(log, rig, sensor, tell)
            maps += [of_sensor] if rig.is_of_odometries else []  # beside cameras nothing reads them
    return made, maps


def sheet_beside(out_path: str | Path) -> Path:
    """The contact sheet beside a log of detections: ``detected.seen.png`` for ``detected.mcap``."""
    return Path(out_path).with_suffix(".seen.png")


def detect_source(
    source: str | Path,
    rig: Rig,
    out_path: str | Path,
    *,
    images: Images = "leave_out",
    workers: int | None = None,
    draw: str | Path | None = None,
    progress: Progress | None = None,
) -> DetectionReport:
    """As `detect_log`, for a log or for a folder of images, with a contact sheet beside the written log.

    `source` may also be a folder of images, for a rig file with poses in files (``frames``), whose paths then start
    from this folder. The sheet (`sheet_beside`) is written if there are images, also if no target was detected. Raises
    as `detect_log` and `write_folder_log` do.
    """
    sheet = sheet_beside(out_path)
    check_writable(out_path)
    check_writable(sheet)
    sheet.unlink(missing_ok=True)  # one of an earlier run would be taken for this run's
    check_is_no_other_folder(source, rig)
    how: dict[str, Any] = {"images": images, "workers": workers, "sheet": sheet, "draw": draw, "progress": progress}
    if not is_folder_of_images(source, rig):
        return detect_log(source, rig, out_path, **how)
    folder = Path(source)
    rig = rig.model_copy(update={"folder": folder})
    with TemporaryDirectory(prefix=".images-", dir=Path(out_path).resolve().parent) as temporary:
        recorded = Path(temporary) / f"{folder.resolve().name}{RECORDED_LOG}"
        write_folder_log(folder, rig, recorded, progress=progress)
        return detect_log(recorded, rig, out_path, **how)
