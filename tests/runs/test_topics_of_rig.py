"""Topics of a rig file that a log lacks are named with their lines; stages' own topics and drivers' targets too."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import synthetic_logs as made
from mcap.reader import make_reader
from mcap_ros2.writer import Writer

from gtsam_rwhec.cameras.targets import Bundle, BundleTag, Tag
from gtsam_rwhec.errors import FrameError, LogError, LogWarning
from gtsam_rwhec.logs import DetectionRecord, LogWriter, open_log
from gtsam_rwhec.rig import parse_rig
from gtsam_rwhec.runs import run_log as log_contract
from gtsam_rwhec.runs.cleaning_stage import clean_log
from gtsam_rwhec.runs.detection_stage import detect_log
from gtsam_rwhec.runs.measured_pairs import target_of
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
    with warnings.catch_warnings(action="error"):
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


OF_DETECTION = {
    log_contract.detections_topic("rig/cam_0"),
    log_contract.annotations_topic("rig/cam_0"),
    log_contract.poses_topic("rig/cam_0"),
}
AFTER_DETECTION = {log_contract.pairs_topic("rig/cam_0"), log_contract.SOLUTION_TOPIC}
#: The last looks like a stage's, and is another program's where no stage wrote the log.
RAW = {"/tf", "/calibration/board/detections"}


def write(path: Path, topics: set[str], *metadata: str) -> Path:
    with LogWriter(path) as out:
        for topic in topics:
            out.transforms(topic, 1, [("a", "b", np.eye(4))])
        for name in metadata:
            out.metadata(name, {"json": "{}"})
    return path


def test_topics_of_stages_are_told_from_raw_ones(tmp_path: Path) -> None:
    every = {"/tf"} | OF_DETECTION | AFTER_DETECTION
    for name in (log_contract.DETECTION_METADATA, log_contract.CLEANING_METADATA):
        with open_log(write(tmp_path / f"{name}.mcap", every, name)) as log:
            assert log_contract.is_from_stage(log)
            assert log_contract.raw_topics(log) == ["/tf"]
            assert set(log_contract.topics_up_to_detection(log)) == {"/tf"} | OF_DETECTION


def test_a_raw_log_keeps_all_its_topics(tmp_path: Path) -> None:
    with open_log(write(tmp_path / "raw.mcap", RAW)) as log:
        assert not log_contract.is_from_stage(log)
        assert set(log_contract.raw_topics(log)) == RAW


@pytest.mark.parametrize("family", ["", "tag36h11", "36h11", "tagStandard36h11", "DICT_APRILTAG_36h11"])
def test_drivers_words_for_a_family(family: str) -> None:
    target = target_of(DetectionRecord(1, 1, "/tags", "cam_0", family, "0"), made.rig().target_list)
    assert target is not None
    assert target.name == "tag_0"
    assert target_of(DetectionRecord(1, 1, "/tags", "cam_0", "tag25h9", "0"), made.rig().target_list) is None


def test_a_driver_with_a_larger_dictionary_sees_the_same_marker() -> None:
    targets = [Tag("marker", "aruco_5x5_50", 3, 0.1)]
    seen = DetectionRecord(1, 1, "/tags", "cam_0", "DICT_5X5_1000", "3")
    assert target_of(seen, targets) == targets[0]


UPRIGHT = (1.0, 0.0, 0.0, 0.0)
BOX = Bundle("box", "tag36h11", tuple(BundleTag(i, 0.05, (0.1 * i, 0.0, 0.0), UPRIGHT) for i in (7, 8, 10)))
TARGETS = (Tag("near", "tag36h11", 3, 0.1), Tag("far", "aruco_4x4_50", 3, 0.1), Tag("lid", "tag36h11", 4, 0.1), BOX)


def seen(family: str, id_: str) -> DetectionRecord:
    return DetectionRecord(1, 1, "/tags", "cam", family, id_, T_camera_tag=np.eye(4))


@pytest.mark.parametrize(
    ("family", "id_", "name"),
    [
        ("tag36h11", "3", "near"),
        ("aruco_4x4_50", "3", "far"),
        ("", "4", "lid"),
        ("", "box", "box"),
        ("", "10,7,8", "box"),  # apriltag_ros names a bundle by its tags
        ("", "7,8", None),
        ("", "7", None),
        ("tag36h11", "5", None),
    ],
)
def test_the_target_of_a_detection(family: str, id_: str, name: str | None) -> None:
    found = target_of(seen(family, id_), TARGETS)
    assert (None if found is None else found.name) == name


def test_an_id_of_two_families_is_refused_without_a_family() -> None:
    with pytest.raises(FrameError, match="could be near or far"):
        target_of(seen("", "3"), TARGETS)


def test_a_log_of_detections_is_sent_to_the_next_stage(tmp_path: Path) -> None:
    raw = made.write(tmp_path / "raw.mcap", made.recording(0.5))
    detect_log(raw, made.rig(), tmp_path / "detected.mcap")
    text = made.rig_text(cam_0="detections: /cam_0/apriltags")
    with (
        open_log(tmp_path / "detected.mcap") as log,
        pytest.raises(LogError, match=r"run gtsam-rwhec clean .*detected"),
    ):
        check_topics(log, parse_rig(text, "rig.yaml"))
