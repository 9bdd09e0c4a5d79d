"""ROS 1 and db3 bags, made with `rosbags`, become logs with the same poses."""

from __future__ import annotations

import bz2
import os
import re
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from limited_process import Reader

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs import open_log
from gtsam_rwhec.logs.ros_bags import convert_ros_bag

rosbag1 = pytest.importorskip("rosbags.rosbag1")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

T0 = 1_700_000_000_000_000_000
NAME = "geometry_msgs/msg/PoseStamped"


def bag_of_poses(path: Path, version: int, compression: Any = None) -> Path:
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC if version == 1 else typesys.Stores.ROS2_HUMBLE)
    types = store.types
    opened = rosbag1.Writer(path) if version == 1 else rosbag2.Writer(path, version=9)
    if compression is not None:
        opened.set_compression(*compression)
    with opened as writer:
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
    for _ in range(8):
        damaged = bytearray(content)
        for at in rng.integers(len(content), size=4):
            damaged[at] = rng.integers(256)
        file.write_bytes(damaged[: rng.integers(len(content))] if rng.random() < 0.3 else damaged)
        try:
            convert_ros_bag(bag, tmp_path / "out.mcap")
        except LogError:
            failed += 1
    assert failed > 0
    assert list(tmp_path.glob(".*")) == []


def records(content: bytes) -> list[tuple[int, int, dict[bytes, bytes], bytes]]:
    """Begin, end, header and data of each record of a ROS 1 bag."""
    found, at = [], content.index(b"\n") + 1
    while at < len(content):
        begins, (length,) = at, struct.unpack_from("<I", content, at)
        header, fields, at = content[at + 4 : at + 4 + length], {}, at + 4 + length
        while header:
            (size,) = struct.unpack_from("<I", header)
            name, _, value = header[4 : 4 + size].partition(b"=")
            fields[name], header = value, header[4 + size :]
        (length,) = struct.unpack_from("<I", content, at)
        found.append((begins, at + 4 + length, fields, content[at + 4 : at + 4 + length]))
        at += 4 + length
    return found


def bz2_bomb(folder: Path) -> Path:
    """A chunk of 80 kB becomes 2 GB."""
    bag = bag_of_poses(folder / "in.bag", 1, (rosbag1.Writer.CompressionFormat.BZ2,))
    content = bag.read_bytes()
    begins, ends, header, data = next(record for record in records(content) if record[2][b"op"] == b"\x05")
    more = bz2.compress(bytes(1 << 20)) * 2000
    old = content[begins:ends]
    new = old[: -len(data) - 4] + struct.pack("<I", len(data) + len(more)) + data + more
    _, _, first, _ = records(content)[0]
    moved = struct.pack("<Q", struct.unpack("<Q", first[b"index_pos"])[0] + len(more))
    changed = content[:begins].replace(b"index_pos=" + first[b"index_pos"], b"index_pos=" + moved)
    assert header[b"compression"] == b"bz2"
    bag.write_bytes(changed + new + content[ends:])
    return bag


def zstd_bomb(folder: Path) -> Path:
    """A message of 40 kB becomes 2 GB."""
    mode, kind = rosbag2.CompressionMode.MESSAGE, rosbag2.CompressionFormat.ZSTD
    bag = bag_of_poses(folder / "in", 2, (mode, kind))
    with sqlite3.connect(next(bag.glob("*.db3"))) as database:
        frame = zstandard.ZstdCompressor().compress(bytes(16 << 20))
        database.execute("UPDATE messages SET data = ?", (frame * 128,))
    database.close()
    return bag


def zstd_file_bomb(folder: Path) -> Path:
    """A file of 400 kB becomes 20 GB."""
    mode, kind = rosbag2.CompressionMode.FILE, rosbag2.CompressionFormat.ZSTD
    bag = bag_of_poses(folder / "in", 2, (mode, kind))
    frame = zstandard.ZstdCompressor().compress(bytes(16 << 20))
    next(bag.glob("*.zstd")).write_bytes(frame * 1280)
    return bag


def odd_metadata(folder: Path) -> Path:
    """A duration of text, which rosbags adds to a number."""
    bag = bag_of_poses(folder / "in", 2)
    metadata = bag / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("nanoseconds: 9", "nanoseconds: ten"))
    return bag


def odd_type(folder: Path) -> Path:
    """A type whose name is no name of Python: rosbags makes code of types."""
    bag = bag_of_poses(folder / "in.bag", 1)
    bag.write_bytes(bag.read_bytes().replace(b"type=geometry_msgs/PoseStamped", b"type=0eometry_msgs/PoseStamped"))
    return bag


def pipe(folder: Path) -> Path:
    os.mkfifo(folder / "in.bag")
    return folder / "in.bag"


BAD_BAGS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "bz2": (bz2_bomb, "it takes more memory than a bag of its size may"),
    "zstd message": (zstd_bomb, "it takes more memory than a bag of its size may"),
    "zstd file": (zstd_file_bomb, "it decompresses to more"),
    "metadata": (odd_metadata, "cannot be read as a ROS bag"),
    "type": (odd_type, "cannot be read as a ROS bag"),
    "pipe": (pipe, "is not a file"),
    "device": (lambda folder: Path("/dev/zero"), "is not a file"),
    "missing": (lambda folder: folder / "none.bag", "No such file"),
    "empty folder": (lambda folder: folder, "cannot be read as a ROS bag"),
}


@pytest.mark.parametrize("kind", BAD_BAGS)
def test_a_bag_that_means_harm_is_refused(tmp_path: Path, kind: str, reader: Reader) -> None:
    make, words = BAD_BAGS[kind]
    (tmp_path / "bags").mkdir()
    bag = make(tmp_path / "bags")
    reading = reader("bag", bag, out=str(tmp_path / "out.mcap"))
    assert reading.error == "LogError"
    assert re.search(words, reading.message)
    assert len(reading.message) < 1000
    assert [file.name for file in tmp_path.iterdir()] == ["bags"]
    assert max(reading.peak_bytes, reading.children_peak_bytes) < 500_000_000


def test_a_module_of_the_callers_folder_is_not_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = bag_of_poses(tmp_path / "in.bag", 1)
    (tmp_path / "rosbags.py").write_text("open('imported', 'w')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend("")
    assert convert_ros_bag("in.bag", "out.mcap") == len(range(10))
    assert bag.exists()
    assert not (tmp_path / "imported").exists()
