"""Rows of a fleet as JSON and as Parquet: every number exact, other files refused."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from rwhec_factors import se3

import gtsam_rwhec as rw
from gtsam_rwhec import fleet
from gtsam_rwhec.fleet.fleet_rows import COLUMNS


def row() -> fleet.RobotRow:
    """One with a number that needs all digits, and with infinite variances."""
    T = se3.pose(np.eye(3), (0.1, 1.0 / 3.0, -2e-17))
    covariance = np.full((6, 6), 1.0 / 7.0)
    covariance[0, 0], covariance[0, 1], covariance[1, 0] = math.inf, -math.inf, -math.inf
    return fleet.RobotRow(
        "a@2026-11-22", "a", "hall", 1, 2, rw.Verdict.CARE, "few",
        grounds=(rw.Ground.FEW_MEASUREMENTS, rw.Ground.SYSTEMATIC), status=rw.Status.CERTIFIED,
        frames=(fleet.RowFrame("cam_0", "sensor", T),), covariance=covariance,
        constant_errors=((0.1,) * 6, (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)), degrees_of_freedom=12.5,
        scale={"tag": 1.02, "wall": 0.1 + 0.2}, measurements_sha256="ab", logs=5,
        failed_logs=(fleet.FailedLog("s3://logs/ä.mcap", "it is empty"),), measurements=400,
        removed={"too fast": 3, "standstill": 5}, findings=("blurred",), cpu_s=0.25, bytes_read=1000, peak_bytes=2000,
        result="robots/a/result.json",
    )  # fmt: skip


def same(one: object, other: object) -> bool:
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and one.dtype == other.dtype and np.array_equal(one, other)
    if isinstance(one, float):
        return one == other or (one != one and other != other)
    if isinstance(one, tuple) and one and hasattr(one[0], "T"):
        return [(f.name, f.kind, f.T.tobytes()) for f in one] == [(f.name, f.kind, f.T.tobytes()) for f in other]
    return one == other


@pytest.mark.parametrize(
    ("write", "read"), [(fleet.rows_json, fleet.read_rows), (fleet.rows_parquet, fleet.read_parquet)]
)
def test_they_are_read_back_bit_for_bit(write: Callable, read: Callable) -> None:
    given = (row(), replace(row(), scale=0.5, covariance=None), fleet.RobotRow("b", "b", failure="no log was read"))
    for before, after in zip(given, read(write(given), "rows"), strict=True):
        assert [f.name for f in fields(before) if not same(getattr(before, f.name), getattr(after, f.name))] == []
    assert not given[0].is_fine
    assert read(write(()), "rows") == ()


def test_rows_of_another_version_are_named() -> None:
    content = fleet.rows_json([row()]).replace(b'"format_version": 1', b'"format_version": 7')
    with pytest.raises(rw.errors.ResultVersionError, match=r"rows\.json has rows of format 7.*run the fleet again"):
        fleet.read_rows(content, "rows.json")


@pytest.mark.parametrize("content", [b"", b"[]", b"{}", b'{"format": "x"}', b"\xff"])
def test_other_files_are_refused(content: bytes) -> None:
    with pytest.raises(rw.errors.FileFormatError, match=r"rows\.json"):
        fleet.read_rows(content, "rows.json")


def test_others_read_parquet_with_units_and_meanings() -> None:
    table = pq.read_table(io.BytesIO(fleet.rows_parquet([row()])))
    assert table.column_names == [name for name, *_ in COLUMNS]
    assert {field.metadata[b"about"] != b"" for field in table.schema} == {True}
    assert table.column("begin_utc").cast("int64").to_pylist() == [1]
    assert table.column("largest_deviation_rad").to_pylist() == [math.inf]
    assert [len(T) for T in table.column("frame_poses_m").to_pylist()[0]] == [16]


def test_other_parquet_files_and_versions_are_refused() -> None:
    content = fleet.rows_parquet([row()])
    with pytest.raises(rw.errors.FileFormatError, match=r"x\.parquet cannot be read as Parquet"):
        fleet.read_parquet(content[:-20], "x.parquet")
    table = pq.read_table(io.BytesIO(content))

    def written(metadata: dict[str, str] | None) -> bytes:
        stream = io.BytesIO()
        pq.write_table(table.replace_schema_metadata(metadata), stream)
        return stream.getvalue()

    with pytest.raises(rw.errors.FileFormatError, match="no rows of a fleet"):
        fleet.read_parquet(written(None), "x.parquet")
    with pytest.raises(rw.errors.ResultVersionError, match="format 9"):
        fleet.read_parquet(written({"format": "gtsam-rwhec fleet rows", "format_version": "9"}), "x.parquet")
