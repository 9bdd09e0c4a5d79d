"""Cameras of which many images are blurred by motion, so that no target is read in them, or one of no one instant.

The others may give a good answer, but it rests on the moments at which the arm was slow; and images that are a little
less blurred are of no one instant.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.detect.clues import motion_blur_px
from gtsam_rwhec.detect.images import Gray, decode_gray
from gtsam_rwhec.errors import ImageError
from gtsam_rwhec.logs import ImageRecord, Log
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.sensor_detections import SensorDetections

#: So many images of a sensor, and this share of them, have no target that is used.
FEWEST, UNREAD = 3, 0.15
#: At most so many of them are looked at.
LOOKED_AT = 8
#: Edges across the motion have a blur of so many pixels at least, and of so many times that of edges along it; sharp
#: ones have less than one.
WIDE_PX, WIDER = 1.6, 1.5
#: The same for images in which targets are read all the same: their poses are of no one instant.
WIDE_AND_READ_PX = 2.2
#: This share of those that were looked at is blurred.
MOST = 0.6


def blurred_images(
    log: Log, rig: Rig, cameras: Mapping[str, Camera], found: Mapping[str, SensorDetections]
) -> tuple[str, ...]:
    """A sentence, without a full stop, for each sensor of which many images are blurred by motion."""
    said = []
    for sensor, of_sensor in found.items():
        used = {record.stamp_ns for record in of_sensor.records if not record.reason}
        whole = [stamp for stamp, image in sorted(of_sensor.images.items()) if not image.fault]
        unread = [stamp for stamp in whole if stamp not in used]
        hides = len(unread) >= max(FEWEST, UNREAD * of_sensor.count)
        looked_at = _spread(unread if hides else whole)
        if len(looked_at) < FEWEST:
            continue
        blur = [motion_blur_px(gray) for gray in _images(log, rig, sensor, cameras[sensor], of_sensor, looked_at)]
        least_px = WIDE_PX if hides else WIDE_AND_READ_PX
        moved = [(wide, narrow) for wide, narrow in blur if wide > least_px and wide > WIDER * narrow]
        if len(moved) >= max(2, MOST * len(blur)):
            wide_px, narrow_px = np.median(moved, axis=0)
            what = (
                f"no target is read in {len(unread)} of {of_sensor.count} images of {sensor}, and motion blur hides "
                f"it: {len(moved)} of {len(blur)} of them that were looked at"
                if hides
                else f"motion blur is in {len(moved)} of {len(blur)} images of {sensor} that were looked at: they"
            )
            widths = f"{wide_px:.1f} pixels across the motion and {narrow_px:.1f} along it"
            said.append(f"{what} have edges with a blur of {widths}")
    return tuple(said)


def _spread(stamps: list[int]) -> list[int]:
    """At most `LOOKED_AT` of some stamps."""
    if not stamps:
        return []
    places = np.unique(np.linspace(0, len(stamps) - 1, LOOKED_AT).round().astype(int))
    return [stamps[place] for place in places.tolist()]


def _images(
    log: Log, rig: Rig, sensor: str, camera: Camera, of_sensor: SensorDetections, stamps: list[int]
) -> list[Gray]:
    """The images of some stamps that can be decoded."""
    wanted = {stamp: of_sensor.images[stamp].logged_ns for stamp in stamps}
    images = []
    for record in log.records_logged_at([str(rig.sensors[sensor].images)], wanted.values()):
        if isinstance(record, ImageRecord) and record.stamp_ns in wanted:
            try:
                images.append(decode_gray(record, (camera.width, camera.height)))
            except ImageError:
                continue  # its fault is in the report
    return images
