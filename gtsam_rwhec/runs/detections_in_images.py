"""Pictures of the detections in the images of a log, as PNG files in a folder."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path

import cv2

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.detect.images import decode_gray
from gtsam_rwhec.detect.pictures import draw
from gtsam_rwhec.errors import ImageError
from gtsam_rwhec.files.progress import Counted, Progress, silent
from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.logs import DetectionRecord, ImageRecord, Log, open_log
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.image_names import image_name, image_names, picture_file
from gtsam_rwhec.runs.image_options import check_drawable
from gtsam_rwhec.runs.log_contract import detections_topic, records_of
from gtsam_rwhec.runs.log_metadata import read_cameras, read_embedded_rig
from gtsam_rwhec.runs.output_paths import made_folder


def draw_log(
    log_path: str | Path, detected_path: str | Path, folder: str | Path, *, progress: Progress | None = None
) -> int:
    """Draw the detections in every image that can be decoded; return how many pictures there are.

    They are ``<sensor>_<name>.png``, where the name is that of the image's file, or its stamp.

    Parameters
    ----------
    log_path
        The log with the images.
    detected_path
        The log that ``detect_log`` made of it.
    folder
        It is made if it does not exist.
    progress : callable, optional

    Raises
    ------
    OptionError
        No sensor has images.
    LogError
        A log cannot be read.
    FileFormatError
        A picture cannot be written.
    """
    with open_log(detected_path) as detected, open_log(log_path) as log:
        rig, cameras = read_embedded_rig(detected), read_cameras(detected)
        records = {
            sensor: list(records_of(detected, [detections_topic(sensor)], DetectionRecord)) for sensor in rig.sensors
        }
        return draw_images(log, rig, cameras, records, folder, progress or silent)


def draw_images(
    log: Log,
    rig: Rig,
    cameras: Mapping[str, Camera],
    records: Mapping[str, Iterable[DetectionRecord]],
    folder: str | Path,
    tell: Progress,
) -> int:
    """As `draw_log`, for the detections of each sensor; an image without any is drawn too."""
    check_drawable(rig, folder)
    folder = made_folder(folder)
    names = image_names(log)
    drawn = {sensor: source.images for sensor, source in rig.sensors.items() if source.images is not None}
    total = sum(topic.count for topic in log.topics() if topic.name in drawn.values())
    count, taken = 0, set[str]()
    for sensor, topic in drawn.items():
        of_stamp: dict[int, list[DetectionRecord]] = defaultdict(list)
        for record in records[sensor]:
            of_stamp[record.stamp_ns].append(record)
        for image in log.records([topic]):
            if not isinstance(image, ImageRecord):
                continue
            try:
                gray = decode_gray(image, (cameras[sensor].width, cameras[sensor].height))
            except ImageError:
                continue  # the report of detection names it
            seen, name = of_stamp[image.stamp_ns], image_name(names, topic, image.stamp_ns)
            file = picture_file(sensor, name)
            if file in taken:  # two names that differ in their endings, or in characters that files should not have
                file = picture_file(sensor, f"{name} {image.stamp_ns}.")
            taken.add(file)
            picture = draw(gray, seen, cameras[sensor], f"{sensor}, {name}: {_in_words(seen)}")
            is_written, data = cv2.imencode(".png", picture)
            assert is_written
            write_atomically(folder / file, data.tobytes())
            count += 1
            tell(Counted("drawing: image", count, total))
    return count


def _in_words(records: Iterable[DetectionRecord]) -> str:
    said = [f"{record.id} {f'rejected, {record.reason}' if record.reason else 'found'}" for record in records]
    return "; ".join(said) or "nothing seen"
