"""Pictures of the detections in the images of a log, as PNG files in a folder."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import cv2

from gtsam_rwhec.errors import ImageError
from gtsam_rwhec.files.atomic_write import write_atomically
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.logs import DetectionRecord, ImageRecord, open_log
from gtsam_rwhec.pipeline.image_options import check_drawable
from gtsam_rwhec.pipeline.log_contract import detections_topic, records_of
from gtsam_rwhec.pipeline.log_metadata import read_cameras, read_embedded_rig
from gtsam_rwhec.pipeline.output_paths import made_folder
from gtsam_rwhec.vision.drawn_detections import draw
from gtsam_rwhec.vision.images import decode_gray


def draw_log(
    log_path: str | Path, detected_path: str | Path, folder: str | Path, *, progress: Progress | None = None
) -> int:
    """Draw the detections in every image that can be decoded, as ``<sensor>_<stamp>.png``; return how many.

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
    tell = progress or silent
    count = 0
    with open_log(detected_path) as detected, open_log(log_path) as log:
        rig, cameras = read_embedded_rig(detected), read_cameras(detected)
        check_drawable(rig, folder)
        folder = made_folder(folder)
        for sensor, source in rig.sensors.items():
            if source.images is None:
                continue
            of_stamp: dict[int, list[DetectionRecord]] = defaultdict(list)
            for record in records_of(detected, [detections_topic(sensor)], DetectionRecord):
                of_stamp[record.stamp_ns].append(record)
            for image in log.records([source.images]):
                if not isinstance(image, ImageRecord):
                    continue
                try:
                    gray = decode_gray(image, (cameras[sensor].width, cameras[sensor].height))
                except ImageError:
                    continue  # the report of detection names it
                picture = draw(gray, of_stamp[image.stamp_ns], cameras[sensor])
                path = folder / f"{sensor.replace('/', '_')}_{image.stamp_ns}.png"
                _, data = cv2.imencode(".png", picture)
                write_atomically(path, data.tobytes())
                count += 1
                tell(f"drawing: image {count}")
    return count
