"""Rows as Parquet: read back exactly, readable by others, and refused in words."""

from __future__ import annotations

import io
from dataclasses import fields, replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from robot_nights import day_ns, failed_night, robot_nights, with_free_height

from gtsam_rwhec.calibration.verdict import Ground
from gtsam_rwhec.errors import FileFormatError, ResultVersionError
from gtsam_rwhec.fleet.parquet import COLUMNS, read_parquet, rows_parquet
from gtsam_rwhec.fleet.rows import RobotRow
from gtsam_rwhec.solver.certificate import Basis, Status


@pytest.fixture(scope="module")
def rows() -> list[RobotRow]:
    first, second, third = robot_nights("arm_ä", 3)
    second = replace(
        second, scale={"board": 1.25, "wall": 0.1 + 0.2}, status=next(iter(Status)), basis=next(iter(Basis)),
        grounds=(Ground.NOT_UNIQUE, Ground.SYSTEMATIC), condition=1.0 / 3.0,
        constant_errors=((0.1,) * 6, (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)),
        removed={"standstill": 5, "fast motion": 7},
        findings=("slow clock",), receipts=("a" * 64,), degrees_of_freedom=112.0, begin_ns=day_ns(1) + 1,
    )  # fmt: skip
    return [first, second, with_free_height(third), replace(first, scale=0.5, covariance=None), failed_night("b", 4)]


def same(one: object, other: object) -> bool:
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and one.dtype == other.dtype and np.array_equal(one, other)
    if isinstance(one, float):
        return one == other or (one != one and other != other)
    if isinstance(one, tuple) and one and hasattr(one[0], "T"):
        return [(f.name, f.kind, f.T.tobytes()) for f in one] == [(f.name, f.kind, f.T.tobytes()) for f in other]
    return one == other


def test_rows_are_read_back_bit_for_bit(rows: list[RobotRow]) -> None:
    found = read_parquet(rows_parquet(rows), "fleet.parquet")
    assert len(found) == len(rows)
    for row, back in zip(rows, found, strict=True):
        assert [each.name for each in fields(row) if not same(getattr(row, each.name), getattr(back, each.name))] == []
    assert read_parquet(rows_parquet([]), "fleet.parquet") == ()


def test_others_read_it_with_units_and_meanings(rows: list[RobotRow]) -> None:
    table = pq.read_table(io.BytesIO(rows_parquet(rows)))
    assert table.column_names == [name for name, *_ in COLUMNS]
    assert {field.metadata[b"about"] != b"" for field in table.schema} == {True}
    first, *_ = table.slice(0, 1).to_pylist()
    assert (first["robot"], first["begin_utc"].value if hasattr(first["begin_utc"], "value") else day_ns(0)) == (
        "arm_ä",
        day_ns(0),
    )
    assert table.column("largest_deviation_m").to_pylist()[:3] == [pytest.approx(2e-4), pytest.approx(2e-4), np.inf]
    assert len(first["covariance_rad_m"]) == 144
    assert [len(T) for T in first["frame_poses_m"]] == [16, 16]


def test_other_files_and_versions_are_refused(rows: list[RobotRow]) -> None:
    content = rows_parquet(rows[:1])
    with pytest.raises(FileFormatError, match=r"x\.parquet cannot be read as Parquet"):
        read_parquet(content[:-20], "x.parquet")
    table = pq.read_table(io.BytesIO(content))

    def written(metadata: dict[str, str] | None) -> bytes:
        stream = io.BytesIO()
        pq.write_table(table.replace_schema_metadata(metadata), stream)
        return stream.getvalue()

    with pytest.raises(FileFormatError, match="no rows of a fleet"):
        read_parquet(written(None), "x.parquet")
    with pytest.raises(ResultVersionError, match="format 9"):
        read_parquet(written({"format": "gtsam-rwhec fleet rows", "format_version": "9"}), "x.parquet")
