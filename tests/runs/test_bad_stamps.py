"""Stamps from which no calibration can be made: what is refused, where, and what to do."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest
from bad_logs import MOVING, RECORDED, WITH_IMAGES, images, picture, refused, restamped, since_1970
from synthetic_logs import BEGIN_NS, rig_text, solved

from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.errors import LogWarning, StampError

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
