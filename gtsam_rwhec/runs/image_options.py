"""Options that count only where images are: they are refused before any work begins, not passed over."""

from __future__ import annotations

from pathlib import Path

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.logs import Log
from gtsam_rwhec.logs.mcap_writer import Images
from gtsam_rwhec.rig import Rig


def check_image_options(log: Log, rig: Rig | None, *, images: Images, workers: int | None) -> None:
    """Raise `OptionError` for workers that would search no image, or for images to copy from a log that has none.

    `rig` is the rig file that detection will work with; None if the detections are already in the log.
    """
    path = log.files[0].path
    if workers is not None and rig is None:
        raise OptionError(
            f"workers={workers} (--workers) counts only in detection, and the detections are already in {path}: leave "
            "the option out, or give the raw log"
        )
    if workers is not None and rig is not None and not _has_images(rig):
        raise OptionError(
            f"workers={workers} (--workers) counts only for images, and no sensor of the rig file has images: leave "
            "the option out"
        )
    if images == "copy" and not any(topic.has_images for topic in log.topics()):
        other = "the raw log, if it has images" if rig is None else "a log with images"
        raise OptionError(
            f'images="copy" (--images): {path} has no images to copy. Leave the option out, or give {other}'
        )


def check_drawable(rig: Rig, folder: str | Path) -> None:
    """Raise `OptionError` if no sensor has images in which detections can be drawn."""
    if not _has_images(rig):
        raise OptionError(
            f"{folder} (--draw): no sensor of the rig file has images in which detections can be drawn. Leave the "
            "option out"
        )


def _has_images(rig: Rig) -> bool:
    return any(source.images is not None for source in rig.sensors.values())
