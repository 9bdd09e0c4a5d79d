"""Images, intrinsics and stamps from which no calibration can be made: what is refused, where, and what to do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest
import synthetic_logs as made
from bad_logs import MOVING, RECORDED, WITH_IMAGES, images, picture, refused, restamped, since_1970
from synthetic_logs import BEGIN_NS, rig_text, solved

from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.errors import CameraError, LogError, LogWarning, RigError, StampError
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


pytestmark = pytest.mark.usefixtures("without_figures")

ESTIMATED = "detections: /cam_1/tags\n    time_offset: estimate"


def test_stamps_out_of_order(tmp_path: Path) -> None:
    def set_back(stamp_ns: int) -> int:
        return stamp_ns if stamp_ns < BEGIN_NS + 2 * 10**9 else stamp_ns - 3 * 10**9

    back = restamped(RECORDED, "/cam_1/tags", set_back)
    refused(
        tmp_path, back, StampError, "topic /cam_1/tags: stamps go back by 2.800 s at message 10", "1699999999020000000",
        "a clock was set, or two sources publish there; cut the log at that place",
    )  # fmt: skip
    back = restamped(RECORDED, "/tf", set_back)
    refused(tmp_path, back, StampError, "tf base to hand", "transforms of hand: stamps go back by 2.980 s at message ")
    back = MOVING + restamped(images(picture(), 11), ".*/image", set_back)
    refused(tmp_path, back, StampError, "topic /cam_0/image: stamps go back by 2.600 s at message 6", **WITH_IMAGES)


def test_stamps_that_go_back_step_by_step(tmp_path: Path) -> None:
    back = restamped(RECORDED, "/cam_1/tags", lambda stamp: 2 * BEGIN_NS + 4 * 10**9 - stamp)
    refused(tmp_path, back, StampError, "topic /cam_1/tags: stamps go back by 1.200 s at message 7", "cut the log")


@pytest.mark.parametrize(
    ("topics", "words"),
    [
        ("/tf", ("tf base to hand is from 1.000 to 5.000 s", "stamps of cam_0", "from 1700000000.200 to 17000")),
        ("/cam_./tags", ("tf base to hand is from 1700000000.000 to 1700000004.000 s", "cam_0", "1.200 to 4.800 s")),
        ("/cam_1/tags", ("tf base to hand is from 1700000000.000 to 1700000004.000 s", "cam_1", "1.220 to 4.820 s")),
    ],
)
def test_stamps_of_another_clock(tmp_path: Path, topics: str, words: tuple[str, ...]) -> None:
    messages = restamped(RECORDED, topics, since_1970)
    refused(tmp_path, messages, StampError, "no overlap in time", *words, "different clocks", "time offset")


def test_images_of_another_clock(tmp_path: Path) -> None:
    messages = MOVING + restamped(images(picture(cv2.aruco.DICT_APRILTAG_36h11)), ".*/image", since_1970)
    refused(tmp_path, messages, StampError, "no overlap in time", "cam_0", "1.000 to 3.000 s", **WITH_IMAGES)


def test_no_time_offset_joins_clocks_of_different_years(tmp_path: Path) -> None:
    """The other sensor keeps its answer."""
    messages = restamped(RECORDED, "/cam_1/tags", since_1970)
    with pytest.warns(LogWarning) as said:
        calibrated = solved(tmp_path, messages, rig_text(cam_1=ESTIMATED))
    (warning,) = [str(one.message) for one in said if issubclass(one.category, LogWarning)]
    for words in ("cam_1: no offset of up to 1 s", "1.220 to 4.820 s", "1700000000.000", "another clock?"):
        assert words in warning
    assert calibrated.judgement.grounds == (Ground.NO_ANSWER,)
    assert "the sensor's clock is not known: 57" in str(calibrated.judgement)
    assert set(calibrated.refined.Y) == {"cam_0"}


def test_no_overlap(tmp_path: Path) -> None:
    messages = restamped(RECORDED, "/tf", lambda stamp: stamp - 3600 * 10**9)
    words = "1699996400.000 to 1699996404.000 s", "cam_0", "1700000000.200 to 1700000003.800 s"
    refused(tmp_path, messages, StampError, "no overlap in time", *words)


@pytest.mark.parametrize(
    ("topics", "words"),
    [
        ("/tf", ("tf base to hand, transforms of hand: every stamp is 0 (201 messages)",)),
        ("/cam_1/tags", ("topic /cam_1/tags: every stamp is 0 (19 messages)",)),
    ],
)
def test_stamps_that_are_all_zero(tmp_path: Path, topics: str, words: tuple[str, ...]) -> None:
    messages = restamped(RECORDED, topics, lambda stamp: 0)
    refused(tmp_path, messages, StampError, *words, "does the driver fill header.stamp?")


def test_images_whose_stamps_are_all_zero(tmp_path: Path) -> None:
    messages = MOVING + restamped(images(picture()), ".*/image", lambda stamp: 0)
    refused(tmp_path, messages, StampError, "topic /cam_0/image: every stamp is 0 (6 messages)", **WITH_IMAGES)
