"""What was seen in a log: its measurements, corners, and pictures of the images."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from gtsam_rwhec.detect.detections import Rejection
from gtsam_rwhec.detect.images import decode_gray
from gtsam_rwhec.detect.pictures import draw_errors, jpeg_of
from gtsam_rwhec.errors import ImageError, LogError, LogWarning
from gtsam_rwhec.logs import ImageRecord, Log
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.detection_evidence import (
    PIECES,
    RemovedCount,
    SeenEvidence,
    counts_of,
    removed_list,
    span_of,
    tracks_of,
)
from gtsam_rwhec.results.image_errors import RatedView, WorstImage, rated_views, seen_cameras, worst_image, worst_views
from gtsam_rwhec.results.removed_measurements import RemovalReason
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.plotted_corners import camera_of, seen_views
from gtsam_rwhec.runs.run_log import image_name, image_names
from gtsam_rwhec.runs.solving_stage import Solved

#: A contact sheet of the page is so wide, pixels; it, and each picture of an image, has at most so many bytes.
SHEET_WIDTH, SHEET_BYTES, PICTURE_BYTES = 1200, 500_000, 90_000
#: Where images are not found by their stamps, logs up to this size are gone through for them, bytes.
MOST_SEARCHED = 300_000_000
WITHOUT = "the report was made without images."
#: The stages that remove measurements.
DETECTION, CLEANING, ROBUST = "detection", "cleaning", "robust estimation"
_BY_DETECTION = {str(reason) for reason in Rejection}


@dataclass(frozen=True)
class Pictures:
    """Where images are: the log with them, and the contact sheet's file, which may be missing.

    With `may_show` False only the images' names are read.
    """

    log: Log
    sheet: Path | None
    may_show: bool = True


def seen_in_log(solved: Solved, log: Log, pictures: Pictures | None) -> SeenEvidence:
    """What was seen, of a cleaned log; without `pictures` there are neither images nor their names."""
    views = seen_views(solved, log)
    found = solved.refined.reprojection
    cameras = {sensor: camera_of(solved, sensor) for sensor in views}
    of_tracks = solved.log.detection.corner_px
    rated = rated_views(
        views,
        cameras,
        found,
        lambda target, sensor: of_tracks.get(f"{target}/{sensor}") if found is None else found.corner_px,
    )
    topics = {sensor: source.images or "" for sensor, source in solved.rig.sensors.items()}
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
        sheet=_sheet(pictures),
        no_pictures=why_not,
    )


def stage_of(reason: str) -> str:
    """The stage that removes measurements for a reason."""
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
        # What is damaged in the log was said when it was read for its detections.
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
    """Images by topic and stamp: where they were logged at their stamps, else by going through a log that is small."""
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


def _sheet(pictures: Pictures | None) -> bytes | None:
    if pictures is None or pictures.sheet is None or not pictures.may_show:
        return None
    return small_sheet(pictures.sheet)


def small_sheet(path: Path) -> bytes | None:
    """The contact sheet for a page, as JPEG; None where there is no sheet."""
    if not path.is_file():
        return None
    sheet = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_COLOR)
    if sheet is None:
        return None
    height = max(1, round(sheet.shape[0] * SHEET_WIDTH / sheet.shape[1]))
    if sheet.shape[1] > SHEET_WIDTH:
        sheet = cv2.resize(sheet, (SHEET_WIDTH, height), interpolation=cv2.INTER_AREA)
    return jpeg_of(np.asarray(sheet, dtype=np.uint8), SHEET_BYTES)
