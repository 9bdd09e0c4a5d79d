"""What drivers of ROS 1 and ROS 2 publish, through bags; definitions and bytes of CDR beyond what ROS's own need."""

from __future__ import annotations

import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.writer import Writer
from read_logs import T0, T_EXPECTED, read
from ros_messages import FIRST_APRILTAG, bag, header
from strategies import cdr_messages, definitions

from gtsam_rwhec.errors import MessageError
from gtsam_rwhec.logs import DetectionRecord, IntrinsicsRecord, convert_ros_bag
from gtsam_rwhec.logs.cdr import Batch, MessageType

POSE = {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8}}
STAMPED = {"header": header(T0, "cam"), "pose": {"pose": POSE, "covariance": np.eye(6).ravel()}}
CORNERS = [[10.0, 40.0], [40.0, 41.0], [42.0, 11.0], [9.0, 10.0]]
POINTS = [{"x": x, "y": y} for x, y in CORNERS]
TAG = {"family": "tag36h11", "id": 7, "corners": POINTS}
IN_ARRAY: dict[str, Any] = {"header": header(T0, "cam")}
#: Of each message: the versions of ROS, its fields, and the family, id, size, whether it has corners, and a pose.
MESSAGES: dict[str, tuple[tuple[int, ...], dict[str, Any], tuple[str, str, float | None, bool, bool]]] = {
    "apriltag_msgs/msg/AprilTagDetectionArray": (
        (2,), IN_ARRAY | {"detections": [TAG]}, ("tag36h11", "7", None, True, False),
    ),
    "apriltag_ros/msg/AprilTagDetectionArray": (
        (1, 2), IN_ARRAY | {"detections": [{"id": [7], "size": [0.1], "pose": STAMPED}]}, ("", "7", 0.1, False, True),
    ),
    "apriltags_ros/msg/AprilTagDetectionArray": (
        (1,), {"detections": [{"id": 7, "size": 0.1, "pose": {"header": header(T0, "cam"), "pose": POSE}}]},
        ("", "7", 0.1, False, True),
    ),
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray": (
        (2,), IN_ARRAY | {"detections": [TAG | {"pose": STAMPED}]}, ("tag36h11", "7", None, True, True),
    ),
    "aruco_msgs/msg/MarkerArray": (
        (1, 2), IN_ARRAY | {"markers": [{"header": header(T0, "cam"), "id": 7, "pose": STAMPED["pose"]}]},
        ("", "7", None, False, True),
    ),
    "aruco_opencv_msgs/msg/ArucoDetection": (
        (1, 2), IN_ARRAY | {"markers": [{"marker_id": 7, "pose": POSE}]}, ("", "7", None, False, True),
    ),
    "ros2_aruco_interfaces/msg/ArucoMarkers": (
        (2,), IN_ARRAY | {"marker_ids": [7], "poses": [POSE]}, ("", "7", None, False, True),
    ),
    "fiducial_msgs/msg/FiducialArray": (
        (1,), IN_ARRAY | {"fiducials": [{"fiducial_id": 7} | {
            f"{axis}{i}": CORNERS[i][j] for i in range(4) for j, axis in enumerate("xy")}]},
        ("", "7", None, True, False),
    ),
}  # fmt: skip


INFO = "sensor_msgs/msg/CameraInfo"
K = [500.0, 0, 320, 0, 510, 240, 0, 0, 1]
#: ROS 1 writes K, D, R and P in capitals.
INTRINSICS = {
    "header": header(T0, "cam"), "width": 640, "height": 480, "distortion_model": "plumb_bob",
    "D": [0.1, 0.2, 0.0, 0.0, 0.3], "K": K, "R": np.eye(3).ravel(), "P": np.eye(3, 4).ravel(),
}  # fmt: skip
BUNDLE = IN_ARRAY | {"detections": [{"id": [7, 8], "size": [0.1, 0.1], "pose": STAMPED}]}


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> dict[int, list[Any]]:
    """Of ROS 1 and ROS 2: what one bag with all these messages has, each on a topic of its type's name."""
    folder, found = tmp_path_factory.mktemp("bags"), {}
    for version, path in ((1, folder / "in.bag"), (2, folder / "in")):
        messages = [(name, name, of[1], T0 + 5) for name, of in MESSAGES.items() if version in of[0]]
        if version == 1:
            name = "apriltag_ros/msg/AprilTagDetectionArray"
            messages += [("bundle", name, BUNDLE, T0 + 6), ("bundle", name, IN_ARRAY, T0 + 7)]
            messages += [(INFO, INFO, INTRINSICS, T0 + 8)]
        convert_ros_bag(bag(path, version, messages), folder / f"{version}.mcap")
        found[version] = read(folder / f"{version}.mcap")
    return found


@pytest.mark.parametrize(
    ("name", "version"), [(name, version) for name in sorted(MESSAGES) for version in MESSAGES[name][0]]
)
def test_each_driver(records: dict[int, list[Any]], name: str, version: int) -> None:
    _, _, (family, id_, size, has_corners, has_pose) = MESSAGES[name]
    (record,) = (each for each in records[version] if each.topic == name)
    assert isinstance(record, DetectionRecord)
    assert (record.family, record.id, record.size_m, record.frame, record.stamp_ns) == (family, id_, size, "cam", T0)
    if has_corners:
        np.testing.assert_array_equal(record.corners_px, CORNERS)
    else:
        assert record.corners_px is None
    if has_pose:
        np.testing.assert_allclose(record.T_camera_tag, T_EXPECTED, atol=1e-15)
    else:
        assert record.T_camera_tag is None


def test_bundles_and_intrinsics_of_ros_1(records: dict[int, list[Any]]) -> None:
    (bundle,) = (each for each in records[1] if each.topic == "bundle")
    assert (bundle.id, bundle.size_m) == ("7,8", None)
    (info,) = (each for each in records[1] if each.topic == INFO)
    assert isinstance(info, IntrinsicsRecord)
    assert (info.K.ravel().tolist(), info.D.tolist()) == (K, INTRINSICS["D"])


def test_the_first_version_of_apriltag_msgs(tmp_path: Path) -> None:
    name = "apriltag_msgs/msg/AprilTagDetection"
    fields = IN_ARRAY | {"detections": [TAG | {"corners": np.ravel(CORNERS)}]}
    old = bag(tmp_path / "old", 2, [("/tags", f"{name}Array", fields, T0)], {name: FIRST_APRILTAG})
    convert_ros_bag(old, tmp_path / "old.mcap")
    (record,) = read(tmp_path / "old.mcap")
    np.testing.assert_array_equal(record.corners_px, CORNERS)


DEFINITION = """# every kind of field
uint8 LIMIT=7
string NAME = "a # b"
bool flag
int16[] numbers
string<=10[<=3] words
Inner[2] pair
float32 value 1.5
================================================================================
MSG: my_msgs/Inner
uint8 small
float64[<=4] wide
"""


def encoded(tmp_path: Path, message: Any) -> bytes:
    path = tmp_path / "a.mcap"
    with open(path, "wb") as stream, Writer(stream) as writer:
        writer.write_message("/a", writer.register_msgdef("my_msgs/msg/Outer", DEFINITION), message, log_time=0)
    with open(path, "rb") as stream:
        ((_, _, written),) = make_reader(stream).iter_messages()
    return written.data


def test_every_kind_of_field(tmp_path: Path) -> None:
    inner = [SimpleNamespace(small=1, wide=[1.5, 2.5]), SimpleNamespace(small=2, wide=[])]
    message = SimpleNamespace(flag=True, numbers=[-1, 2, 300], words=["one", "", "drei"], pair=inner, value=0.25)
    ((places, batch),) = MessageType("my_msgs/msg/Outer", DEFINITION).batches([encoded(tmp_path, message)] * 3)
    assert places == [0, 1, 2]
    assert isinstance(batch, Batch)
    tree = batch.shape.tree
    assert tree["words"] == ["one", "", "drei"]
    np.testing.assert_array_equal(batch.numbers(tree, "numbers"), [[-1, 2, 300]] * 3)
    np.testing.assert_array_equal(batch.numbers(tree["pair"][0], "wide"), [[1.5, 2.5]] * 3)
    assert batch.numbers(tree["pair"][1], "wide").shape == (3, 0)
    assert batch.numbers(tree["pair"][1], "small").tolist() == [2, 2, 2]
    assert batch.numbers(tree, "value").tolist() == [0.25] * 3


def test_big_endian_and_xcdr2() -> None:
    definition = "uint8 a\nfloat64 b"
    padded = {0: ">", 1: "<", 6: ">", 7: "<"}
    for kind, order in padded.items():
        gap = 7 if kind < 6 else 3
        message = bytes([0, kind, 0, 0, 5]) + bytes(gap) + struct.pack(order + "d", 2.5)
        ((_, batch),) = MessageType("m/T", definition).batches([message])
        assert isinstance(batch, Batch)
        assert batch.numbers(batch.shape.tree, "b").tolist() == [2.5]


@pytest.mark.parametrize(
    ("definition", "words"),
    [
        ("", "no definition of its fields"),
        ("7 dwarfs", "cannot read the line"),
        ("wstring w", "wide strings"),
        (f"uint8[{'9' * 5000}] x", "cannot read the line"),
    ],
)
def test_definitions_that_cannot_be_read(definition: str, words: str) -> None:
    with pytest.raises(MessageError, match=words):
        MessageType("my_msgs/T", definition)


@pytest.mark.parametrize(
    ("definition", "content", "words"),
    [
        ("T t", bytes(99), "deep"),
        ("Unknown u", bytes(99), "no definition of m/Unknown"),
        ("Empty[] e\n====\nMSG: m/Empty\n", b"\xff" * 200_000, "a list of 4294967295 m/Empty; at most 100000"),
        ("uint8[] x", b"\xff\xff\xff\xff", "ends after 8 bytes"),
        ("string s", b"\x02\0\0\0\xff\0", "not UTF-8"),
    ],
)
def test_messages_that_cannot_be_read(definition: str, content: bytes, words: str) -> None:
    ((_, error),) = MessageType("m/T", definition).batches([b"\0\1\0\0" + content])
    assert isinstance(error, MessageError)
    assert any(word in str(error) for word in words.split("|")), error


@given(definition=st.text(max_size=60) | definitions, content=st.binary(max_size=60) | cdr_messages)
def test_any_definition_and_bytes(definition: str, content: bytes) -> None:
    try:
        message_type = MessageType("m/T", definition)
    except MessageError:
        return
    for _, batch in message_type.batches([b"\0\1\0\0" + content, content]):
        assert isinstance(batch, Batch | MessageError)
