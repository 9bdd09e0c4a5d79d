"""MCAP files of every layout, and what strangers' files can have in them."""

from __future__ import annotations

import struct
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from log_files import POSE, TRANSFORM, header, json_log, ros2_log, xyz
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from read_logs import BARE, LOOSE, T0, protobuf_log, read

from gtsam_rwhec.errors import LogError, LogWarning, MessageError, RwhecError
from gtsam_rwhec.logs import PoseRecord, open_log


def pose_messages(count: int) -> list[Any]:
    """Poses along x, with frame names and so lengths that change."""
    return [
        (
            f"/{i % 3}", "geometry_msgs/PoseStamped",
            {"header": header(T0 + i, "w" * (1 + i % 5)), "pose": {**POSE, "position": xyz(i, 0, 0)}}, T0 + i,
        )
        for i in range(count)
    ]  # fmt: skip


@pytest.mark.parametrize("compression", list(CompressionType))
def test_messages_of_many_shapes_come_in_order(tmp_path: Path, compression: CompressionType) -> None:
    path = ros2_log(tmp_path / "a.mcap", pose_messages(5000), compression, chunk_size=20_000)
    records = read(path)
    assert [r.T[0, 3] for r in records] == list(range(5000))
    assert [len(r.parent) for r in records[:5]] == [1, 2, 3, 4, 5]
    with open_log(path) as log:
        assert [(t.name, t.count) for t in log.topics()] == [("/0", 1667), ("/1", 1667), ("/2", 1666)]
        assert len(list(log.records(["/1"]))) == 1667


def test_order_across_chunks_and_files_that_overlap(tmp_path: Path) -> None:
    messages = pose_messages(600)
    rng = np.random.default_rng(0)
    for name, part in (("a", messages[::2]), ("b", messages[1::2])):
        ros2_log(tmp_path / f"{name}.mcap", [part[i] for i in rng.permutation(300)], chunk_size=3000)
    assert [r.logged_ns for r in read(tmp_path)] == [T0 + i for i in range(600)]


@pytest.mark.parametrize("chunk_size", [3000, 10_000_000])
def test_records_of_some_log_times(tmp_path: Path, chunk_size: int) -> None:
    path = ros2_log(tmp_path / "a.mcap", pose_messages(600), chunk_size=chunk_size)
    wanted = [T0 + 299, T0 + 3, T0 + 4, T0 + 10_000]
    with open_log(path) as log:
        opened: list[object] = []
        of_file = log.files[0].open
        log.files[0].open = lambda block: opened.append(block) or of_file(block)  # type: ignore[method-assign, func-returns-value]
        found = list(log.records_logged_at(["/0", "/2"], wanted))
        assert sorted((r.topic, r.logged_ns) for r in found) == [("/0", T0 + 3), ("/2", T0 + 299)]
        assert [r.T[0, 3] for r in found if isinstance(r, PoseRecord)] in ([3.0, 299.0], [299.0, 3.0])
        assert len(opened) <= 2 < len(log.files[0].blocks) or len(log.files[0].blocks) == 1
        with pytest.raises(LogError, match="no topic /9"):
            list(log.records_logged_at(["/9"], wanted))


def json_poses(count: int) -> list[Any]:
    time = {"sec": 1, "nsec": 0}
    message = {"timestamp": time, "frame_id": "w", "pose": POSE}
    return [("/pose", "foxglove.PoseInFrame", message, i) for i in range(count)]


@pytest.mark.parametrize("options", [LOOSE, BARE, {**LOOSE, **BARE}])
def test_files_without_index(tmp_path: Path, options: dict[str, Any]) -> None:
    path = json_log(tmp_path / "a.mcap", json_poses(100), **options)
    with warnings.catch_warnings(action="error"):
        assert len(read(path)) == 100
    with open_log(path) as log:
        (topic,) = log.topics()
    assert (topic.name, topic.count, topic.first_ns, topic.last_ns) == ("/pose", 100, 0, 99)


@pytest.mark.parametrize("options", [{"chunk_size": 2000}, LOOSE])
def test_truncated_file_is_read_as_far_as_it_goes(tmp_path: Path, options: dict[str, Any]) -> None:
    path = json_log(tmp_path / "a.mcap", json_poses(200), **options)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.warns(LogWarning, match=r"a\.mcap ends too early.*bytes .* are lost"):
        log = open_log(path)
    with log:
        assert 50 < len(list(log.records())) < 150


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_chunk_that_breaks_off_gives_what_there_is_of_it(tmp_path: Path, compression: CompressionType) -> None:
    # Positions at random, or compression would leave no part to cut off.
    messages = pose_messages(20_000)
    numbers = np.random.default_rng(0).normal(size=(20_000, 3))
    for (_, _, message, _), xyz_ in zip(messages, numbers, strict=True):
        message["pose"]["position"] = xyz(*xyz_)
    path = ros2_log(tmp_path / "a.mcap", messages, compression, chunk_size=1 << 24)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.warns(LogWarning, match=r"lost, but for \d+ messages of the chunk that breaks off"):
        records = read(path)
    assert 5_000 < len(records) < 20_000
    for record, expected in zip(records, numbers, strict=False):
        np.testing.assert_array_equal(record.T[:3, 3], expected)


def test_reading_takes_at_most_three_times_what_going_through_takes(tmp_path: Path) -> None:
    path = ros2_log(tmp_path / "a.mcap", pose_messages(20_000))

    def undecoded() -> int:
        with open(path, "rb") as stream:
            return sum(1 for _ in make_reader(stream).iter_messages())

    def seconds(call: Callable[[], int]) -> float:
        start = time.perf_counter()
        assert call() == 20_000
        return time.perf_counter() - start

    ratios = [seconds(lambda: len(read(path))) / seconds(undecoded) for _ in range(3)]
    assert min(ratios) < 3, ratios


def test_damaged_chunk_costs_its_own_messages(tmp_path: Path) -> None:
    path = ros2_log(tmp_path / "a.mcap", pose_messages(300), CompressionType.NONE, chunk_size=10_000)
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 255
    path.write_bytes(content)
    with pytest.warns(LogWarning, match="wrong checksum"):
        records = read(path)
    assert 150 < len(records) < 300
    with pytest.raises(LogError, match="wrong checksum"):
        read(path, on_bad="raise")


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_decompression_is_bounded(tmp_path: Path, compression: str) -> None:
    bomb = getattr(CompressionType, compression.upper())
    path = tmp_path / "a.mcap"
    with open(path, "wb") as stream:
        writer = McapWriter(stream, compression=bomb, chunk_size=1 << 30)
        writer.start()
        channel = writer.register_channel(
            "/x", "json", writer.register_schema("foxglove.PoseInFrame", "jsonschema", b"")
        )
        writer.add_message(channel, 0, bytes(1 << 24), 0)
        writer.finish()
    content = path.read_bytes()
    with open_log(path) as log:
        (block,) = log.files[0].blocks
    at = block.offset + 9 + 16  # the chunk's stated size follows its record's head and two stamps
    for claim, words in ((1000, "1001 bytes after decompression"), (1 << 40, "beyond the limit")):
        path.write_bytes(content[:at] + struct.pack("<Q", claim) + content[at + 8 :])
        with pytest.warns(LogWarning, match=words):
            assert read(path) == []


def test_bad_messages_are_left_out_and_said(tmp_path: Path) -> None:
    bad = {"header": header(T0), "pose": {**POSE, "orientation": xyz(0, 0, 0, 0)}}
    nan = {"header": header(T0), "pose": {**POSE, "position": xyz(np.nan, 0, 0)}}
    messages = [*pose_messages(3), *[("/0", "geometry_msgs/PoseStamped", m, T0 + 9) for m in (bad, nan)]]
    path = ros2_log(tmp_path / "a.mcap", messages)
    with pytest.warns(LogWarning, match=r"topic /0: 2 left out, the first: .*norm 0 in place of 1"):
        assert len(read(path)) == 3
    with pytest.raises(MessageError, match="norm 0"):
        read(path, on_bad="raise")


def test_ros2_and_json_give_the_same(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    ros2: list[Any] = []
    foxglove: list[Any] = []
    for i in range(50):
        q = rng.normal(size=4)
        pose = {"position": xyz(*rng.normal(size=3)), "orientation": xyz(*q / np.linalg.norm(q))}
        stamp = header(T0 + i)
        ros2.append(("/a", "geometry_msgs/PoseStamped", {"header": stamp, "pose": pose}, T0 + i))
        time = {"sec": stamp["stamp"]["sec"], "nsec": stamp["stamp"]["nanosec"]}
        foxglove.append(("/a", "foxglove.PoseInFrame", {"timestamp": time, "frame_id": "world", "pose": pose}, T0 + i))
    with open_log(ros2_log(tmp_path / "a.mcap", ros2)) as a, open_log(json_log(tmp_path / "b.mcap", foxglove)) as b:
        one, other = a.poses("/a"), b.poses("/a")
    np.testing.assert_array_equal(one.T, other.T)
    np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)
    assert (one.parent, one.child) == (other.parent, other.child)


def test_missing_and_unreadable_topics(tmp_path: Path) -> None:
    path = ros2_log(tmp_path / "a.mcap", [*pose_messages(1), ("/text", "std_msgs/String", {"data": "hello"}, T0)])
    assert len(read(path)) == 1
    with pytest.raises(LogError, match=r"no topic /nothing; it has: /0 \(geometry_msgs/msg/PoseStamped\), /text"):
        read(path, topics=["/nothing"])
    with pytest.raises(LogError, match=r"/text: schema 'std_msgs/msg/String' .* is not read"):
        read(path, topics=["/text"])


def test_pose_series(tmp_path: Path) -> None:
    transforms = [
        {"header": header(T0 - i, "base"), "child_frame_id": f"c{i % 2}", "transform": TRANSFORM} for i in range(10)
    ]
    path = ros2_log(
        tmp_path / "a.mcap", [("/tf", "tf2_msgs/TFMessage", {"transforms": [t]}, i) for i, t in enumerate(transforms)]
    )
    with open_log(path) as log:
        series = log.poses("/tf", child="c1")
        assert (series.parent, series.child) == ("base", "c1")
        assert series.stamps_ns.tolist() == [T0 - 9, T0 - 7, T0 - 5, T0 - 3, T0 - 1]
        assert series.T.shape == (5, 4, 4)
        with pytest.raises(LogError, match="base to c0; base to c1"):
            log.poses("/tf")


@pytest.mark.parametrize("content", [b"", b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n"[:5], bytes(100)])
def test_not_mcap(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=r"a\.mcap is not an MCAP file"):
        open_log(path)


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="no MCAP files"):
        open_log(tmp_path)
    with pytest.raises(LogError, match="cannot be read: No such file"):
        open_log(tmp_path / "a.mcap")


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    folder = tmp_path_factory.mktemp("seeds")
    stamped = {"header": header(T0), "child_frame_id": "c", "transform": TRANSFORM}
    ros2 = [*pose_messages(4), ("/tf", "tf2_msgs/TFMessage", {"transforms": [stamped]}, T0)]
    paths = [
        ros2_log(folder / "a.mcap", ros2, CompressionType.NONE, enable_crcs=False),  # so that what is inside is reached
        ros2_log(folder / "b.mcap", ros2),
        json_log(folder / "c.mcap", json_poses(3), compression=CompressionType.LZ4),
        json_log(folder / "d.mcap", json_poses(3), **LOOSE),
        json_log(folder / "e.mcap", json_poses(3), compression=CompressionType.NONE, enable_crcs=False),
        protobuf_log(folder / "f.mcap", compression=CompressionType.NONE, enable_crcs=False),
    ]
    return [path.read_bytes() for path in paths]


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_bytes_give_records_or_an_error_of_ours(tmp_path: Path, seeds: list[bytes], data: st.DataObject) -> None:
    content = bytearray(data.draw(st.sampled_from(seeds)))
    for _ in range(data.draw(st.integers(0, 6))):
        at = data.draw(st.integers(8, len(content) - 1))
        patch = data.draw(st.binary(min_size=1, max_size=8))
        content[at : at + len(patch)] = patch
    content = content[: data.draw(st.integers(8, len(content)))] if data.draw(st.booleans()) else content
    path = tmp_path / "fuzzed.mcap"
    path.write_bytes(content)
    with warnings.catch_warnings(action="ignore", category=LogWarning):
        try:
            for record in read(path):
                assert not isinstance(record, PoseRecord) or np.isfinite(record.T).all()
        except RwhecError:
            pass
