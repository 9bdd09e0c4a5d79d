"""Rows are read back as they were written, to the last bit."""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np
import pytest

import gtsam_rwhec as rw
from gtsam_rwhec import fleet


def row() -> fleet.RobotRow:
    """One with a number that needs all digits, and with infinite variances."""
    T = np.eye(4)
    T[:3, 3] = 0.1, 1.0 / 3.0, -2e-17
    covariance = np.full((6, 6), 1.0 / 7.0)
    covariance[0, 0], covariance[0, 1], covariance[1, 0] = math.inf, -math.inf, -math.inf
    return fleet.RobotRow(
        "a@2026-11-22",
        "a",
        "hall",
        1,
        2,
        rw.Verdict.CARE,
        "few",
        (rw.Ground.FEW_MEASUREMENTS,),
        rw.Status.CERTIFIED,
        rw.Basis.MOMENTS,
        (fleet.RowFrame("cam_0", "sensor", T),),
        covariance,
        12.5,
        {"tag": 1.02},
        1e5,
        "ab",
        5,
        (fleet.FailedLog("s3://logs/a.mcap", "it is empty"),),
        400,
        {"too fast": 3},
        ("blurred",),
        0.25,
        1000,
        2000,
        ("k",),
        "robots/a/result.json",
    )


def test_they_are_read_back_bit_for_bit() -> None:
    given = (row(), fleet.RobotRow("b", "b", failure="no log of it could be read"))
    read = fleet.read_rows(fleet.rows_json(given), "rows.json")
    for before, after in zip(given, read, strict=True):
        for name in (one.name for one in fields(before) if one.name not in ("frames", "covariance", "scale")):
            assert getattr(after, name) == getattr(before, name), name
        assert [(f.name, f.kind, f.T.tobytes()) for f in after.frames] == [
            (f.name, f.kind, f.T.tobytes()) for f in before.frames
        ]
    assert read[0].covariance is not None
    assert read[0].covariance.tobytes() == row().covariance.tobytes()  # type: ignore[union-attr]
    assert read[0].scale == {"tag": 1.02}
    assert math.isnan(read[1].scale)  # type: ignore[arg-type]
    assert not read[0].is_fine


def test_rows_of_another_version_are_named() -> None:
    content = fleet.rows_json([row()]).replace(b'"format_version": 1', b'"format_version": 7')
    with pytest.raises(rw.errors.ResultVersionError, match=r"rows\.json has rows of format 7.*run the fleet again"):
        fleet.read_rows(content, "rows.json")


@pytest.mark.parametrize("content", [b"", b"[]", b"{}", b'{"format": "x"}', b"\xff"])
def test_other_files_are_refused(content: bytes) -> None:
    with pytest.raises(rw.errors.FileFormatError, match=r"rows\.json"):
        fleet.read_rows(content, "rows.json")
