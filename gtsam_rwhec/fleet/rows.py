"""One row for each calibration of a fleet: what the terminal, the page, Parquet and the watch read.

A row holds what a result file says, short: the verdict with its grounds, poses with their joint covariance, counts and
costs. Where there is no calibration it holds the failure. Rows are kept as JSON, and every number is read back bit for
bit.
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
from gtsam_rwhec.solver.certificate import Basis, Status

#: What a file of rows calls itself, and the version of its fields.
FORMAT, FORMAT_VERSION = "gtsam-rwhec fleet rows", 1
#: Infinite covariances, as JSON has them.
_INFINITE = {"inf": math.inf, "-inf": -math.inf}


@dataclass(frozen=True, eq=False)
class RowFrame:
    """The pose of one frame.

    Attributes
    ----------
    name : str
        As the robot's rig file has it.
    kind : "sensor" or "target"
    T : (4, 4) array
        T_sensorcarrier_sensor, or T_targetcarrier_target; metres.
    """

    name: str
    kind: str
    T: Array


@dataclass(frozen=True)
class FailedLog:
    """A log that gave no partial result: its URL, and why."""

    url: str
    reason: str


@dataclass(frozen=True, eq=False)
class RobotRow:
    """One calibration of one robot: of all its logs, of a day or of a log; or why there is none.

    The robots of a site are solved together, and each has a row: of its own sensors and of the targets that it saw.

    Attributes
    ----------
    unit : str
        What was solved together: "arm_01", "arm_01@2026-11-22", "hall_a". Its files are in ``robots/UNIT/``.
    robot : str
    site : str or None
        The site whose robots were solved together.
    begin_ns, end_ns : int or None
        The first and the last measurement, UTC nanoseconds.
    verdict : Verdict or None
        None where there is no calibration.
    reason : str
        The verdict's reason in words, with what to do; empty where there is no calibration.
    grounds : tuple of Ground
    status : Status or None
        Of the certificate; None also where there is no answer with a positive scale.
    basis : Basis or None
        What the certificate is about: moments, or measurements (``--refine``).
    frames : tuple of RowFrame
        Sensors first, then targets.
    covariance : (6 n, 6 n) array or None
        Joint covariance of the tangents of `frames`, in their order: right perturbations, [omega (rad), v (m)].
        Infinite along free directions. None where the calibration was not refined.
    degrees_of_freedom : float
        Of the estimated noise; infinite where it was given.
    scale : float or dict of str to float
        Measured over true length; nan where there is none.
    condition : float or None
        Condition number of the information about what is determined, in radians and typical lengths: poses agree
        between partitions of the work to 1e-12 times this.
    moments_sha256 : str
        Checksum of the merged moments, in hexadecimal digits: the same whatever worker or order. Empty where there are
        none.
    logs, failed_logs : int, tuple of FailedLog
        How many logs are in the answer, and those that gave nothing.
    measurements : int
    removed : dict of str to int
        Measurements that cleaning left out, by reason.
    findings : tuple of str
        What the logs said of themselves, in words.
    cpu_s, bytes_read, peak_bytes : float, int, int
        Of its logs' tasks and the unit's own, also where an earlier run did them; of the logs' stores; the largest.
    receipts : tuple of str
        Keys of the tasks whose files it was made from.
    result : str or None
        The result file's place below the output, with slashes.
    failure : str or None
        Why there is no calibration; without credentials.
    constant_errors : two tuples of 6 float, or empty
        Deviations of a constant error of the target carriers' and the sensor carriers' poses, which `covariance` holds:
        the same in every calibration with the same carriers (`CalibrationFields`).
    """

    unit: str
    robot: str
    site: str | None = None
    begin_ns: int | None = None
    end_ns: int | None = None
    verdict: Verdict | None = None
    reason: str = ""
    grounds: tuple[Ground, ...] = ()
    status: Status | None = None
    basis: Basis | None = None
    frames: tuple[RowFrame, ...] = ()
    covariance: Array | None = None
    degrees_of_freedom: float = math.inf
    scale: float | Mapping[str, float] = math.nan
    condition: float | None = None
    moments_sha256: str = ""
    logs: int = 0
    failed_logs: tuple[FailedLog, ...] = ()
    measurements: int = 0
    removed: Mapping[str, int] = field(default_factory=dict)
    findings: tuple[str, ...] = ()
    cpu_s: float = 0.0
    bytes_read: int = 0
    peak_bytes: int = 0
    receipts: tuple[str, ...] = ()
    result: str | None = None
    failure: str | None = None
    constant_errors: tuple[tuple[float, ...], ...] = ()

    @property
    def is_fine(self) -> bool:
        """Whether the poses may be used, and every log of the unit was read."""
        return self.verdict in (Verdict.USE, Verdict.CARE) and not self.failed_logs


def rows_json(rows: Iterable[RobotRow]) -> bytes:
    """A file of rows: JSON in UTF-8, one row a line."""
    lines = [json.dumps(_tree(row), ensure_ascii=False, allow_nan=False) for row in rows]
    head = f'{{"format": "{FORMAT}", "format_version": {FORMAT_VERSION}, "rows": [\n'
    return (head + ",\n".join(lines) + "\n]}\n").encode("utf-8", "surrogateescape")


def read_rows(content: bytes, where: str) -> tuple[RobotRow, ...]:
    """The rows of a file.

    Parameters
    ----------
    content : bytes
    where : str
        The file's name, for messages.

    Raises
    ------
    ResultVersionError
        The rows are of another version of this library.
    FileFormatError
        It is no file of rows, or a damaged one.
    """
    try:
        tree = json.loads(content.decode("utf-8", "surrogateescape"))
        if tree["format"] != FORMAT:
            raise FileFormatError(f"{where} is no file of rows of a fleet: its format is {tree['format']!r}")
        version = tree["format_version"]
        if version != FORMAT_VERSION:
            raise ResultVersionError(
                f"{where} has rows of format {version}, and this version reads {FORMAT_VERSION}: run the fleet again "
                "with this version (partial results of the other one stay, and are not used)"
            )
        return tuple(map(_row, tree["rows"]))
    except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError, AttributeError, IndexError) as error:
        raise FileFormatError(f"{where} cannot be read as rows of a fleet: {error!r}") from error


def _tree(row: RobotRow) -> dict[str, Any]:
    scale = row.scale
    return {
        "unit": row.unit,
        "robot": row.robot,
        "site": row.site,
        "begin_ns": row.begin_ns,
        "end_ns": row.end_ns,
        "verdict": None if row.verdict is None else row.verdict.value,
        "reason": row.reason,
        "grounds": [ground.value for ground in row.grounds],
        "status": None if row.status is None else row.status.value,
        "basis": None if row.basis is None else row.basis.value,
        "frames": [{"name": f.name, "kind": f.kind, "T": f.T[:3].tolist()} for f in row.frames],
        "covariance": None if row.covariance is None else [[_number(v) for v in r] for r in row.covariance.tolist()],
        "constant_errors": [list(each) for each in row.constant_errors],
        "degrees_of_freedom": _number(row.degrees_of_freedom),
        "scale": dict(scale) if isinstance(scale, Mapping) else None if math.isnan(scale) else scale,
        "condition": None if row.condition is None else _number(row.condition),
        "moments_sha256": row.moments_sha256,
        "logs": row.logs,
        "failed_logs": [{"url": log.url, "reason": log.reason} for log in row.failed_logs],
        "measurements": row.measurements,
        "removed": dict(row.removed),
        "findings": list(row.findings),
        "cpu_s": row.cpu_s,
        "bytes_read": row.bytes_read,
        "peak_bytes": row.peak_bytes,
        "receipts": list(row.receipts),
        "result": row.result,
        "failure": row.failure,
    }


def _row(tree: dict[str, Any]) -> RobotRow:
    covariance, scale, condition = tree["covariance"], tree["scale"], tree["condition"]
    return RobotRow(
        unit=tree["unit"],
        robot=tree["robot"],
        site=tree["site"],
        begin_ns=tree["begin_ns"],
        end_ns=tree["end_ns"],
        verdict=None if tree["verdict"] is None else Verdict(tree["verdict"]),
        reason=tree["reason"],
        grounds=tuple(map(Ground, tree["grounds"])),
        status=None if tree["status"] is None else Status(tree["status"]),
        basis=None if tree["basis"] is None else Basis(tree["basis"]),
        frames=tuple(RowFrame(f["name"], f["kind"], np.array([*f["T"], [0.0, 0.0, 0.0, 1.0]])) for f in tree["frames"]),
        covariance=None if covariance is None else np.array([[_float(v) for v in r] for r in covariance]),
        constant_errors=tuple(map(tuple, tree["constant_errors"])),
        degrees_of_freedom=_float(tree["degrees_of_freedom"]),
        scale=math.nan if scale is None else scale,
        condition=None if condition is None else _float(condition),
        moments_sha256=tree["moments_sha256"],
        logs=tree["logs"],
        failed_logs=tuple(FailedLog(log["url"], log["reason"]) for log in tree["failed_logs"]),
        measurements=tree["measurements"],
        removed=tree["removed"],
        findings=tuple(tree["findings"]),
        cpu_s=tree["cpu_s"],
        bytes_read=tree["bytes_read"],
        peak_bytes=tree["peak_bytes"],
        receipts=tuple(tree["receipts"]),
        result=tree["result"],
        failure=tree["failure"],
    )


def _number(value: float) -> float | str:
    return value if math.isfinite(value) else "inf" if value > 0.0 else "-inf"


def _float(value: float | str) -> float:
    return _INFINITE[value] if isinstance(value, str) else float(value)
