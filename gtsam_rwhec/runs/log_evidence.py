"""What the report of a log shows beside the result (frames, corners, images, inputs), and the page itself."""

from __future__ import annotations

import shlex
import warnings
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from os.path import commonpath
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.clouds.named_fields import cloud_of_record
from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.detect.images import decode_gray
from gtsam_rwhec.detect.pictures import draw_errors, jpeg_of
from gtsam_rwhec.errors import ImageError, LogError, LogWarning, TargetError
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.logs import CloudRecord, DetectionRecord, ImageRecord, Log
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.report.html_page import write_page
from gtsam_rwhec.report.report_page import report_page
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.results import Evidence, write_evidence
from gtsam_rwhec.results.cloud_evidence import CloudsEvidence, clouds_of
from gtsam_rwhec.results.contribution import contribution_of
from gtsam_rwhec.results.derived import derived_of
from gtsam_rwhec.results.detection_evidence import (
    PIECES,
    RemovedCount,
    SeenEvidence,
    counts_of,
    removed_list,
    span_of,
    tracks_of,
)
from gtsam_rwhec.results.evidence import Inputs, checksum, input_files, versions
from gtsam_rwhec.results.image_errors import (
    RatedView,
    SeenView,
    WorstImage,
    board_of,
    rated_views,
    seen_cameras,
    worst_image,
    worst_views,
)
from gtsam_rwhec.results.linear_model import LinearModel, MeasuredRows
from gtsam_rwhec.results.log_history import RemovalReason
from gtsam_rwhec.results.proof_spectrum import proof_of
from gtsam_rwhec.results.residual_evidence import residuals_of
from gtsam_rwhec.results.result_judgement import shortage
from gtsam_rwhec.results.scene_evidence import scene_of
from gtsam_rwhec.results.weak_poses import weak_directions
from gtsam_rwhec.rig import CameraLink, Rig, RigFrames, rig_text
from gtsam_rwhec.rig.exported_files import copied_texts
from gtsam_rwhec.rig.rig_frames import known_cameras
from gtsam_rwhec.rig.sections import link_of_optical
from gtsam_rwhec.runs.carrier_motion import read_carrier_motion
from gtsam_rwhec.runs.log_corners import LogCorners, with_intrinsics
from gtsam_rwhec.runs.run_log import (
    EVIDENCE_FILE,
    REPORT_FILE,
    RESULT_FILE,
    clouds_topic,
    detections_topic,
    image_name,
    image_names,
    records_of,
)
from gtsam_rwhec.runs.solving_stage import Calibrated, Solved

#: The origin of intrinsics that were estimated before detection and not refined from corners.
BOARDS_ALONE = "estimated from views of boards alone, before the poses; standard deviations are not known"


def frames_of(solved: Solved) -> RigFrames:
    """The calibrated frames, with each sensor's frame name, and its estimated intrinsics if there are any."""
    rig, refined = solved.rig, solved.refined
    missing = [name for name in (*rig.calibrated, *rig.targets) if name not in refined.X and name not in refined.Y]
    frame = {name: rig.frame_of(name) for name in refined.Y}
    cameras, of_corners = known_cameras(solved.cameras, refined.intrinsics)
    origins = origins_before_corners(rig, cameras) | of_corners
    return RigFrames(
        sensor_carrier=rig.carriers.sensors,
        target_carrier=rig.carriers.targets,
        sensors={frame[name]: pose.matrix() for name, pose in refined.Y.items()},
        targets={name: pose.matrix() for name, pose in refined.X.items()},
        cameras={frame[name]: camera for name, camera in cameras.items() if name in frame},
        camera_origins={frame[name]: words for name, words in origins.items() if name in frame},
        time_offsets_s={frame[o.sensor]: o.offset_s for o in solved.log.time_offsets if o.sensor in frame},
        topics={frame[n]: s.images for n, s in rig.sensors.items() if s.images is not None and n in frame},
        links={
            frame[name]: CameraLink(sensor.link.frame, link_of_optical(sensor.link.T_link_optical))
            for name, sensor in rig.sensors.items()
            if sensor.link is not None and name in frame
        },
        warnings=warnings_of(solved),
        left_out={name: shortage(solved.log, name) for name in missing},
    )


def origins_before_corners(rig: Rig, sensors: Iterable[str]) -> dict[str, str]:
    """The origin of intrinsics that detection estimated, by sensor; sensors with stated intrinsics are missing."""
    return {name: BOARDS_ALONE for name in sensors if rig.stated_of(name) == "unknown"}


def warnings_of(solved: Solved) -> tuple[str, ...]:
    """Why some or all frames are not to be used; empty if all may be used."""
    if solved.judgement.verdict is Verdict.USE:
        return ()
    free = sorted({name for each in solved.refined.free_directions for name in each.frames}, key=natural_key)
    return (str(solved.judgement), *([f"Not determined: {', '.join(free)}"] if free else []))


def seen_views(solved: Solved, log: Log) -> dict[str, list[SeenView]]:
    """Corners of detections that are used or left out by robust estimation, with the calibration's predictions.

    By camera; those that were left out are marked as not used.
    """
    path = read_carrier_motion(log, solved.rig).trajectory
    targets = {target.name: target for target in solved.rig.target_list}
    offsets = {offset.sensor: offset.offset_s for offset in solved.log.time_offsets}
    boards = {
        name: board_of(solved.refined, name, targets[name].corners()) for name in solved.refined.X if name in targets
    }
    wanted = ("", RemovalReason.OUTLIER)
    is_used = {
        (pair, stamp): not reason
        for pair, measured in solved.pairs.items()
        for stamp, reason in zip(measured.stamps_ns.tolist(), measured.reasons, strict=True)
        if reason in wanted and pair.target in solved.refined.X
    }
    seen: dict[str, list[SeenView]] = defaultdict(list)
    for sensor in solved.cameras:
        if sensor not in solved.refined.Y:
            continue
        records = [
            record
            for record in records_of(log, [detections_topic(sensor)], DetectionRecord)
            if record.corners_px is not None and (Pair(record.id, sensor), record.stamp_ns) in is_used
        ]
        stamps = np.array([record.stamp_ns for record in records], dtype=np.int64)
        A, _ = path.at(stamps + round(1e9 * offsets.get(sensor, 0.0)))
        for record, T in zip(records, np.linalg.inv(solved.refined.Y[sensor].matrix()) @ A, strict=True):
            board, X = boards[record.id], solved.refined.X[record.id].matrix()
            if record.corners_px is None or (record.corner_indices is None and len(record.corners_px) != len(board)):
                continue
            corners = board if record.corner_indices is None else board[list(record.corner_indices)]  # a driver's: all
            used = is_used[Pair(record.id, sensor), record.stamp_ns]
            seen[sensor].append(SeenView.of(record.corners_px, corners, T, X, record.stamp_ns, record.id, is_used=used))
    return dict(seen)


#: Width in pixels of the page's contact sheet, and the most bytes of the sheet and of each picture of an image.
SHEET_WIDTH, SHEET_BYTES, PICTURE_BYTES = 1200, 500_000, 90_000
#: Bytes. If images are not found by their stamps, a log of at most this size is read through for them.
MOST_SEARCHED = 300_000_000
WITHOUT = "the report was made without images."
#: The stages that remove measurements.
DETECTION, CLEANING, ROBUST = "detection", "cleaning", "robust estimation"
_BY_DETECTION = {str(reason) for reason in Rejection}


@dataclass(frozen=True)
class Pictures:
    """Where images are: the log with them, and the contact sheet's file, which may be missing.

    If `may_show` is False, only the images' names are read.
    """

    log: Log
    sheet: Path | None
    may_show: bool = True


def seen_in_log(solved: Solved, log: Log, pictures: Pictures | None) -> SeenEvidence:
    """The evidence of what a cleaned log's sensors saw; without `pictures` it has neither images nor their names."""
    views = seen_views(solved, log)
    found = solved.refined.reprojection
    estimated = {name: one.camera for name, one in solved.refined.intrinsics.items()}
    cameras = {sensor: estimated.get(sensor, solved.cameras[sensor]) for sensor in views}
    of_tracks = solved.log.detection.corner_px
    rated = rated_views(
        views,
        cameras,
        found,
        lambda target, sensor: of_tracks.get(f"{target}/{sensor}") if found is None else found.corner_px,
    )
    topics = {sensor: source.images or source.clouds or "" for sensor, source in solved.rig.sensors.items()}
    topics |= dict.fromkeys(solved.rig.odometries, "")

    worst = worst_views(rated)
    images, names, why_not = images_of(pictures, solved.rig, worst)

    def name_of(sensor: str, stamp_ns: int) -> str:
        return PurePosixPath(image_name(names, topics[sensor], stamp_ns)).name

    counts = removed_of(solved)
    return SeenEvidence(
        span_s=span_of(solved.pairs.values())[1],
        pieces=PIECES,
        tracks=tracks_of(solved.pairs, stage_of),
        used=sum(int(measured.used.sum()) for measured in solved.pairs.values()),
        removed=sum(one.count for one in counts),
        removed_counts=counts,
        removed_list=removed_list(solved.pairs, name_of),
        cameras=seen_cameras(rated, cameras, found),
        worst=tuple(_drawn(one, name_of(one.sensor, one.view.stamp_ns), images) for one in worst),
        sheet=small_sheet(pictures.sheet) if pictures and pictures.may_show and pictures.sheet else None,
        no_pictures=why_not,
    )


def stage_of(reason: str) -> str:
    """The stage that removes measurements for this reason."""
    if reason in _BY_DETECTION:
        return DETECTION
    return ROBUST if reason == RemovalReason.OUTLIER else CLEANING


def removed_of(solved: Solved) -> tuple[RemovedCount, ...]:
    """All that was removed of a log, as its stages counted it."""
    removed: dict[Pair, dict[str, int]] = {
        track.pair: {why: count for why, count in track.removed.items() if why != RemovalReason.OUTLIER}
        for track in solved.log.cleaning.tracks
    }
    for one in solved.log.outliers:
        removed.setdefault(one.pair, {})[RemovalReason.OUTLIER.value] = one.left_out
    return counts_of(removed.items(), stage_of)


def images_of(
    pictures: Pictures | None, rig: Rig, wanted: Sequence[RatedView]
) -> tuple[dict[tuple[str, int], ImageRecord], Mapping[str, str], str]:
    """Images by sensor and stamp, the names of the files that images were, and why there are no images."""
    if pictures is None:
        return {}, {}, "the recorded log is not known any more."
    names = image_names(pictures.log)
    try:
        # The warnings about damaged parts of the log were given when its detections were read.
        with warnings.catch_warnings(action="ignore", category=LogWarning):
            found, why_not = _wanted_images(pictures.log, rig, wanted) if pictures.may_show else ({}, WITHOUT)
    except LogError as error:
        return {}, {}, f"the log with the images cannot be read: {error}"
    return found, names, why_not


def _wanted_images(log: Log, rig: Rig, wanted: Sequence[RatedView]) -> tuple[dict[tuple[str, int], ImageRecord], str]:
    """Images by sensor and stamp, and why there are none."""
    stamps: dict[str, set[int]] = defaultdict(set)
    for one in wanted:
        topic = rig.sensors[one.sensor].images
        if topic is not None:
            stamps[topic].add(one.view.stamp_ns)
    if not stamps:
        return {}, "no sensor has images: its detections come from a driver." if wanted else ""
    there = {topic.name for topic in log.topics() if topic.count}
    found = _found(log, {topic: of for topic, of in stamps.items() if topic in there})
    sensor_of = {source.images: name for name, source in rig.sensors.items()}
    images = {(sensor_of[topic], stamp): image for (topic, stamp), image in found.items()}
    return images, "" if images else "the log that was calibrated has no images (any more)."


def _found(log: Log, stamps: Mapping[str, set[int]]) -> dict[tuple[str, int], ImageRecord]:
    """Images by topic and stamp, found at log times equal to their stamps; else a small log is read through."""
    found: dict[tuple[str, int], ImageRecord] = {}
    if not stamps:
        return found
    total = sum(map(len, stamps.values()))
    at_once = log.records_logged_at(stamps, set().union(*stamps.values()))
    is_small = sum(file.size for file in log.files) <= MOST_SEARCHED
    for records in (at_once, log.records(stamps) if is_small else ()):
        for record in records:
            if isinstance(record, ImageRecord) and record.stamp_ns in stamps[record.topic]:
                found[record.topic, record.stamp_ns] = record
            if len(found) == total:
                return found
    return found


def _drawn(one: RatedView, name: str, images: Mapping[tuple[str, int], ImageRecord]) -> WorstImage:
    """An image's record, with its picture if it can be decoded."""
    record = worst_image(one, name)
    image = images.get((one.sensor, one.view.stamp_ns))
    if image is None:
        return record
    try:
        gray = decode_gray(image)
    except ImageError:  # detection read it, so its bytes have changed since
        return record
    drawn = draw_errors(gray, one.view.pixels, one.errors.px)
    return record.model_copy(update={"magnified": drawn.magnified, "picture": jpeg_of(drawn.picture, PICTURE_BYTES)})


def small_sheet(path: Path) -> bytes | None:
    """The contact sheet for a page, as JPEG; None if there is no sheet."""
    if not path.is_file():
        return None
    sheet = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_COLOR)
    if sheet is None:
        return None
    height = max(1, round(sheet.shape[0] * SHEET_WIDTH / sheet.shape[1]))
    if sheet.shape[1] > SHEET_WIDTH:
        sheet = cv2.resize(sheet, (SHEET_WIDTH, height), interpolation=cv2.INTER_AREA)
    return jpeg_of(np.asarray(sheet, dtype=np.uint8), SHEET_BYTES)


def evidence_of_log(
    calibrated: Calibrated, log: Log, sources: Sequence[Path], pictures: Pictures | None = None
) -> Evidence:
    """What a report shows beside a calibration from a log.

    The cleaned `log` has the corners, `sources` are the files that the measurements come from, and `pictures` is where
    images are; without it the evidence has none.
    """
    rig = calibrated.rig
    carriers = rig.carriers.sensors, rig.carriers.targets
    targets = {target.name: target for target in rig.target_list}  # as the rig file states them
    inputs = Inputs(
        files=input_files(sources),
        command=_command(sources),
        versions=versions(),
        rig_file=rig_text(rig),
        copies=copied_texts(frames_of(calibrated)),
    )
    model = LinearModel.of(rows_of_log(by_estimated_intrinsics(calibrated, log)), calibrated.calibration)
    return Evidence(
        derived=derived_of(calibrated.calibration),
        proof=proof_of(calibrated.solution, calibrated.problem),
        weak=weak_directions(calibrated.calibration, rows_of_log(calibrated)),
        scene=scene_of(calibrated.calibration, rows_of_log(calibrated), carriers, calibrated.cameras, targets),
        clouds=_clouds(calibrated, log) if pictures is not None and pictures.may_show else None,
        seen=seen_in_log(calibrated, log, pictures),
        residuals=None if model is None else residuals_of(model, calibrated.calibration),
        contribution=None if model is None else contribution_of(model),
        inputs=inputs.with_options(calibrated.calibration.options),
    )


def _clouds(calibrated: Calibrated, log: Log) -> CloudsEvidence | None:
    """Thinned clouds of a log, which detection kept, in one frame."""
    names = image_names(log)
    kept = {
        sensor: {
            record.stamp_ns: (
                PurePosixPath(image_name(names, of.clouds, record.stamp_ns)).name,
                cloud_of_record(record).points,
            )
            for record in records_of(log, [clouds_topic(sensor)], CloudRecord)
        }
        for sensor, of in calibrated.rig.sensors.items()
        if of.clouds is not None
    }
    return clouds_of(rows_of_log(calibrated), calibrated.refined.Y, kept)


def rows_of_log(calibrated: Solved) -> dict[Pair, MeasuredRows]:
    """The measurements of a log, used or not, in the order of its pairs."""
    return {
        pair: MeasuredRows(one.A, one.B, one.stamps_ns, one.covariance, one.reasons)
        for pair, one in calibrated.pairs.items()
    }


def write_report(
    calibrated: Calibrated,
    log: Log,
    out: Path,
    sources: Sequence[Path],
    pictures: Pictures,
    result: bytes,
    progress: Progress | None = None,
) -> None:
    """Write ``evidence.json`` and ``report.html`` of a calibration from a log, whose ``result.json`` is `result`.

    The page and the evidence have images if `pictures` may be shown. Raises `FileFormatError` if a file cannot be
    written.
    """
    (progress or silent)("writing the report")
    evidence = evidence_of_log(calibrated, log, sources, pictures)
    evidence = evidence.model_copy(update={"result_sha256": checksum(result)})
    write_evidence(evidence, out / EVIDENCE_FILE)
    shown = ShownResult.of(result, evidence, RESULT_FILE, images=pictures.may_show)
    write_page(report_page(shown), out / REPORT_FILE)


def by_estimated_intrinsics(solved: Solved, log: Log) -> Solved:
    """The solved log, with targets' poses computed again by the estimated intrinsics, if there are any."""
    refined = solved.refined
    if refined.reprojection is None:
        return solved
    cameras = {**solved.cameras, **{name: one.camera for name, one in refined.intrinsics.items()}}
    corners = LogCorners.of(log, solved.rig, cameras)
    try:
        pairs = with_intrinsics(solved.pairs, corners, cameras, refined.X, refined.Y, refined.reprojection.corner_px)
    except TargetError:  # a bundle that is not flat has no pose by the corners of one image
        return solved
    return replace(solved, pairs=pairs)


def _command(sources: Sequence[Path]) -> str:
    """The command that repeats the calibration, with the rig file of this record as rig.yaml."""
    if not sources:
        return ""
    source = sources[0] if len(sources) == 1 else Path(commonpath([path.parent for path in sources]))
    return shlex.join(["gtsam-rwhec", "calibrate", source.name, "--rig", "rig.yaml", "-o", "output"])
