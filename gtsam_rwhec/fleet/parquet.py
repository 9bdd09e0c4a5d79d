"""Rows of a fleet as Parquet, which pandas, DuckDB and Arrow read: one line for each calibration, every number exact.

Columns have their unit in their names, and their meaning in the fields' metadata. Poses are T row by row (16 numbers),
the joint covariance of all frames is row by row too: 6 n numbers to a row, n the number of frames; infinite along free
directions. Text that is no UTF-8, such as some names of files, has backslashes in the place of such bytes.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from gtsam_rwhec.calibration.verdict import Ground, Verdict
from gtsam_rwhec.errors import FileFormatError, ResultVersionError
from gtsam_rwhec.fleet.extras import imported
from gtsam_rwhec.fleet.rows import FailedLog, RobotRow, RowFrame
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.certificate import Basis, Status

#: What the file's metadata call it, and the version of its columns.
FORMAT, FORMAT_VERSION = "gtsam-rwhec fleet rows", 1
#: Column, type, and what it is. Types are names of functions of pyarrow, or made in `_schema`.
COLUMNS = (
    ("unit", "string", "what was solved together"),
    ("robot", "string", "the robot's name"),
    ("site", "string", "the site whose robots were solved together; null without one"),
    ("begin_utc", "time", "the first measurement"),
    ("end_utc", "time", "the last measurement"),
    ("verdict", "string", "use, care or do_not_use; null without a calibration"),
    ("reason", "string", "the verdict's reason in words"),
    ("grounds", "strings", "the verdict's grounds, the most serious first"),
    ("status", "string", "of the certificate"),
    ("basis", "string", "what the certificate is about"),
    ("frame_names", "strings", "sensors first, then targets"),
    ("frame_kinds", "strings", "sensor or target: T_sensorcarrier_sensor or T_targetcarrier_target"),
    ("frame_poses_m", "poses", "T of each frame, row by row; metres"),
    (
        "covariance_rad_m",
        "float64s",
        "joint covariance of right perturbations [omega (rad), v (m)] of all frames, row by row; null if not refined",
    ),
    ("constant_errors_rad_m", "constants", "deviations of constant errors of both carriers that the covariance holds"),
    ("largest_deviation_rad", "float64", "the largest standard deviation of rotations; infinite if one is free"),
    ("largest_deviation_m", "float64", "the same of positions"),
    ("degrees_of_freedom", "float64", "of the estimated noise; infinite where it was given"),
    ("scale", "float64", "measured over true length; nan where there is none, null where targets have their own"),
    ("scales", "numbers", "the same by target"),
    ("condition", "float64", "condition number of the information about what is determined"),
    ("moments_sha256", "string", "checksum of the merged moments"),
    ("logs", "int64", "logs in the answer"),
    ("failed_log_urls", "strings", "logs that gave nothing"),
    ("failed_log_reasons", "strings", "why, in the same order"),
    ("measurements", "int64", "in the answer"),
    ("removed_measurements", "counts", "by reason"),
    ("findings", "strings", "what the logs said of themselves"),
    ("cpu_s", "float64", "seconds of the processor, of all tasks"),
    ("bytes_read", "int64", "from the stores of the logs"),
    ("peak_memory_bytes", "int64", "of the largest task"),
    ("receipts", "strings", "keys of the tasks"),
    ("result", "string", "the result file's place below the output"),
    ("failure", "string", "why there is no calibration"),
)  # fmt: skip


def rows_parquet(rows: Iterable[RobotRow]) -> bytes:
    """A Parquet file of rows.

    Raises
    ------
    OptionError
        pyarrow is not installed.
    """
    pa, pq = _pyarrow()
    schema = _schema(pa)
    fields = [_fields(row) for row in rows]
    columns = [pa.array([each[field.name] for each in fields], field.type) for field in schema]
    stream = io.BytesIO()
    pq.write_table(pa.Table.from_arrays(columns, schema=schema), stream, compression="zstd")
    return stream.getvalue()


def read_parquet(content: bytes, where: str) -> tuple[RobotRow, ...]:
    """The rows of a Parquet file.

    Parameters
    ----------
    content : bytes
    where : str
        The file's name, for messages.

    Raises
    ------
    OptionError
        pyarrow is not installed.
    ResultVersionError
        The rows are of another version of this library.
    FileFormatError
        It is no Parquet file of rows, or a damaged one.
    """
    pa, pq = _pyarrow()
    try:
        table = pq.read_table(io.BytesIO(content))
    except (pa.ArrowException, OSError) as error:
        raise FileFormatError(f"{where} cannot be read as Parquet: {error}") from error
    said = {key.decode(): value.decode("utf-8", "replace") for key, value in (table.schema.metadata or {}).items()}
    if said.get("format") != FORMAT:
        raise FileFormatError(
            f"{where} has no rows of a fleet that gtsam-rwhec wrote; give OUT/fleet.parquet of gtsam-rwhec fleet run"
        )
    if said.get("format_version") != str(FORMAT_VERSION):
        raise ResultVersionError(
            f"{where} has rows of format {said.get('format_version')}, and this version reads {FORMAT_VERSION}: "
            "run the fleet again with this version"
        )
    try:
        times = {name: table.column(name).cast(pa.int64()).to_pylist() for name in ("begin_utc", "end_utc")}
        rest = table.drop_columns(list(times)).to_pylist()
        return tuple(
            _row(each | {"begin_utc": begin, "end_utc": end})
            for each, begin, end in zip(rest, times["begin_utc"], times["end_utc"], strict=True)
        )
    except (pa.ArrowException, KeyError, TypeError, ValueError) as error:
        raise FileFormatError(f"{where} cannot be read as rows of a fleet: {error!r}") from error


def _pyarrow() -> tuple[Any, Any]:
    return imported("pyarrow", "fleet", "Parquet"), imported("pyarrow.parquet", "fleet", "Parquet")


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
        pa.field(name, types.get(kind) or getattr(pa, kind)(), metadata={"about": about})
        for name, kind, about in COLUMNS
    ]
    return pa.schema(fields, {"format": FORMAT, "format_version": str(FORMAT_VERSION)})


def _fields(row: RobotRow) -> dict[str, Any]:
    rotation, position = _largest(row.covariance)
    several = isinstance(row.scale, Mapping)
    return {
        "unit": _text(row.unit),
        "robot": _text(row.robot),
        "site": _text(row.site),
        "begin_utc": row.begin_ns,
        "end_utc": row.end_ns,
        "verdict": row.verdict,
        "reason": _text(row.reason),
        "grounds": list(row.grounds),
        "status": row.status,
        "basis": row.basis,
        "frame_names": [_text(frame.name) for frame in row.frames],
        "frame_kinds": [frame.kind for frame in row.frames],
        "frame_poses_m": [frame.T.ravel() for frame in row.frames],
        "covariance_rad_m": None if row.covariance is None else row.covariance.ravel(),
        "constant_errors_rad_m": [list(each) for each in row.constant_errors],
        "largest_deviation_rad": rotation,
        "largest_deviation_m": position,
        "degrees_of_freedom": row.degrees_of_freedom,
        "scale": None if several else row.scale,
        "scales": [(_text(name), value) for name, value in row.scale.items()] if isinstance(row.scale, Mapping) else [],
        "condition": row.condition,
        "moments_sha256": row.moments_sha256,
        "logs": row.logs,
        "failed_log_urls": [_text(log.url) for log in row.failed_logs],
        "failed_log_reasons": [_text(log.reason) for log in row.failed_logs],
        "measurements": row.measurements,
        "removed_measurements": [(_text(reason), count) for reason, count in row.removed.items()],
        "findings": [_text(each) for each in row.findings],
        "cpu_s": row.cpu_s,
        "bytes_read": row.bytes_read,
        "peak_memory_bytes": row.peak_bytes,
        "receipts": list(row.receipts),
        "result": _text(row.result),
        "failure": _text(row.failure),
    }


def _row(fields: dict[str, Any]) -> RobotRow:
    frames = tuple(
        RowFrame(name, kind, np.array(T).reshape(4, 4))
        for name, kind, T in zip(fields["frame_names"], fields["frame_kinds"], fields["frame_poses_m"], strict=True)
    )
    covariance, m = fields["covariance_rad_m"], 6 * len(frames)
    return RobotRow(
        unit=fields["unit"],
        robot=fields["robot"],
        site=fields["site"],
        begin_ns=fields["begin_utc"],
        end_ns=fields["end_utc"],
        verdict=None if fields["verdict"] is None else Verdict(fields["verdict"]),
        reason=fields["reason"],
        grounds=tuple(map(Ground, fields["grounds"])),
        status=None if fields["status"] is None else Status(fields["status"]),
        basis=None if fields["basis"] is None else Basis(fields["basis"]),
        frames=frames,
        covariance=None if covariance is None else np.array(covariance).reshape(m, m),
        constant_errors=tuple(map(tuple, fields["constant_errors_rad_m"])),
        degrees_of_freedom=fields["degrees_of_freedom"],
        scale=dict(fields["scales"]) if fields["scale"] is None else fields["scale"],
        condition=fields["condition"],
        moments_sha256=fields["moments_sha256"],
        logs=fields["logs"],
        failed_logs=tuple(
            FailedLog(url, reason)
            for url, reason in zip(fields["failed_log_urls"], fields["failed_log_reasons"], strict=True)
        ),
        measurements=fields["measurements"],
        removed=dict(fields["removed_measurements"]),
        findings=tuple(fields["findings"]),
        cpu_s=fields["cpu_s"],
        bytes_read=fields["bytes_read"],
        peak_bytes=fields["peak_memory_bytes"],
        receipts=tuple(fields["receipts"]),
        result=fields["result"],
        failure=fields["failure"],
    )


def _text(text: str | None) -> str | None:
    return None if text is None else text.encode("utf-8", "backslashreplace").decode("utf-8")


def _largest(covariance: Array | None) -> tuple[float | None, float | None]:
    """The largest standard deviations of a rotation and of a position along an axis."""
    if covariance is None:
        return None, None
    variances = np.diagonal(covariance).reshape(-1, 6)
    rotation, position = variances[:, :3].max(initial=0.0), variances[:, 3:].max(initial=0.0)
    return math.sqrt(rotation), math.sqrt(position)
