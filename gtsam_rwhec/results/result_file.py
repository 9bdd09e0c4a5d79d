"""Writing calibrations to JSON files and reading them back, bit for bit.

What a file holds is in `gtsam_rwhec.results.schema`; units and frame conventions are also written inside every file.

Pydantic reads and checks the records as they are. `_to_json` and `_from_json` do by hand what pydantic (2.14, tried)
does not: its JSON has null for NaN and for both infinities, and none of these comes back as a float; a key that is a
pair becomes the text "a,b", which comes back as no pair; and it has nothing for gtsam.Pose3, arrays and slices.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from gtsam_rwhec.errors import FileFormatError, ResultVersionError
from gtsam_rwhec.files.atomic_write import write_atomically
from gtsam_rwhec.identifiability.free_directions import FreeDirection
from gtsam_rwhec.refinement.refined import Refined, RefinedPoses
from gtsam_rwhec.results.earlier_versions import FIRST_VERSION, as_version_4
from gtsam_rwhec.results.schema import (
    CONVENTIONS,
    FORMAT,
    FORMAT_VERSION,
    SENSOR_CARRIER,
    TARGET_CARRIER,
    FrameFields,
    RefinedFields,
    ResultFile,
    pose_rows,
)
from gtsam_rwhec.results.stage_reports import LogFields
from gtsam_rwhec.results.verdict import judge
from gtsam_rwhec.solver.certificate import Certificate
from gtsam_rwhec.solving.solution import Solution

POSED = ("sensors", "targets", "scale", "scale_mode")
"""What stands at the top of a file: of the refined answer where there is one, else of the certified one."""
ROWS = ("residuals", "pairs", "noise", "inlier_counts")
"""Fields that have pairs for keys; in a file they are rows {target, sensor, ...}, as JSON has no such keys."""
SENTENCE = "sentence"
"""What a record says in words, for people; not read back."""
INFINITIES = {
    **dict.fromkeys(("lower_bound", "float_bound", "min_eigenvalue"), -math.inf),
    **dict.fromkeys(("weakest", "degrees_of_freedom", "standard_deviations_deg", "standard_deviations_mm"), math.inf),
}
"""Fields that may be infinite, and which infinity null stands for there."""


@dataclass(frozen=True)
class Result:
    """What a file holds.

    Attributes
    ----------
    solution : Solution
        The certified solution.
    refined : RefinedPoses or None
        None where nothing was refined.
    log : LogFields or None
        None where the measurements are of no log.
    """

    solution: Solution
    refined: RefinedPoses | None
    log: LogFields | None


class _Header(BaseModel):
    """Enough to tell whose file it is, whatever else is in it."""

    model_config = ConfigDict(extra="ignore", strict=True)

    format: str
    format_version: int
    written_by: str = "an unknown program"


def write_solution(solution: Solution, path: str | Path) -> None:
    """Write a solution as JSON; whoever looks finds the old file or the whole new one.

    Parameters
    ----------
    solution
        What `gtsam_rwhec.solve` returned.
    path
        The file; replaced if it is there. Its folder must be there.

    Raises
    ------
    FileFormatError
        The file cannot be written (the message says why), or a number of the solution is NaN.
    """
    write_atomically(path, _content(path, solution, None, None))


def write_refined(refined: Refined, path: str | Path, log: LogFields | None = None) -> None:
    """Write a refined calibration, with the certified solution that it began at, as JSON.

    Parameters
    ----------
    refined : Refined
        The graph is not written.
    path : str or Path
        The file; replaced if it is there. Its folder must be there.
    log : LogFields, optional
        Where the measurements came from and what became of them.

    Raises
    ------
    FileFormatError
        The file cannot be written (the message says why), or a number is NaN.
    """
    write_atomically(path, _content(path, refined.solution, refined, log))


def refined_json(refined: Refined, log: LogFields | None = None) -> bytes:
    """What `write_refined` writes."""
    return _content("the result", refined.solution, refined, log)


def read_solution(path: str | Path) -> Solution:
    """Read what `write_solution` wrote: every number is the same double as before.

    Of a refined calibration's file, the certified solution that was refined (`gtsam_rwhec.read_refined`: the rest).

    Raises
    ------
    ResultVersionError
        The file is of a newer version of the format; the message says what to do.
    FileFormatError
        The file cannot be read, is not JSON, is not a result, or a field is missing, unknown or not what it should be;
        the message gives its JSON path.
    """
    return read_result(path).solution


def read_refined(path: str | Path) -> RefinedPoses:
    """Read what ``write_refined`` wrote: poses and covariances are the same doubles as before.

    Raises
    ------
    ResultVersionError, FileFormatError
        As for ``read_solution``; and where the file holds no refined poses.
    """
    refined = read_result(path).refined
    if refined is None:
        raise FileFormatError(
            f"{path} holds a solution that was not refined; read it with read_solution, or refine and write that "
            "(gtsam-rwhec calibrate --refine, or rw.write_refined)."
        )
    return refined


def read_result(path: str | Path) -> Result:
    """Read all that a file holds; raises as `read_solution` does."""
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise FileFormatError(f"{path} cannot be read: {error.strerror}.") from error
    return parse_result(content, path)


def parse_result(content: bytes, path: str | Path) -> Result:
    """What a file's content holds; `path` is for messages. Raises as `read_solution` does."""
    try:
        header = _Header.model_validate_json(content)
    except ValidationError as error:
        raise FileFormatError(f"{path} is not a result of gtsam-rwhec: {_in_words(error)}") from error
    if header.format != FORMAT:
        raise FileFormatError(
            f"{path}: $.format is {header.format!r}, expected {FORMAT!r}: this is another kind of file."
        )
    number = header.format_version
    if not FIRST_VERSION <= number <= FORMAT_VERSION:
        remedy = "install a newer gtsam-rwhec" if number > FORMAT_VERSION else "calibrate again to write it anew"
        raise ResultVersionError(
            f"{path} has version {number} of the result format (written by {header.written_by}); this gtsam-rwhec "
            f"reads versions {FIRST_VERSION} to {FORMAT_VERSION}: {remedy}."
        )
    of_version = "" if number == FORMAT_VERSION else f" of version {number} (places are those of {FORMAT_VERSION})"
    try:
        raw = json.loads(content)
        file = _checked(raw if number == FORMAT_VERSION else as_version_4(raw))
    except ValidationError as error:
        raise FileFormatError(f"{path} is not a sound result{of_version}: {_in_words(error)}") from error
    except KeyError as error:
        raise FileFormatError(f"{path} is not a sound result{of_version}: it lacks {error}.") from error
    except (ValueError, TypeError, AttributeError) as error:
        raise FileFormatError(f"{path} is not a sound result{of_version}: {error}.") from error
    return Result(
        _of_class(Solution, file.certified),
        None if file.refined is None else _of_class(RefinedPoses, file.refined),
        file.log,
    )


def _of_class(base: Any, record: Any) -> Any:
    return base(**{field.name: getattr(record, field.name) for field in fields(base)})


def _content(path: str | Path, solution: Solution, refined: Refined | None, log: LogFields | None) -> bytes:
    """A file's content, read back once: what could not be read is not written."""
    judgement = judge(solution, refined, log)
    carriers = {"X": TARGET_CARRIER, "Y": SENSOR_CARRIER}
    if log is not None:
        carriers = {"X": log.target_carrier, "Y": log.sensor_carrier}
    try:
        certified = _posed(_to_json(solution, "$.certified"), solution, carriers)
        parts: dict[str, Any] = {"certified": certified}
        poses = {name: certified[name] for name in POSED}
        if refined is not None:
            fields_ = _posed(_to_json(_refined_fields(refined), "$.refined"), refined, carriers)
            poses = {name: fields_.pop(name) for name in POSED}
            parts["refined"] = fields_
        if log is not None:
            parts["log"] = log.model_dump(mode="json")
        tree = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "written_by": f"gtsam-rwhec {version('gtsam-rwhec')}",
            "verdict": judgement.verdict,
            "verdict_reason": judgement.reason,
            "verdict_grounds": judgement.grounds,
            **poses,
            "conventions": CONVENTIONS,
            **parts,
        }
        content = json.dumps(tree, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        _checked(json.loads(content))
    except ValidationError as error:
        raise FileFormatError(f"{path} was not written, the solution is not sound: {_in_words(error)}") from error
    except ValueError as error:
        raise FileFormatError(f"{path} was not written, the solution is not sound: {error}.") from error
    return content.encode("utf-8")


def _posed(tree: dict[str, Any], answer: Solution | RefinedPoses, carriers: Mapping[str, str]) -> dict[str, Any]:
    """A record's fields, with the poses under their names in files."""
    poses = {"targets": pose_rows(carriers["X"], answer.X), "sensors": pose_rows(carriers["Y"], answer.Y)}
    return {**poses, **{name: value for name, value in tree.items() if name not in ("X", "Y")}}


def _refined_fields(refined: Refined) -> RefinedFields:
    frames = {}
    for name in (*refined.X, *refined.Y):
        degrees, millimetres = (tuple(values.tolist()) for values in refined.standard_deviations(name))
        rows = [[None if np.isinf(value) else value for value in row] for row in refined.covariance(name).tolist()]
        frames[name] = FrameFields(degrees, millimetres, rows)
    kept = {field.name: getattr(refined, field.name) for field in fields(RefinedPoses)}
    return RefinedFields(**kept, residual=refined.options.residual, robust=refined.options.robust, frames=frames)


def _checked(tree: dict[str, Any]) -> ResultFile:
    """The records of a file; poses and scale at the top are those of the refined answer, if there is one."""
    posed = {name: tree[name] for name in POSED if name in tree}
    rest = {name: value for name, value in tree.items() if name not in posed}
    if isinstance(tree.get("refined"), dict):
        rest["refined"] = {**tree["refined"], **posed}
    return ResultFile.model_validate_json(json.dumps(_from_json(rest, "$", "")))


def _to_json(value: Any, place: str, field: str = "") -> Any:
    """A record as JSON has it: null for infinity, rows for what has pairs for keys, and a sentence where it makes one.

    Raises
    ------
    ValueError
        A number is not finite where it has to be.
    """
    if is_dataclass(value) and not isinstance(value, type):
        tree = {f.name: _to_json(getattr(value, f.name), f"{place}.{f.name}", f.name) for f in fields(value)}
        return {**tree, SENTENCE: str(value)} if isinstance(value, Certificate | FreeDirection) else tree
    if isinstance(value, Mapping):
        if field in ROWS:
            return [
                {**pair._asdict(), **(item if isinstance(item, dict) else {"value": item})}
                for pair, item in ((pair, _to_json(item, f"{place}[{pair}]", field)) for pair, item in value.items())
            ]
        return {str(key): _to_json(item, f"{place}.{key}", field) for key, item in value.items()}
    if isinstance(value, slice):
        return [value.start, value.stop]
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_to_json(item, f"{place}[{index}]", field) for index, item in enumerate(value)]
    if not isinstance(value, float) or math.isfinite(value):
        return None if isinstance(value, gtsam.Pose3) else value  # poses: see `_posed`
    if value == INFINITIES.get(field):
        return None
    allowed = f", or {INFINITIES[field]} (null)" if field in INFINITIES else ""
    raise ValueError(f"{place}: must be finite{allowed} (found {value})")


def _from_json(value: Any, place: str, field: str) -> Any:
    """The reverse of `_to_json`, with JSON's text for a pair as key; raises as it does, and for a row without one."""
    if isinstance(value, dict):
        told = {key: item for key, item in value.items() if key != SENTENCE or not isinstance(item, str)}
        return {key: _from_json(item, f"{place}.{key}", key) for key, item in told.items()}
    if isinstance(value, list) and field in ROWS and all(isinstance(row, dict) for row in value):
        rows = {}
        for index, row in enumerate(_from_json(value, place, "")):
            if not {"target", "sensor"} <= row.keys():
                raise ValueError(f"{place}[{index}]: a target and a sensor are missing")
            key = json.dumps([row.pop("target"), row.pop("sensor")])
            rows[key] = row["value"] if row.keys() == {"value"} else row
        return rows
    if isinstance(value, list):
        return [_from_json(item, f"{place}[{index}]", field) for index, item in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{place}: {value} is no number of JSON")
    return INFINITIES[field] if value is None and field in INFINITIES else value


def _in_words(error: ValidationError) -> str:
    """Every fault with its JSON path, the first three in full."""
    faults = []
    for fault in error.errors(include_url=False):
        keys = fault["loc"][1:] if fault["loc"][:1] == ("refined",) and fault["loc"][1] in POSED else fault["loc"]
        place = "$" + "".join(_step(key) for key in keys)
        given = repr(fault["input"])
        value = f" (found {given})" if len(given) <= 60 and fault["type"] != "missing" else ""
        faults.append(f"{place}: {fault['msg'].removeprefix('Value error, ')}{value}")
    rest = f"; and {len(faults) - 3} more" if len(faults) > 3 else ""
    return "; ".join(faults[:3]) + rest + "."


def _step(key: int | str) -> str:
    """A step of a JSON path; of rows, the one of a pair."""
    if isinstance(key, int):
        return f"[{key}]"
    return key if key.startswith("[") else f".{key}"
