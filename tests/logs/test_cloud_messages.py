"""Clouds in messages of ROS 2, of bags, and of Foxglove as JSON and protobuf; and what is written."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_files import foxglove_protobuf, json_log
from mcap_protobuf.writer import Writer as ProtobufWriter
from read_logs import T0, read
from ros_messages import bag, header

from gtsam_rwhec.clouds.cloud import Cloud
from gtsam_rwhec.clouds.named_fields import cloud_of_record, record_of_cloud
from gtsam_rwhec.errors import LogWarning
from gtsam_rwhec.logs import CloudRecord, LogWriter, convert_ros_bag

POINTS = np.random.default_rng(0).uniform(0.1, 1.0, (12, 3)).astype(np.float32)
#: A point as a driver of a LiDAR has it: four bytes of padding, and fields that begin where they like.
DRIVER = np.dtype({
    "names": ["x", "y", "z", "intensity", "ring", "t"], "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<u4"],
    "offsets": [0, 4, 8, 16, 20, 24], "itemsize": 32,
})  # fmt: skip
TYPES = {"f4": 7, "u2": 4, "u4": 6}


def table() -> np.ndarray:
    made = np.zeros(12, DRIVER)
    for i, axis in enumerate("xyz"):
        made[axis] = POINTS[:, i]
    made["intensity"], made["ring"], made["t"] = 0.5, np.arange(12), np.arange(12) * 1000
    return made


def message(**changed: Any) -> dict[str, Any]:
    fields = [
        {"name": name, "offset": DRIVER.fields[name][1], "datatype": TYPES[DRIVER[name].str[1:]], "count": 1}  # type: ignore[index]
        for name in DRIVER.names or ()
    ]
    return {
        "header": header(T0 + 5, "lidar"), "height": 1, "width": 12, "fields": fields, "is_bigendian": False,
        "point_step": 32, "row_step": 12 * 32, "data": np.frombuffer(table().tobytes(), np.uint8), "is_dense": True,
        **changed,
    }  # fmt: skip


@pytest.mark.parametrize("version", [1, 2])
def test_a_bag_s_clouds(tmp_path: Path, version: int) -> None:
    path = bag(
        tmp_path / ("a.bag" if version == 1 else "a"),
        version,
        [("/points", "sensor_msgs/msg/PointCloud2", message(), T0)],
    )
    assert convert_ros_bag(path, tmp_path / "a.mcap") == 1
    (record,) = read(tmp_path / "a.mcap")
    assert isinstance(record, CloudRecord)
    cloud = cloud_of_record(record)
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.rings is not None
    assert cloud.rings.tolist() == list(range(12))
    np.testing.assert_allclose(cloud.times_s, np.arange(12) * 1e-6)
    assert (cloud.stamp_ns, cloud.frame_id) == (T0 + 5, "lidar")


@pytest.mark.parametrize("shape", [None, (3, 4)])
def test_what_is_written_is_read_back(tmp_path: Path, shape: tuple[int, int] | None) -> None:
    points = POINTS.astype(float)
    points[7] = np.nan
    cloud = Cloud.of(points if shape is None else points.reshape(3, 4, 3), rings=np.arange(12))
    with LogWriter(tmp_path / "a.mcap") as out:
        out.point_cloud(record_of_cloud(cloud, "/points", T0, "camera"))
        out.point_cloud(record_of_cloud(None, "/points", T0 + 1, "camera"))
        out.point_cloud(record_of_cloud(Cloud.of(points + 1e-12), "/points", T0 + 2, "a frame"))
    first, nothing, exact = read(tmp_path / "a.mcap")
    again = cloud_of_record(first)
    np.testing.assert_array_equal(again.points, cloud.points)
    np.testing.assert_array_equal(again.rings, cloud.rings)
    assert again.shape == shape
    assert (nothing.width, nothing.data) == (0, b"")
    np.testing.assert_array_equal(cloud_of_record(exact).points, np.delete(points, 7, axis=0) + 1e-12)


def test_a_row_may_have_more_bytes_and_numbers_may_be_big_endian(tmp_path: Path) -> None:
    rows = np.zeros((3, 60), np.uint8)
    rows[:, :48] = np.frombuffer(POINTS.astype(">f4").tobytes(), np.uint8).reshape(3, 48)
    fields = tuple((axis, 4 * i, ">f4") for i, axis in enumerate("xyz"))
    with LogWriter(tmp_path / "a.mcap") as out:
        out.point_cloud(CloudRecord(T0, T0, "/points", "camera", 4, 3, 12, 60, fields, rows.tobytes()))
    (record,) = read(tmp_path / "a.mcap")
    np.testing.assert_array_equal(cloud_of_record(record).points, POINTS)


FOXGLOVE = {
    "timestamp": {"sec": T0 // 10**9, "nsec": T0 % 10**9}, "frame_id": "camera",
    "pose": {"position": {"x": 1.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0}},
    "point_stride": 12, "fields": [{"name": axis, "offset": 4 * i, "type": 7} for i, axis in enumerate("xyz")],
    "data": base64.b64encode(POINTS.tobytes()).decode(),
}  # fmt: skip


def test_foxglove_s_cloud_with_a_pose(tmp_path: Path) -> None:
    (record,) = read(json_log(tmp_path / "a.mcap", [("/points", "foxglove.PointCloud", FOXGLOVE, T0)]))
    np.testing.assert_allclose(cloud_of_record(record).points, POINTS * [-1.0, -1.0, 1.0] + [1.0, 0.0, 0.0], atol=1e-12)
    # In millimetres, the pose is in metres all the same.
    np.testing.assert_allclose(
        cloud_of_record(record, 1e-3).points, 1e-3 * POINTS * [-1.0, -1.0, 1.0] + [1.0, 0.0, 0.0], atol=1e-12
    )


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"data": "AAAA"}, "none|no points|PointCloud"),
        ({"point_stride": 8}, "ends beyond the 8 bytes of a point"),
        ({"fields": None}, "cannot be read as its schema"),
        ({"pose": {**FOXGLOVE["pose"], "orientation": dict.fromkeys("xyzw", 0.5) | {"w": 9.0}}}, "norm"),  # type: ignore[dict-item]
    ],
)
def test_a_damaged_cloud_is_named(tmp_path: Path, changed: dict[str, Any], words: str) -> None:
    path = json_log(tmp_path / "a.mcap", [("/points", "foxglove.PointCloud", FOXGLOVE | changed, T0)])
    if "data" in changed:
        (record,) = read(path)
        assert record.width == 0
        return
    with pytest.warns(LogWarning, match=words):
        assert read(path) == []


@pytest.mark.parametrize("times", [1, 20_000])
def test_foxglove_s_cloud_in_protobuf(tmp_path: Path, times: int) -> None:
    made = foxglove_protobuf()["PointCloud"](frame_id="camera", point_stride=12, data=POINTS.tobytes() * times)
    made.timestamp.FromNanoseconds(T0)
    for i, axis in enumerate("xyz"):
        made.fields.add(name=axis, offset=4 * i, type=7)
    with open(tmp_path / "a.mcap", "wb") as stream, ProtobufWriter(stream) as writer:
        writer.write_message("/points", made, log_time=T0, publish_time=T0)
    (record,) = read(tmp_path / "a.mcap")
    assert record.T_frame_points is None
    np.testing.assert_array_equal(cloud_of_record(record).points, np.tile(POINTS, (times, 1)))
    every = max(1, times * len(POINTS) // 4)
    np.testing.assert_array_equal(cloud_of_record(record, most=4).points, np.tile(POINTS, (times, 1))[::every])


def test_a_message_of_many_lists_is_refused_however_its_bytes_stand(tmp_path: Path) -> None:
    made = foxglove_protobuf()["PointCloud"](data=b"1" * 2_000_000)
    for _ in range(600_000):
        made.fields.add()
    with open(tmp_path / "a.mcap", "wb") as stream, ProtobufWriter(stream) as writer:
        writer.write_message("/points", made, log_time=T0, publish_time=T0)
    with pytest.warns(LogWarning, match="with lists in them"):
        assert read(tmp_path / "a.mcap") == []
