"""ROS 1 and db3 bags, made with `rosbags`, become logs with the same poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.logs.ros_bags import convert_ros_bag

rosbag1 = pytest.importorskip("rosbags.rosbag1")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

T0 = 1_700_000_000_000_000_000
NAME = "geometry_msgs/msg/PoseStamped"


def bag_of_poses(path: Path, version: int) -> Path:
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if version == 1 else typesys.Stores.ROS2_HUMBLE)
    types = store.types
    with rosbag1.Writer(path) if version == 1 else rosbag2.Writer(path, version=9) as writer:
        connection = writer.add_connection("/pose", NAME, typestore=store)
        for i in range(10):
            stamp = types["builtin_interfaces/msg/Time"](sec=T0 // 10**9, nanosec=i)
            number = {"seq": i} if version == 1 else {}
            message = types[NAME](
                header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="world", **number),
                pose=types["geometry_msgs/msg/Pose"](
                    position=types["geometry_msgs/msg/Point"](x=float(i), y=2.0, z=3.0),
                    orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.6, w=0.8),
                ),
            )
            raw = store.serialize_ros1(message, NAME) if version == 1 else store.serialize_cdr(message, NAME)
            writer.write(connection, T0 + i, raw)
    return path


@pytest.mark.parametrize("version", [1, 2])
def test_poses_are_the_same(tmp_path: Path, version: int) -> None:
    bag = bag_of_poses(tmp_path / ("in.bag" if version == 1 else "in"), version)
    out = tmp_path / "out.mcap"
    assert convert_ros_bag(bag, out) == 10
    with open_log(out) as log:
        series = log.poses("/pose")
    assert (series.parent, series.stamps_ns.tolist()) == ("world", [T0 + i for i in range(10)])
    np.testing.assert_array_equal(series.T[:, 0, 3], range(10))
    np.testing.assert_allclose(series.T[:, 0, 0], 0.28, atol=1e-15)


@pytest.mark.parametrize("name", ["garbage.bag", "garbage", "missing.bag"])
def test_what_is_no_bag(tmp_path: Path, name: str) -> None:
    bag, out = tmp_path / name, tmp_path / "out.mcap"
    if name == "garbage":
        bag.mkdir()
        (bag / "metadata.yaml").write_text("a: [")
    elif name == "garbage.bag":
        bag.write_bytes(b"garbage" * 100)
    with pytest.raises(LogError, match=name):
        convert_ros_bag(bag, out)
    assert not out.exists()
    assert list(tmp_path.glob(".*")) == []


@pytest.mark.parametrize("version", [1, 2])
def test_damaged_bags_give_messages_or_an_error_of_ours(tmp_path: Path, version: int) -> None:
    bag = bag_of_poses(tmp_path / ("in.bag" if version == 1 else "in"), version)
    file = bag if version == 1 else next(bag.glob("*.db3"))
    content = file.read_bytes()
    rng = np.random.default_rng(version)
    failed = 0
    for _ in range(40):
        damaged = bytearray(content)
        for at in rng.integers(len(content), size=4):
            damaged[at] = rng.integers(256)
        file.write_bytes(damaged[: rng.integers(len(content))] if rng.random() < 0.3 else damaged)
        try:
            convert_ros_bag(bag, tmp_path / "out.mcap")
        except LogError:
            failed += 1
    assert 0 < failed < 40
