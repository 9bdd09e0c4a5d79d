"""Calibrations written as JSON, so that every number is read back bit for bit.

Every file states its units and frame conventions itself; `gtsam_rwhec.results.schema` has the fields.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from gtsam_rwhec.calibration.calibrated import Calibration
from gtsam_rwhec.calibration.verdict import Judgement
from gtsam_rwhec.errors import FileFormatError, OptionError
from gtsam_rwhec.files.atomic_write import write_atomically
from gtsam_rwhec.files.paths import checked_path
from gtsam_rwhec.fitting.refined import Refined, RefinedPoses
from gtsam_rwhec.results.calibration_fields import CalibrationFields
from gtsam_rwhec.results.conventions import CONVENTIONS
from gtsam_rwhec.results.json_tree import POSED, in_words, to_json
from gtsam_rwhec.results.judging import contradicted_names, judge
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.results.result_file import checked_file
from gtsam_rwhec.results.schema import (
    FORMAT,
    FORMAT_VERSION,
    SENSOR_CARRIER,
    TARGET_CARRIER,
    FrameFields,
    RefinedFields,
    pose_rows,
)
from gtsam_rwhec.solving.solution import Solution

CARRIERS = {"X": TARGET_CARRIER, "Y": SENSOR_CARRIER}


def write_solution(solution: Solution, path: str | Path) -> None:
    """Write a solution as JSON. A reader finds the old file or the whole new file, never a part.

    Parameters
    ----------
    solution : Solution
        The result of `gtsam_rwhec.solve`.
    path : str or Path
        The file; an existing file is replaced. Its folder must exist.

    Raises
    ------
    FileFormatError
        The file cannot be written (the message says why), or a number of the solution is NaN.
    """
    path = checked_path(path)
    write_atomically(path, _content(path, solution, None, None))


def write_refined(refined: Refined, path: str | Path, log: LogFields | None = None) -> None:
    """Write a refined calibration as JSON, with the certified solution at which the refinement began.

    The factor graph is not written. Raises as `write_solution` does.

    Parameters
    ----------
    refined : Refined
        The result of `gtsam_rwhec.refine`.
    path : str or Path
        The file; an existing file is replaced. Its folder must exist.
    log : LogFields, optional
        What became of the measurements, if they come from a log.
    """
    path = checked_path(path)
    if not isinstance(refined, Refined):
        raise OptionError(f"refined is a {type(refined).__name__}; give what gtsam_rwhec.refine returned")
    write_atomically(path, _content(path, refined.solution, refined, log))


def write_calibration(calibration: Calibration, path: str | Path, log: LogFields | None = None) -> None:
    """Write a calibration as JSON: verdict, poses, certificate, covariances, and every choice with its evidence.

    The factor graph is not written. Raises as `write_solution` does.

    Parameters
    ----------
    calibration : Calibration
        The result of `gtsam_rwhec.calibrate`.
    path : str or Path
        The file; an existing file is replaced. Its folder must exist.
    log : LogFields, optional
        What became of the measurements, if they come from a log.
    """
    path = checked_path(path)
    if not isinstance(calibration, Calibration):
        raise OptionError(f"calibration is a {type(calibration).__name__}; give what gtsam_rwhec.calibrate returned")
    write_atomically(path, calibration_json(calibration, log, path))


def calibration_json(calibration: Calibration, log: LogFields | None = None, path: str | Path = "the result") -> bytes:
    """What `write_calibration` writes."""
    record, names = CalibrationFields.of(calibration), calibration.carriers
    if calibration.solution is None:
        return _without_answer(path, calibration, record)
    carriers = {"X": names.targets or TARGET_CARRIER, "Y": names.sensors or SENSOR_CARRIER}
    return _content(path, calibration.solution, calibration.refined, log, record, carriers)


def _content(
    path: str | Path,
    solution: Solution,
    refined: Refined | None,
    log: LogFields | None,
    calibration: CalibrationFields | None = None,
    carriers: Mapping[str, str] = CARRIERS,
) -> bytes:
    """The content of a file. It is read back here once, so that every written file can be read."""
    judgement = judge(solution, refined, log, () if calibration is None else calibration.findings)
    if log is not None:
        carriers = {"X": log.target_carrier, "Y": log.sensor_carrier}
    try:
        wrong = contradicted_names(refined, log)
        certified = _posed(to_json(solution, "$.certified"), solution, carriers, wrong)
        parts: dict[str, Any] = {"certified": certified}
        poses = {name: certified[name] for name in POSED}
        if refined is not None:
            parts["refined"] = _posed(to_json(_refined_fields(refined), "$.refined"), refined, carriers, wrong)
            poses = {name: parts["refined"].pop(name) for name in POSED}
        if calibration is not None:
            parts["calibration"] = to_json(calibration, "$.calibration")
        if log is not None:
            parts["log"] = log.model_dump(mode="json")
        tree = {**_heading(judgement), **poses, "conventions": CONVENTIONS, **parts}
        content = json.dumps(tree, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        encoded = content.encode("utf-8")  # a name may have half a character
        checked_file(json.loads(content), FORMAT_VERSION)
    except ValueError as error:
        raise FileFormatError(f"{path} was not written, because the result is not valid: {in_words(error)}") from error
    return encoded


def _without_answer(path: str | Path, calibration: Calibration, record: CalibrationFields) -> bytes:
    """The content of a file for a calibration that has no answer: its verdict, for programs, and no poses."""
    judgement = calibration.judgement
    tree = {
        **_heading(judgement),
        "sensors": [],
        "targets": [],
        "conventions": CONVENTIONS,
        "calibration": to_json(record, "$.calibration"),
    }
    return (json.dumps(tree, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode("utf-8")


def _heading(judgement: Judgement) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "written_by": f"gtsam-rwhec {version('gtsam-rwhec')}",
        "verdict": judgement.verdict.value,
        "verdict_reason": judgement.reason,
        "verdict_grounds": judgement.grounds,
    }


def _posed(
    tree: dict[str, Any], answer: Solution | RefinedPoses, carriers: Mapping[str, str], contradicted: Collection[str]
) -> dict[str, Any]:
    """Put the poses into a record's JSON, under the names that files have for them."""
    poses = {
        "targets": pose_rows(carriers["X"], answer.X, contradicted),
        "sensors": pose_rows(carriers["Y"], answer.Y, contradicted),
    }
    return {**poses, **{name: value for name, value in tree.items() if name not in ("X", "Y")}}


def _refined_fields(refined: Refined) -> RefinedFields:
    frames = {}
    for name in (*refined.X, *refined.Y):
        degrees, millimetres = (tuple(values.tolist()) for values in refined.standard_deviations(name))
        rows = [[None if np.isinf(value) else value for value in row] for row in refined.covariance(name).tolist()]
        frames[name] = FrameFields(degrees, millimetres, rows)
    kept = {field.name: getattr(refined, field.name) for field in fields(RefinedPoses)}
    return RefinedFields(**kept, residual=refined.options.residual, robust=refined.options.robust, frames=frames)
