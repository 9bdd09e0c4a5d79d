"""Names and numbers that would break a file are refused before one is written."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import FrameError, PoseError, StampError
from gtsam_rwhec.rig import RigFrames

CAMERA = Camera.of(640, 480, "pinhole", [[400.0, 0.0, 320.0], [0.0, 400.0, 240.0], [0.0, 0.0, 1.0]], (), "test")


def frames(**changes: Any) -> RigFrames:
    fields: dict[str, Any] = {
        "sensor_carrier": "hand",
        "target_carrier": "base",
        "sensors": {"cam": np.eye(4)},
        "targets": {"tag": np.eye(4)},
    }
    return RigFrames(**(fields | changes))


@pytest.mark.parametrize(
    "name",
    [
        "", "a b", 'a"', "a'", "a\n", "a\\", "../a", "a/../b", "/a", "a/", "a//b", "${a}", "$(find a)", "<a>", "a&b",
        "a:", "#a", "{a}", "0", "_a", "a-b", "ä", "a\x00", 3,
    ],
)  # fmt: skip
@pytest.mark.parametrize("place", ["sensor_carrier", "target_carrier", "sensors", "targets"])
def test_names_that_break_files_are_refused(name: Any, place: str) -> None:
    with pytest.raises(FrameError, match="cannot be the name of an exported frame"):
        frames(**{place: name if place.endswith("carrier") else {name: np.eye(4)}})


@pytest.mark.parametrize(
    "changes",
    [
        {"target_carrier": "hand"},
        {"sensors": {"hand": np.eye(4)}},
        {"targets": {"hand": np.eye(4)}},
        {"sensors": {"base": np.eye(4)}},
        {"targets": {"cam": np.eye(4)}},
    ],
)
def test_a_name_is_that_of_one_frame(changes: dict[str, Any]) -> None:
    with pytest.raises(FrameError, match="the name of two frames"):
        frames(**changes)


@pytest.mark.parametrize("what", ["cameras", "time_offsets_s", "topics"])
def test_only_sensors_have_cameras_offsets_and_topics(what: str) -> None:
    value = {"cameras": CAMERA, "time_offsets_s": 0.0, "topics": "/image"}[what]
    assert getattr(frames(**{what: {"cam": value}}), what) == {"cam": value}
    with pytest.raises(FrameError, match=f"{what} has 'tag', which is not a sensor; the sensors are cam"):
        frames(**{what: {"tag": value}})


@pytest.mark.parametrize("topic", ["", "/a\n/b", "/a\x00", "\ud800", "a\u2028b"])
def test_topics_are_a_line_of_text(topic: str) -> None:
    with pytest.raises(FrameError, match="the topic of cam is"):
        frames(topics={"cam": topic})


@pytest.mark.parametrize("offset", [np.nan, np.inf])
def test_time_offsets_are_finite(offset: float) -> None:
    with pytest.raises(StampError, match="the time offset of cam"):
        frames(time_offsets_s={"cam": offset})


@pytest.mark.parametrize(
    "T",
    [np.full((4, 4), np.nan), np.eye(3), 2.0 * np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0]), np.stack([np.eye(4)] * 2)],
)
def test_poses_are_poses(T: np.ndarray) -> None:
    with pytest.raises(PoseError, match="the pose of tag in base"):
        frames(targets={"tag": T})


def test_what_was_checked_stays() -> None:
    T = np.eye(4)
    held = frames(sensors={"cam": T})
    T[0, 3] = np.nan
    assert held.sensors["cam"][0, 3] == 0.0
    assert [(frame.parent, frame.child) for frame in held.frames()] == [("hand", "cam"), ("base", "tag")]
