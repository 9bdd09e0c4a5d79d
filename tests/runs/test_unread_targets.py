"""Cameras of which many images are blurred by motion are named; sharp ones in which there is no target are not."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.logs import LogWriter, open_log
from gtsam_rwhec.rig import parse_rig
from gtsam_rwhec.runs.sensor_detections import LookedAt, SensorDetections
from gtsam_rwhec.runs.unread_targets import blurred_images

RIG = parse_rig(
    """
carriers: {sensors: hand, targets: base, poses: {tf: [base, hand]}}
sensors: {camera: {images: /camera/image, intrinsics: {model: pinhole, K: [300, 300, 160, 120], size: [320, 240]}}}
targets: {tag: {type: tag, family: tag36h11, id: 0, size_m: 0.1}}
""",
    "rig.yaml",
)
CAMERA = Camera.of(320, 240, "plumb_bob", [[300, 0, 160], [0, 300, 120], [0, 0, 1]], [0, 0, 0, 0], "camera")


def seen(folder: Path, way_px: int, number: int = 6) -> tuple[str, ...]:
    """What is said of images without a target that moved by some pixels each."""
    rng = np.random.default_rng(4)
    looked_at = {}
    with LogWriter(folder / "log.mcap") as log:
        for stamp in range(1, number + 1):
            coarse = rng.uniform(30, 220, (12, 16)).astype(np.float32)
            sharp = cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_NEAREST)
            moved = cv2.filter2D(sharp, -1, np.full((1, way_px), 1.0 / way_px)) + rng.normal(0.0, 1.0, sharp.shape)
            _, png = cv2.imencode(".png", np.clip(moved, 0, 255).astype(np.uint8))
            log.compressed_image("/camera/image", stamp, "camera", "png", png.tobytes())
            looked_at[stamp] = LookedAt(stamp)
    found = {"camera": SensorDetections([], number, Counter(), images=looked_at)}
    with open_log(folder / "log.mcap") as log:
        return blurred_images(log, RIG, {"camera": CAMERA}, found)


def test_images_that_move_are_named_with_their_blur(tmp_path: Path) -> None:
    (words,) = seen(tmp_path, 11)
    assert words.startswith("no target is read in 6 of 6 images of camera, and motion blur hides it: 6 of 6 of them")


@pytest.mark.parametrize(("way_px", "number"), [(1, 6), (11, 2)])
def test_sharp_images_and_few_images_are_not(way_px: int, number: int, tmp_path: Path) -> None:
    assert seen(tmp_path, way_px, number) == ()
