"""Images and intrinsics from which no calibration can be made: what is refused, where, and what to do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest
import synthetic_logs as made
from bad_logs import MOVING, WITH_IMAGES, images, picture, refused
from synthetic_logs import BEGIN_NS

from gtsam_rwhec.errors import CameraError, LogError, LogWarning, RigError
from gtsam_rwhec.runs.detection_stage import detect_log

# Intrinsics


def test_no_intrinsics(tmp_path: Path) -> None:
    messages = [m for m in images(picture()) if m.topic != "/cam_0/camera_info"] + MOVING
    refused(
        tmp_path, messages, LogError, "sensor cam_0", "no topic /cam_0/camera_info",
        "Topics of intrinsics in it: /cam_1/camera_info", "/cam_0/image", "{file: ...}", **WITH_IMAGES,
    )  # fmt: skip
    broken = [replace(made.camera_info("cam_0"), data=b"{]"), *messages]
    with pytest.warns(LogWarning, match="/cam_0/camera_info"):
        refused(tmp_path, broken, CameraError, "/cam_0/camera_info has no message that can be read", **WITH_IMAGES)
    with pytest.raises(RigError, match=r"rig\.yaml, line 7: sensors\.cam_0: images without intrinsics"):
        made.rig(cam_0="images: /cam_0/image")


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"K": [0.0] * 9}, "K is all zeros: the camera was not calibrated"),
        ({"K": [0.004, 0, 320, 0, 0.004, 240, 0, 0, 1]}, "fx = 0.004 pixels for an image of 640 x 480 pixels"),
        ({"K": [-400.0, 0, 320, 0, 400, 240, 0, 0, 1]}, "fx = -400 pixels"),
        ({"K": [400.0, 0, 9e9, 0, 400, 240, 0, 0, 1]}, "cx = 9e+09 is far outside the image of 640 x 480"),
        ({"K": [float("nan"), 0, 320, 0, 400, 240, 0, 0, 1]}, "give a finite 3 x 3 matrix"),
        ({"width": 0}, "the image size is 0 x 480 pixels"),
        ({"D": [1e300] * 5}, "no lens has them"),
        ({"distortion_model": "acme"}, "distortion model 'acme' is not supported; supported are"),
    ],
)
def test_absurd_intrinsics(tmp_path: Path, changed: dict[str, Any], words: str) -> None:
    messages = [*images(picture())[1:], made.camera_info("cam_0", **changed), *MOVING]
    refused(tmp_path, messages, CameraError, "topic /cam_0/camera_info", words, **WITH_IMAGES)


def test_intrinsics_of_another_resolution(tmp_path: Path) -> None:
    larger = made.camera_info("cam_0", width=1280, height=960, K=[800.0, 0, 640, 0, 800, 480, 0, 0, 1])
    refused(
        tmp_path, [larger, *images(picture())[1:], *MOVING], LogError, "topic /cam_0/image", "none of the 6 images",
        f"{BEGIN_NS} ns: 640 x 480 pixels, but the intrinsics are for 1280 x 960",
        "multiply fx, fy, cx and cy by 0.5 and write size: [640, 480]", "line 9: sensors.cam_0.intrinsics",
        **WITH_IMAGES,
    )  # fmt: skip


# Images


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"no picture at all", "17 bytes that begin with 6e6f20706963"),
        (picture()[:60], "60 bytes of a PNG file that is cut short"),
        (b"", "there are no bytes in it"),
    ],
)
def test_images_that_do_not_decode(tmp_path: Path, data: bytes, words: str) -> None:
    messages = MOVING + images(data)
    where = "topic /cam_0/image: none of the 6 images of cam_0 can be used", f"image at {BEGIN_NS} ns"
    refused(tmp_path, messages, LogError, *where, words, **WITH_IMAGES)


def test_some_images_that_do_not_decode_are_counted_and_named(tmp_path: Path) -> None:
    good, bad = images(picture(cv2.aruco.DICT_APRILTAG_36h11)), images(picture()[:60])
    log = made.write(tmp_path / "raw.mcap", MOVING + good[:-2] + bad[-2:])
    report = detect_log(log, made.rig(**WITH_IMAGES), tmp_path / "detected.mcap", workers=1)
    assert {sensor: len(faults) for sensor, faults in report.undecoded.items()} == {"cam_0": 1, "cam_1": 1}
    assert f"/cam_0/image, image at {BEGIN_NS + 2_000_000_000} ns: 60 bytes of a PNG" in report.undecoded["cam_0"][0]
    assert {track.used for track in report.tracks if track.target == "tag_0"} == {5}
