"""What is written comes back; what is copied is the same bytes; what fails leaves nothing behind."""

from __future__ import annotations

import errno
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_files import POSE, header, ros2_log
from mcap.reader import make_reader
from rwhec_factors import se3
from strategies import changed_trees, damaged

from gtsam_rwhec.errors import LogError, LogWarning
from gtsam_rwhec.files.budgets import Spending
from gtsam_rwhec.logs import DetectionRecord, IntrinsicsRecord, LogWriter, PairRecord, PoseRecord, open_log
from gtsam_rwhec.logs.foxglove_messages import JSON, foxglove_decoder, parse_json

T0 = 1_700_000_000_000_000_001
T = se3.expmap(np.random.default_rng(0).normal(size=(4, 6)))


def read(path: Path) -> list[Any]:
    with open_log(path) as log:
        return list(log.records())


def test_poses_and_transforms_come_back(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    with LogWriter(path) as out:
        out.transforms("/tf", T0, [("rig", "cam", T[0]), ("world", "tag", T[1])])
        out.poses("/tags", T0 + 1, "cam", T[2:])
    records = read(path)
    assert all(isinstance(record, PoseRecord) for record in records)
    assert [(r.parent, r.child, r.stamp_ns) for r in records] == [
        ("rig", "cam", T0), ("world", "tag", T0), ("cam", "", T0 + 1), ("cam", "", T0 + 1),
    ]  # fmt: skip
    for record, pose in zip(records, T, strict=True):
        np.testing.assert_allclose(record.T, pose, atol=1e-15)


def test_detections_and_pairs_come_back(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    corners, covariance = np.arange(8.0).reshape(4, 2) / 3, np.diag(np.arange(1.0, 7) / 7)
    tag = DetectionRecord(0, 0, "", "", "36h11", "7", corners, T[0], covariance, 0.1)
    bare = DetectionRecord(0, 0, "", "", "36h11", "8")
    pair = PairRecord(T0 + 1, T0 + 1, "/pairs", "tag", "cam", T[1], T[2], is_inlier=False, reason="too fast")
    with LogWriter(path) as out:
        out.detections("/detections", T0, "cam", [tag, bare])
        out.pair(pair)
    seven, eight, back = read(path)
    np.testing.assert_array_equal(seven.corners_px, corners)
    np.testing.assert_array_equal(seven.covariance, covariance)
    np.testing.assert_allclose(seven.T_camera_tag, T[0], atol=1e-15)
    assert (seven.frame, seven.stamp_ns, seven.size_m, eight.corners_px) == ("cam", T0, 0.1, None)
    np.testing.assert_array_equal(back.A, T[1])
    np.testing.assert_array_equal(back.B, T[2])
    assert (back.target, back.sensor, back.is_inlier, back.reason) == ("tag", "cam", False, "too fast")


def test_a_pair_with_entries_that_cannot_be_squared_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    huge = T[1].copy()
    huge[:3, :3] *= 1e200
    with LogWriter(path) as out:
        out.pair(PairRecord(T0, T0, "/pairs", "tag", "cam", T[1], huge, is_inlier=True))
    with pytest.warns(LogWarning, match="B is not a transform"):
        assert read(path) == []


@pytest.fixture(scope="module")
def own_messages(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, bytes]]:
    """Schema and JSON of a message of each kind that this library writes and reads."""
    path = tmp_path_factory.mktemp("own") / "out.mcap"
    corners, covariance = np.arange(8.0).reshape(4, 2), np.eye(6)
    with LogWriter(path) as out:
        out.transforms("/tf", T0, [("rig", "cam", T[0])])
        out.poses("/poses", T0, "cam", T[2:])
        out.detections(
            "/tags", T0, "cam", [DetectionRecord(0, 0, "", "", "36h11", "7", corners, T[0], covariance, 0.1)]
        )
        out.pair(PairRecord(T0, T0, "/pairs", "tag", "cam", T[1], T[2], is_inlier=True, covariance=covariance))
        out.calibration(
            IntrinsicsRecord(T0, T0, "/i", "c", 640, 480, "", 500 * np.eye(3), np.zeros(5), np.eye(3), T[0, :3])
        )
        out.compressed_image("/image", T0, "cam", "png", b"abc")
    with open(path, "rb") as stream:
        return [(schema.name, message.data) for schema, _, message in make_reader(stream).iter_messages() if schema]


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_any_message_gives_records_or_a_sentence(own_messages: list[tuple[str, bytes]], data: st.DataObject) -> None:
    schema, message = data.draw(st.sampled_from(own_messages))
    content = data.draw(damaged([message]) | changed_trees(json.loads(message)).map(lambda t: json.dumps(t).encode()))
    take = Spending(Path("a.mcap"), len(content)).take_parts
    read_one = foxglove_decoder(schema, partial(parse_json, take=take), JSON, take)
    (found,) = read_one("/topic", [content], [0])
    assert all(record.topic == "/topic" for record in found) if not isinstance(found, str) else 0 < len(found) < 5000


def test_calibrations_come_back(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    K, P = np.array([[520.1, 0, 322.3], [0, 518.7, 238.9], [0, 0, 1]]), np.arange(12.0).reshape(3, 4) / 7
    given = [
        IntrinsicsRecord(T0, T0, "/left/info", "left", 640, 480, "plumb_bob", K, np.arange(5) / 3, T[0][:3, :3], P),
        IntrinsicsRecord(T0 + 1, T0 + 1, "/wide/info", "wide", 320, 240, "kannala_brandt", K / 2, K[0], np.eye(3), P),
        IntrinsicsRecord(T0 + 2, T0 + 2, "/bare/info", "bare", 8, 6, "", K, np.zeros(0), np.eye(3), P),
    ]
    with LogWriter(path) as out:
        for intrinsics in given:
            out.calibration(intrinsics)
    for back, intrinsics in zip(read(path), given, strict=True):
        assert isinstance(back, IntrinsicsRecord)
        for name in ("logged_ns", "stamp_ns", "topic", "frame", "width", "height", "model"):
            assert getattr(back, name) == getattr(intrinsics, name)
        for name in "KDRP":
            np.testing.assert_array_equal(getattr(back, name), getattr(intrinsics, name))


def test_annotations_metadata_and_attachments(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    with LogWriter(path) as out:
        out.annotations("/seen", T0, [("tag 7", np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]))])
        out.metadata("certificate", {"gap": "1e-9"})
        out.attachment("result.json", "application/json", b"{}")
    with open(path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        ((schema, _, message),) = reader.iter_messages()
        assert schema is not None
        assert (schema.name, message.log_time) == ("foxglove.ImageAnnotations", T0)
        assert b'"text": "tag 7"' in message.data
        assert [m.metadata for m in reader.iter_metadata()] == [{"gap": "1e-9"}]
        assert [(a.name, a.data) for a in reader.iter_attachments()] == [("result.json", b"{}")]
    with open_log(path) as log:
        assert log.metadata() == {"certificate": {"gap": "1e-9"}}
        assert (log.attachment("result.json"), log.attachment("nothing")) == (b"{}", None)


def raw_log(path: Path) -> Path:
    image = {"header": header(T0), "format": "jpeg", "data": b"\xff" * 99}
    messages: list[Any] = []
    for i in range(200):
        messages.append(("/pose", "geometry_msgs/PoseStamped", {"header": header(T0 + i), "pose": POSE}, T0 + i))
        messages.append(("/image", "sensor_msgs/CompressedImage", image, T0 + i))
    return ros2_log(path, messages, chunk_size=2000)


def contents(path: Path) -> list[Any]:
    with open(path, "rb") as stream:
        return [
            (s.name, s.encoding, s.data, c.topic, c.message_encoding, m.log_time, m.publish_time, m.sequence, m.data)
            for s, c, m in make_reader(stream).iter_messages()
            if s is not None
        ]


def test_copies_are_the_same_bytes(tmp_path: Path) -> None:
    raw, copy, small = raw_log(tmp_path / "raw.mcap"), tmp_path / "copy.mcap", tmp_path / "small.mcap"
    with open_log(raw) as log, LogWriter(copy) as out, LogWriter(small) as without:
        assert out.copy(log) == 400
        assert without.copy(log, images="leave_out") == 200
    assert contents(copy) == contents(raw)
    assert contents(small) == [entry for entry in contents(raw) if entry[3] == "/pose"]


def test_an_error_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "out.mcap"
    path.write_bytes(b"before")
    with pytest.raises(LogError, match="not finite"), LogWriter(path) as out:
        out.pair(PairRecord(T0, T0, "/p", "t", "c", np.full((4, 4), np.nan), T[1]))
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(number: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "out.mcap"
    monkeypatch.setattr("gtsam_rwhec.logs.mcap_writer.os.fsync", full)
    with pytest.raises(LogError, match=r"out\.mcap cannot be written: No space left"), LogWriter(path) as out:
        out.poses("/a", T0, "cam", T)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(LogError, match="cannot be written: No such file or directory"):
        LogWriter(tmp_path / "nowhere" / "out.mcap")


def test_what_cannot_be_written(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "out.mcap") as out:
        with pytest.raises(LogError, match=r"finite \(4, 4\)"):
            out.poses("/a", T0, "cam", T * np.nan)
        with pytest.raises(LogError, match="stamp -1 ns"):
            out.poses("/a", -1, "cam", T)
        with pytest.raises(LogError, match="not finite"):
            out.pair(PairRecord(T0, T0, "/p", "t", "c", np.full((4, 4), np.nan), T[1]))
        with pytest.raises(LogError, match="where its rotation should be"):
            out.transforms("/tf", T0, [("a", "b", np.diag([1.0, 1, -1, 1]))])
