"""Topics of a rig file that a log lacks, or that are those of another sensor, are named with their lines."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
import synthetic_logs as made
from mcap.reader import make_reader
from mcap_ros2.writer import Writer

from gtsam_rwhec.errors import LogError, LogWarning
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.rig import parse_rig
from gtsam_rwhec.runs.cleaning_stage import clean_log
from gtsam_rwhec.runs.detection_stage import detect_log
from gtsam_rwhec.runs.topics_of_rig import check_topics

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


JOINTS = (
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    f"{'=' * 80}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
)


def joint_states(path: Path, count: int = 20) -> Path:
    """A log of sensor_msgs/JointState alone, as ROS 2 records it."""
    with open(path, "wb") as stream:
        writer = Writer(stream)
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", JOINTS)
        for i in range(count):
            stamp = made.BEGIN_NS + i * 10**8
            header = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": ""}
            state = {"header": header, "name": ["j1", "j2"], "position": [0.1 * i, 2.0], "velocity": [], "effort": []}
            writer.write_message("/joint_states", schema, state, log_time=stamp)
        writer.finish()
    return path


def raw(path: Path) -> list[tuple[int, bytes]]:
    with open(path, "rb") as stream:
        return [(m.log_time, m.data) for _, _, m in make_reader(stream).iter_messages(["/joint_states"])]


def test_a_type_that_cannot_be_read_is_named_with_those_that_can(tmp_path: Path) -> None:
    path = made.write(tmp_path / "raw.mcap", made.recording(0.5))
    text = made.rig_text(cam_0="detections: /joint_states")
    with open_log([path, joint_states(tmp_path / "joints.mcap")]) as log, pytest.raises(LogError) as caught:
        check_topics(log, parse_rig(text, "rig.yaml"))
    said = str(caught.value)
    assert said.startswith("rig.yaml, line 8: sensors.cam_0.detections: ")
    assert "'sensor_msgs/msg/JointState' (ros2msg) in 'cdr' is not read" in said
    assert "apriltag_msgs/AprilTagDetectionArray" in said
    assert said.endswith("Topics of these in this log: /cam_0/tags, /cam_1/tags")


def test_joint_states_stay_in_the_logs_that_are_written(tmp_path: Path) -> None:
    paths = [made.write(tmp_path / "raw.mcap", made.recording(4.0)), joint_states(tmp_path / "joints.mcap")]
    detect_log(paths, made.rig(), tmp_path / "detected.mcap")
    clean_log(tmp_path / "detected.mcap", tmp_path / "calibration.mcap")
    assert len(raw(paths[1])) == 20
    assert raw(tmp_path / "detected.mcap") == raw(tmp_path / "calibration.mcap") == raw(paths[1])
