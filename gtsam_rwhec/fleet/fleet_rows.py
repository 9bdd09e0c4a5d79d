"""One row for each calibration of a fleet; the terminal report, the page and the watch read the rows.

A row is the summary of a result file or, without a calibration, the failure. Rows are stored as JSON and as Parquet
(for pandas, DuckDB and Arrow); every number is read back bit for bit.

In Parquet a column's name has its unit; the field's metadata has its meaning. A pose is T row by row (16 numbers). The
joint covariance of all n frames is also row by row: rows of 6 n numbers, infinite along free directions. In text that
is not UTF-8, such as some file names, backslash escapes replace the invalid bytes.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gtsam_rwhec.calibration.verdict import Ground, Verdict
from gtsam_rwhec.errors import FileFormatError, ResultVersionError
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.fleet.stores import exists, read_bytes, shown
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.certificate import Status

#: The format's name in a file of rows, and the version of its fields.
FORMAT, FORMAT_VERSION = "gtsam-rwhec fleet rows", 1
#: The file names in an output: JSON, and the same rows as Parquet.
ROWS_FILE, PARQUET_FILE = "fleet.json", "fleet.parquet"
#: Infinite covariances in JSON.
_INFINITE = {"inf": math.inf, "-inf": -math.inf}


@dataclass(frozen=True, eq=False)
class RowFrame:
    """The pose of one frame."""

    name: str  #: As the robot's rig file has it
    kind: str
    T: Array  #: (4, 4): T_sensorcarrier_sensor, or T_targetcarrier_target; metres


@dataclass(frozen=True)
class FailedLog:
    """A log without a partial result: its URL and the reason."""

    url: str
    reason: str


@dataclass(frozen=True, eq=False)
class RobotRow:
    """One calibration of one robot, from all its logs, from one day or from one log; or why there is none.

    The robots of a site are solved together. Each has its own row, with its sensors and the targets that it saw.
    """

    unit: str  #: What was solved together: "arm_01", "arm_01@2026-11-22", "hall_a". Its files are in ``robots/UNIT/``
    robot: str
    site: str | None = None  #: The site whose robots were solved together
    #: begin_ns, end_ns: the first and the last measurement, UTC nanoseconds
    begin_ns: int | None = None
    end_ns: int | None = None
    verdict: Verdict | None = None  #: None where there is no calibration
    reason: str = ""  #: The verdict's reason in words, with what to do
    grounds: tuple[Ground, ...] = ()
    status: Status | None = None  #: Of the certificate; None also if no answer has a positive scale
    frames: tuple[RowFrame, ...] = ()  #: Sensors first, then targets
    #: (6 n, 6 n): joint covariance of the tangents of `frames`, in their order: right perturbations, [omega (rad), v
    #: (m)]. Infinite along free directions. None where the calibration was not refined
    covariance: Array | None = None
    #: Deviations of a constant error of the target carriers' and of the sensor carriers' poses; `covariance` includes
    #: it. The error is the same in every calibration with the same carriers (`CalibrationFields`)
    constant_errors: tuple[tuple[float, ...], ...] = ()
    degrees_of_freedom: float = math.inf  #: Of the estimated noise; infinite where it was given
    #: Measured over true length, for all or by target; nan if unknown
    scale: float | Mapping[str, float] = math.nan
    measurements_sha256: str = ""  #: Checksum of the measurements' files; workers and order do not change it
    logs: int = 0  #: How many logs are in the answer, without `failed_logs`
    failed_logs: tuple[FailedLog, ...] = ()
    measurements: int = 0
    removed: Mapping[str, int] = field(default_factory=dict)  #: Measurements that cleaning left out, by reason
    findings: tuple[str, ...] = ()  #: What speaks against the poses, and findings about the logs, in words
    #: cpu_s, bytes_read, peak_bytes: CPU time of its logs' tasks and of the unit's, also if an earlier run did them;
    #: bytes from the logs' stores; the largest peak memory of a task
    cpu_s: float = 0.0
    bytes_read: int = 0
    peak_bytes: int = 0
    result: str | None = None  #: The result file's path in the output, with slashes
    failure: str | None = None  #: Why there is no calibration; without credentials

    @property
    def is_fine(self) -> bool:
        """Whether the poses may be used and every log of the unit was read."""
        return self.verdict in (Verdict.USE, Verdict.CARE) and not self.failed_logs

    def largest_deviations(self, kind: str | None = None) -> tuple[float, float]:
        """The frames' largest standard deviations (of one kind): about an axis (rad), along one (m); or infinite."""
        at = [i for i, frame in enumerate(self.frames) if kind in (None, frame.kind)]
        if self.covariance is None or not at:
            return math.inf, math.inf
        turned, moved = np.sqrt(np.diagonal(self.covariance).reshape(-1, 2, 3)[at].max(axis=(0, 2)))
        return float(turned), float(moved)


#: Fields that JSON and Parquet keep unchanged.
PLAIN = (
    "unit", "robot", "site", "begin_ns", "end_ns", "reason", "measurements_sha256", "logs", "measurements", "cpu_s",
    "bytes_read", "peak_bytes", "result", "failure",
)  # fmt: skip


def rows_json(rows: Iterable[RobotRow]) -> bytes:
    """A file of rows: JSON in UTF-8, one row a line."""
    lines = [json.dumps(_tree(row), ensure_ascii=False, allow_nan=False) for row in rows]
    head = f'{{"format": "{FORMAT}", "format_version": {FORMAT_VERSION}, "rows": [\n'
    return (head + ",\n".join(lines) + "\n]}\n").encode("utf-8", "surrogateescape")


def read_rows(content: bytes, where: str) -> tuple[RobotRow, ...]:
    """The rows of a file; `where` is its name in messages.

    Raises
    ------
    ResultVersionError
        The rows are of another version of this library.
    FileFormatError
        The file is damaged, or is not a file of rows.
    """
    try:
        tree = json.loads(content.decode("utf-8", "surrogateescape"))
        check_format(tree["format"], tree["format_version"], where)
        return tuple(map(row_of, tree["rows"]))
    except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError, AttributeError, IndexError) as error:
        raise FileFormatError(f"{where} cannot be read as rows of a fleet: {error!r}") from error


def check_format(name: object, version: object, where: str) -> None:
    """Raise the errors of `read_rows` if the content is of another format or version."""
    if name != FORMAT:
        raise FileFormatError(f"{where} has no rows of a fleet that gtsam-rwhec wrote: its format is {name!r}")
    if str(version) != str(FORMAT_VERSION):
        raise ResultVersionError(
            f"{where} has rows of format {version}, and this version reads {FORMAT_VERSION}: run the fleet again "
            "with this version (partial results of the other one stay, and are not used)"
        )


def _tree(row: RobotRow) -> dict[str, Any]:
    scale = row.scale
    return {name: getattr(row, name) for name in PLAIN} | {
        "verdict": row.verdict and row.verdict.value,
        "grounds": [ground.value for ground in row.grounds],
        "status": row.status and row.status.value,
        "frames": [{"name": f.name, "kind": f.kind, "T": f.T[:3].tolist()} for f in row.frames],
        "covariance": None if row.covariance is None else [[_number(v) for v in r] for r in row.covariance.tolist()],
        "constant_errors": [list(each) for each in row.constant_errors],
        "degrees_of_freedom": _number(row.degrees_of_freedom),
        "scale": dict(scale) if isinstance(scale, Mapping) else None if math.isnan(scale) else scale,
        "failed_logs": [{"url": log.url, "reason": log.reason} for log in row.failed_logs],
        "removed": dict(row.removed),
        "findings": list(row.findings),
    }


def row_of(tree: dict[str, Any]) -> RobotRow:
    """The row of what `rows_json` writes for it."""
    covariance, scale = tree["covariance"], tree["scale"]
    return RobotRow(
        **{name: tree[name] for name in PLAIN},
        verdict=None if tree["verdict"] is None else Verdict(tree["verdict"]),
        grounds=tuple(map(Ground, tree["grounds"])),
        status=None if tree["status"] is None else Status(tree["status"]),
        frames=tuple(RowFrame(f["name"], f["kind"], np.array([*f["T"], [0.0, 0.0, 0.0, 1.0]])) for f in tree["frames"]),
        covariance=None if covariance is None else np.array([[_float(v) for v in r] for r in covariance]),
        constant_errors=tuple(map(tuple, tree["constant_errors"])),
        degrees_of_freedom=_float(tree["degrees_of_freedom"]),
        scale=math.nan if scale is None else scale,
        failed_logs=tuple(FailedLog(log["url"], log["reason"]) for log in tree["failed_logs"]),
        removed=dict(tree["removed"]),
        findings=tuple(tree["findings"]),
    )


def _number(value: float) -> float | str:
    return value if math.isfinite(value) else "inf" if value > 0.0 else "-inf"


def _float(value: float | str) -> float:
    return _INFINITE[value] if isinstance(value, str) else float(value)


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
            _row_of_columns(each | {"begin_utc": begin, "end_utc": end})
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


def _row_of_columns(fields: dict[str, Any]) -> RobotRow:
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
