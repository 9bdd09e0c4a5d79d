"""One row for each calibration of a fleet: what the terminal, the page, Parquet and the watch read.

A row holds what a result file says, short; where there is no calibration it holds the failure. Rows are kept as JSON,
and as Parquet, which pandas, DuckDB and Arrow read; every number is read back bit for bit.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gtsam_rwhec.calibration.verdict import Ground, Verdict
from gtsam_rwhec.errors import FileFormatError, ResultVersionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.certificate import Status

#: What a file of rows calls itself, and the version of its fields.
FORMAT, FORMAT_VERSION = "gtsam-rwhec fleet rows", 1
#: The names of the files of rows in an output: JSON, and the same as Parquet.
ROWS_FILE, PARQUET_FILE = "fleet.json", "fleet.parquet"
#: Infinite covariances, as JSON has them.
_INFINITE = {"inf": math.inf, "-inf": -math.inf}


@dataclass(frozen=True, eq=False)
class RowFrame:
    """The pose of one frame."""

    name: str  #: As the robot's rig file has it
    kind: str
    T: Array  #: (4, 4): T_sensorcarrier_sensor, or T_targetcarrier_target; metres


@dataclass(frozen=True)
class FailedLog:
    """A log that gave no partial result: its URL, and why."""

    url: str
    reason: str


@dataclass(frozen=True, eq=False)
class RobotRow:
    """One calibration of one robot: of all its logs, of a day or of a log; or why there is none.

    The robots of a site are solved together, and each has a row: of its own sensors and of the targets that it saw.
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
    status: Status | None = None  #: Of the certificate; None also where there is no answer with a positive scale
    frames: tuple[RowFrame, ...] = ()  #: Sensors first, then targets
    #: (6 n, 6 n): joint covariance of the tangents of `frames`, in their order: right perturbations, [omega (rad), v
    #: (m)]. Infinite along free directions. None where the calibration was not refined
    covariance: Array | None = None
    #: Deviations of a constant error of the target carriers' and the sensor carriers' poses, which `covariance` holds:
    #: the same in every calibration with the same carriers (`CalibrationFields`)
    constant_errors: tuple[tuple[float, ...], ...] = ()
    degrees_of_freedom: float = math.inf  #: Of the estimated noise; infinite where it was given
    #: Measured over true length, for all or by target; nan where there is none
    scale: float | Mapping[str, float] = math.nan
    measurements_sha256: str = ""  #: Checksum of the measurements' files, the same whatever worker or order
    logs: int = 0  #: How many logs are in the answer; `failed_logs` gave nothing
    failed_logs: tuple[FailedLog, ...] = ()
    measurements: int = 0
    removed: Mapping[str, int] = field(default_factory=dict)  #: Measurements that cleaning left out, by reason
    findings: tuple[str, ...] = ()  #: What speaks against the poses, and what the logs said of themselves, in words
    #: cpu_s, bytes_read, peak_bytes: of its logs' tasks and the unit's own, also where an earlier run did them; of the
    #: logs' stores; the largest
    cpu_s: float = 0.0
    bytes_read: int = 0
    peak_bytes: int = 0
    result: str | None = None  #: The result file's place below the output, with slashes
    failure: str | None = None  #: Why there is no calibration; without credentials

    @property
    def is_fine(self) -> bool:
        """Whether the poses may be used, and every log of the unit was read."""
        return self.verdict in (Verdict.USE, Verdict.CARE) and not self.failed_logs

    def largest_deviations(self, kind: str | None = None) -> tuple[float, float]:
        """The largest standard deviations of frames (of a kind): about an axis (rad) and along one (m); or infinite."""
        at = [i for i, frame in enumerate(self.frames) if kind in (None, frame.kind)]
        if self.covariance is None or not at:
            return math.inf, math.inf
        turned, moved = np.sqrt(np.diagonal(self.covariance).reshape(-1, 2, 3)[at].max(axis=(0, 2)))
        return float(turned), float(moved)


#: What JSON and Parquet keep as it is.
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
    """The rows of a file, which `where` names.

    Raises
    ------
    ResultVersionError
        The rows are of another version of this library.
    FileFormatError
        It is no file of rows, or a damaged one.
    """
    try:
        tree = json.loads(content.decode("utf-8", "surrogateescape"))
        check_format(tree["format"], tree["format_version"], where)
        return tuple(map(_row, tree["rows"]))
    except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError, AttributeError, IndexError) as error:
        raise FileFormatError(f"{where} cannot be read as rows of a fleet: {error!r}") from error


def check_format(name: object, version: object, where: str) -> None:
    """Raise the errors of `read_rows` for what calls itself something else, or is of another version."""
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


def _row(tree: dict[str, Any]) -> RobotRow:
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
        removed=tree["removed"],
        findings=tuple(tree["findings"]),
    )


def _number(value: float) -> float | str:
    return value if math.isfinite(value) else "inf" if value > 0.0 else "-inf"


def _float(value: float | str) -> float:
    return _INFINITE[value] if isinstance(value, str) else float(value)
