"""Detections on disk: every bit comes back, a torn line costs its own batch, and other inputs are told."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from gtsam_rwhec.detect.detections import Detection, ImageDetections, Rejection
from gtsam_rwhec.detect.many_images import DetectedImage
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.logs import ImageRecord
from gtsam_rwhec.runs.kept_detections import KeptDetections, differences, kept_inputs

INPUTS = {"file run.mcap": "12 bytes, changed at 5 ns"}


def found(number: int) -> list[DetectedImage]:
    """What two images of a batch may have: a detection with numbers of every kind, and a fault."""
    rng = np.random.default_rng(number)
    covariance = rng.standard_normal((2, 6, 6))
    covariance[1] = np.nan
    detection = Detection(
        "board", rng.standard_normal((5, 2)).astype(np.float32), np.arange(5), rng.standard_normal((2, 4, 4)),
        np.array([-0.0, np.inf]), rng.standard_normal(2), covariance, 1 / 3, float("nan"), Rejection.GRAZING,
    )  # fmt: skip
    seen = ImageDetections((detection,), {("tag36h11", 7): 2})
    return [DetectedImage("/cam", 2 * number, seen), DetectedImage("/cam", 2 * number + 1, None, "cut short")]


def images(number: int) -> list[ImageRecord]:
    return [ImageRecord(0, stamp, "/cam", "cam", "png", b"") for stamp in (2 * number, 2 * number + 1)]


def assert_same(a: list[DetectedImage], b: list[DetectedImage]) -> None:
    for one, other in zip(a, b, strict=True):
        assert (one.topic, one.stamp_ns, one.fault) == (other.topic, other.stamp_ns, other.fault)
        if one.found is None or other.found is None:
            assert one.found is other.found is None
            continue
        assert one.found.strangers == other.found.strangers
        (first,), (second,) = one.found.detections, other.found.detections
        for field in fields(Detection):
            x, y = getattr(first, field.name), getattr(second, field.name)
            if isinstance(x, np.ndarray):
                assert (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes())
            else:
                assert repr(x) == repr(y)
                assert type(x) is type(y)


def filled(path: Path, batches: int = 3) -> KeptDetections:
    kept = KeptDetections(path, INPUTS, 2 * batches)
    for number in range(batches):
        kept.keep(number, found(number))
    return kept


def opened(path: Path) -> KeptDetections:
    kept = KeptDetections(path, INPUTS, 6)
    kept.go_on()
    return kept


def test_every_bit_comes_back(tmp_path: Path) -> None:
    kept = filled(tmp_path / "kept")
    for each in (kept, opened(tmp_path / "kept")):
        assert each.done == 6
        assert not each.is_whole
        for number in range(3):
            again = each.known(number, images(number))
            assert again is not None
            assert_same(again, found(number))
        assert each.known(3, images(3)) is None
        assert each.known(0, images(1)) is None  # of other images
    kept.finish()
    kept.close()
    whole = opened(tmp_path / "kept")
    assert whole.is_whole
    assert_same(list(whole.all()), [image for number in range(3) for image in found(number)])
    assert kept_inputs(tmp_path / "kept") == INPUTS


@pytest.mark.parametrize("cut", [1, 20, 700])
def test_a_torn_line_costs_its_own_batch(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "kept"
    filled(path).close()
    path.write_bytes(path.read_bytes()[:-cut])
    kept = opened(path)
    assert kept.done == 4
    assert kept.known(2, images(2)) is None
    kept.keep(2, found(2))
    kept.close()
    again = opened(path).known(2, images(2))
    assert again is not None
    assert_same(again, found(2))


def test_a_changed_byte_costs_what_is_behind_it(tmp_path: Path) -> None:
    path = tmp_path / "kept"
    filled(path).close()
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([*lines[:2], lines[2].replace(b'"count":2', b'"count":3'), lines[3]]))
    assert opened(path).done == 2
    path.write_bytes(lines[0][:-5])
    assert kept_inputs(path) is None
    assert kept_inputs(tmp_path / "nothing") is None


def test_a_full_disk_is_said(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"kept cannot be written"):
        KeptDetections(tmp_path / "gone" / "kept", INPUTS, 2).keep(0, found(0))


def test_what_differs_is_named() -> None:
    before = {
        "OpenCV": "4.12.0", "file a.png": "5 bytes, stamp image 1", "file b.png": "5 bytes, stamp image 2",
        "file c.png": "5 bytes, stamp image 3", "targets.board.square_m": "0.05",
    }  # fmt: skip
    now = {
        "OpenCV": "4.12.0", "file b.png": "5 bytes, stamp image 1", "file c.png": "6 bytes, stamp image 3",
        "targets.board.square_m": "0.06", "file d.png": "5 bytes, stamp image 4",
    }  # fmt: skip
    assert differences(before, before) == ""
    assert differences(before, now) == (
        "a.png is gone; b.png has another pose, or another place in its folder; c.png was changed; "
        "targets.board.square_m was 0.05 and is 0.06; d.png is new"
    )
    assert differences({}, {f"file {n}": "" for n in range(9)}).endswith("4 is new; and 4 more")
