"""Topics of a rig file that a log lacks, or that are those of another sensor, are named with their lines."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
import synthetic_logs as made

from gtsam_rwhec.errors import LogError, LogWarning
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.pipeline.topics_of_rig import check_topics
from gtsam_rwhec.rig import parse_rig

INTRINSICS = "detections: /cam_{0}/tags\n    intrinsics: {{topic: /cam_{1}/camera_info}}"

EXCHANGED = (
    made.RIG.replace("/cam_0/tags", "/other").replace("/cam_1/tags", "/cam_0/tags").replace("/other", "/cam_1/tags")
)


def check(folder: Path, text: str) -> None:
    infos = [made.camera_info(camera) for camera in made.CAMERAS]
    path = made.write(folder / "raw.mcap", infos + made.recording(0.5))
    with open_log(path) as log:
        check_topics(log, parse_rig(text, "rig.yaml"))


def test_topics_that_are_there_and_of_their_own_frame(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(tmp_path, made.rig_text(cam_0=INTRINSICS.format(0, 0), cam_1=INTRINSICS.format(1, 1)))
        # A frame that is no sensor's says nothing.
        check(
            tmp_path,
            made.rig_text(cam_0="detections: /cam_0/tags\n    frame: optical", cam_1="detections: /cam_1/tags"),
        )


def test_a_topic_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"^rig\.yaml, line 10: sensors\.cam_1\.detections: .* no topic /cam_1/marks;"):
        check(tmp_path, made.rig_text(cam_1="detections: /cam_1/marks"))


def test_topics_of_another_sensor(tmp_path: Path) -> None:
    said = r"rig\.yaml, line 8: sensors\.cam_0\.detections: the messages on /cam_1/tags are of frame cam_1"
    with pytest.warns(LogWarning, match=said):
        check(tmp_path, EXCHANGED)
    said = r"line 11: sensors\.cam_1\.intrinsics\.topic: the messages on /cam_0/camera_info are of frame cam_0"
    with pytest.warns(LogWarning, match=said):
        check(tmp_path, made.rig_text(cam_1=INTRINSICS.format(1, 0)))
