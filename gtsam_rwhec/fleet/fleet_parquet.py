"""Rows of a fleet as Parquet: one line for each calibration, every number exact.

A column's name has its unit; the field's metadata has its meaning. A pose is T row by row (16 numbers). The joint
covariance of all n frames is also row by row: rows of 6 n numbers, infinite along free directions. In text that is
not UTF-8, such as some file names, backslash escapes replace the invalid bytes.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.fleet.fleet_rows import (
    FORMAT,
    FORMAT_VERSION,
    PARQUET_FILE,
    ROWS_FILE,
    RobotRow,
    check_format,
    read_rows,
    row_of,
)
from gtsam_rwhec.fleet.store_requests import shown
from gtsam_rwhec.fleet.stores import exists, read_bytes

#: Column, type, meaning, and the row's attribute if the value is kept unchanged. A type is the name of a pyarrow
#: function, or is made in `_schema`.
COLUMNS = (
    ("unit", "string", "what was solved together", "unit"),
    ("robot", "string", "the robot's name", "robot"),
    ("site", "string", "the site whose robots were solved together; null without one", "site"),
    ("begin_utc", "time", "the first measurement", "begin_ns"),
    ("end_utc", "time", "the last measurement", "end_ns"),
    ("verdict", "string", "use, care or do_not_use; null without a calibration", "verdict"),
    ("reason", "string", "the verdict's reason in words", "reason"),
    ("grounds", "strings", "the verdict's grounds, the most serious first", "grounds"),
    ("status", "string", "of the certificate", "status"),
    ("frame_names", "strings", "sensors first, then targets", ""),
    ("frame_kinds", "strings", "sensor or target: T_sensorcarrier_sensor or T_targetcarrier_target", ""),
    ("frame_poses_m", "poses", "T of each frame, row by row; metres", ""),
    (
        "covariance_rad_m",
        "float64s",
        "joint covariance of right perturbations [omega (rad), v (m)] of all frames, row by row; null if not refined",
        "",
    ),
    (
        "constant_errors_rad_m",
        "constants",
        "deviations of constant errors of both carriers that the covariance holds",
        "constant_errors",
    ),
    ("largest_deviation_rad", "float64", "the largest standard deviation of rotations; infinite if one is free", ""),
    ("largest_deviation_m", "float64", "the same of positions", ""),
    ("degrees_of_freedom", "float64", "of the estimated noise; infinite where it was given", "degrees_of_freedom"),
    ("scale", "float64", "measured over true length; nan where there is none, null where targets have their own", ""),
    ("scales", "numbers", "the same by target", ""),
    ("measurements_sha256", "string", "checksum of the measurements' files", "measurements_sha256"),
    ("logs", "int64", "logs in the answer", "logs"),
    ("failed_log_urls", "strings", "logs that gave nothing", ""),
    ("failed_log_reasons", "strings", "why, in the same order", ""),
    ("measurements", "int64", "in the answer", "measurements"),
    ("removed_measurements", "counts", "by reason", ""),
    ("findings", "strings", "what the logs said of themselves", "findings"),
    ("cpu_s", "float64", "seconds of the processor, of all tasks", "cpu_s"),
    ("bytes_read", "int64", "from the stores of the logs", "bytes_read"),
    ("peak_memory_bytes", "int64", "of the largest task", "peak_bytes"),
    ("result", "string", "the result file's place below the output", "result"),
    ("failure", "string", "why there is no calibration", "failure"),
)


def rows_parquet(rows: Iterable[RobotRow]) -> bytes:
    """The bytes of a Parquet file of rows."""
    pa, pq = _pyarrow()
    schema = _schema(pa)
    fields = [_fields(row) for row in rows]
    columns = [pa.array([_text(each[field.name]) for each in fields], field.type) for field in schema]
    stream = io.BytesIO()
    pq.write_table(pa.Table.from_arrays(columns, schema=schema), stream, compression="zstd")
    return stream.getvalue()


def read_parquet(content: bytes, where: str) -> tuple[RobotRow, ...]:
    """The rows of a Parquet file; `where` is its name in messages.

    Raises
    ------
    ResultVersionError
        The rows are of another version of this library.
    FileFormatError
        The file is damaged, or is not a Parquet file of rows.
    """
    pa, pq = _pyarrow()
    try:
        table = pq.read_table(io.BytesIO(content))
    except (pa.ArrowException, OSError) as error:
        raise FileFormatError(f"{where} cannot be read as Parquet: {error}") from error
    said = {key.decode(): value.decode("utf-8", "replace") for key, value in (table.schema.metadata or {}).items()}
    check_format(said.get("format"), said.get("format_version"), where)
    try:
        times = {name: table.column(name).cast(pa.int64()).to_pylist() for name in ("begin_utc", "end_utc")}
        rest = table.drop_columns(list(times)).to_pylist()
        return tuple(
            _row(each | {"begin_utc": begin, "end_utc": end})
            for each, begin, end in zip(rest, times["begin_utc"], times["end_utc"], strict=True)
        )
    except (pa.ArrowException, KeyError, TypeError, ValueError) as error:
        raise FileFormatError(f"{where} cannot be read as rows of a fleet: {error!r}") from error


def read_history(urls: Iterable[str]) -> tuple[RobotRow, ...]:
    """The rows of several runs, in the given order: from outputs of ``gtsam-rwhec fleet run``, or from files of rows.

    Raises as `read_rows` does; StoreError if a file does not exist or the store refuses it.
    """
    return tuple(row for url in urls for row in _rows_at(url))


def _rows_at(url: str) -> tuple[RobotRow, ...]:
    if not url.endswith((".json", ".parquet")):
        inside = [f"{url.rstrip('/')}/{name}" for name in (ROWS_FILE, PARQUET_FILE)]
        url = next((each for each in inside if exists(each)), inside[0])
    content = read_bytes(url)
    return read_parquet(content, shown(url)) if url.endswith(".parquet") else read_rows(content, shown(url))


def _pyarrow() -> tuple[Any, Any]:
    with extra_named():
        import pyarrow as pa
        import pyarrow.parquet as pq
    return pa, pq


def _schema(pa: Any) -> Any:
    types = {
        "time": pa.timestamp("ns", "UTC"),
        "strings": pa.list_(pa.string()),
        "float64s": pa.list_(pa.float64()),
        "poses": pa.list_(pa.list_(pa.float64(), 16)),
        "constants": pa.list_(pa.list_(pa.float64(), 6)),
        "numbers": pa.map_(pa.string(), pa.float64()),
        "counts": pa.map_(pa.string(), pa.int64()),
    }
    fields = [
        pa.field(name, types[kind] if kind in types else getattr(pa, kind)(), metadata={"about": what})
        for name, kind, what, _ in COLUMNS
    ]
    return pa.schema(fields, {"format": FORMAT, "format_version": str(FORMAT_VERSION)})


def _fields(row: RobotRow) -> dict[str, Any]:
    rotation, position = (None, None) if row.covariance is None else row.largest_deviations()
    several = isinstance(row.scale, Mapping)
    return {column: getattr(row, own) for column, _, _, own in COLUMNS if own} | {
        "frame_names": [frame.name for frame in row.frames],
        "frame_kinds": [frame.kind for frame in row.frames],
        "frame_poses_m": [frame.T.ravel() for frame in row.frames],
        "covariance_rad_m": None if row.covariance is None else row.covariance.ravel(),
        "largest_deviation_rad": rotation,
        "largest_deviation_m": position,
        "scale": None if several else row.scale,
        "scales": list(row.scale.items()) if isinstance(row.scale, Mapping) else [],
        "failed_log_urls": [log.url for log in row.failed_logs],
        "failed_log_reasons": [log.reason for log in row.failed_logs],
        "removed_measurements": list(row.removed.items()),
    }


def _row(fields: dict[str, Any]) -> RobotRow:
    frames = [
        {"name": name, "kind": kind, "T": np.reshape(T, (4, 4))[:3]}
        for name, kind, T in zip(fields["frame_names"], fields["frame_kinds"], fields["frame_poses_m"], strict=True)
    ]
    covariance, m = fields["covariance_rad_m"], 6 * len(frames)
    logs = zip(fields["failed_log_urls"], fields["failed_log_reasons"], strict=True)
    own = {name: fields[column] for column, _, _, name in COLUMNS if name}
    return row_of(
        own
        | {
            "frames": frames,
            "covariance": None if covariance is None else np.reshape(covariance, (m, m)),
            "scale": dict(fields["scales"]) if fields["scale"] is None else fields["scale"],
            "failed_logs": [{"url": url, "reason": reason} for url, reason in logs],
            "removed": fields["removed_measurements"],
        }
    )


def _text(value: Any) -> Any:
    """The value with its text, also inside lists, made valid UTF-8."""
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode("utf-8")
    if isinstance(value, list | tuple):
        return [tuple(map(_text, each)) if isinstance(each, tuple) else _text(each) for each in value]
    return value
