"""Result files: calibrations are read back bit for bit, and everything in a file is checked.

`gtsam_rwhec.results.schema` has the fields, `gtsam_rwhec.results.result_file` writes them.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.verdict import Judgement, Verdict
from gtsam_rwhec.errors import FileFormatError, OptionError, ResultVersionError
from gtsam_rwhec.files.terminal_text import brief, shown
from gtsam_rwhec.files.whole_files import checked_path, read_whole, write_atomically
from gtsam_rwhec.fitting.refined import Refined, RefinedPoses
from gtsam_rwhec.results.agreement import (
    check_certificates,
    check_log,
    check_says_what_it_is_about,
    check_scale,
    check_sizes,
    check_top,
    check_verdict,
)
from gtsam_rwhec.results.corners_agreement import check_corners
from gtsam_rwhec.results.covariance_agreement import check_frames, check_joint
from gtsam_rwhec.results.earlier_versions import (
    FIRST_VERSION,
    FIRST_WITH_CALIBRATION,
    FIRST_WITH_REGION,
    FIRST_WITH_VERDICT,
    as_version_4,
)
from gtsam_rwhec.results.json_tree import MOST_BYTES, POSED, from_json, in_words, parse_json, to_json
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.results.result_judgement import contradicted_names, judge
from gtsam_rwhec.results.schema import (
    CONVENTIONS,
    FORMAT,
    FORMAT_VERSION,
    SENSOR_CARRIER,
    TARGET_CARRIER,
    CalibrationFields,
    FrameFields,
    RefinedFields,
    ResultFile,
    pose_rows,
)
from gtsam_rwhec.solver.solution import Solution


@dataclass(frozen=True)
class Result:
    """The content of a result file.

    Attributes
    ----------
    solution : Solution
        The certified solution.
    refined : RefinedPoses or None
        The refined calibration; None if the solution was not refined.
    log : LogFields or None
        What became of the measurements; None if they do not come from a log.
    calibration : CalibrationFields or None
        What ``calibrate`` found and chose; None if it did not run.
    """

    solution: Solution
    refined: RefinedPoses | None
    log: LogFields | None
    calibration: CalibrationFields | None = None

    @property
    def judgement(self) -> Judgement:
        """The verdict, with its grounds."""
        findings = () if self.calibration is None else self.calibration.findings
        return judge(self.solution, self.refined, self.log, findings)


class _Header(BaseModel):
    """The fields that tell which program wrote a file, whatever the rest of the file holds."""

    model_config = ConfigDict(extra="ignore", strict=True)

    format: str
    format_version: int
    written_by: str = "an unknown program"


def read_solution(path: str | Path) -> Solution:
    """Read the certified solution of a result file: every number is the same double as before.

    Raises
    ------
    ResultVersionError
        A newer version of this library wrote the file; the message says what to do.
    FileFormatError
        The file cannot be read, is not JSON, or is not a result; or a field is missing, unknown or wrong. The message
        gives the JSON path of the field.
    """
    return read_result(path).solution


def read_refined(path: str | Path) -> RefinedPoses:
    """Read the refined calibration of a result file: poses and covariances are the same doubles as before.

    Raises
    ------
    ResultVersionError, FileFormatError
        As `read_solution` does; and if the file holds no refined poses.
    """
    refined = read_result(path).refined
    if refined is None:
        raise FileFormatError(
            f"{path} holds a solution that was not refined. Read it with read_solution, or refine it and write it "
            "again (rw.calibrate and rw.write_calibration, or rw.write_refined)."
        )
    return refined


def read_result(path: str | Path) -> Result:
    """Read everything that a file holds; raises as `read_solution` does."""
    return parse_result(read_whole(path, MOST_BYTES, "A result was"), path)


def parse_result(content: bytes, path: str | Path) -> Result:
    """Read the content of a file; messages name `path`. Raises as `read_solution` does."""
    try:
        raw = parse_json(content)
        fields = {name: raw[name] for name in _Header.model_fields if name in raw} if isinstance(raw, dict) else raw
        header = _Header.model_validate(fields)
    except ValueError as error:
        raise FileFormatError(f"{path} is not a result of gtsam-rwhec: {in_words(error)}") from error
    if header.format != FORMAT:
        raise FileFormatError(
            f"{path}: $.format is {brief(header.format)}, expected {FORMAT!r}: this is another kind of file."
        )
    number = header.format_version
    if not FIRST_VERSION <= number <= FORMAT_VERSION:
        remedy = "Install a newer gtsam-rwhec" if number > FORMAT_VERSION else "Calibrate again to write a new file"
        raise ResultVersionError(
            f"{path} has version {number} of the result format (written by {shown(header.written_by)}); this "
            f"gtsam-rwhec reads versions {FIRST_VERSION} to {FORMAT_VERSION}. {remedy}."
        )
    if number >= FIRST_WITH_CALIBRATION and "certified" not in raw and raw.get("verdict") == Verdict.DO_NOT_USE.value:
        why = shown(str(raw.get("verdict_reason")))
        raise FileFormatError(f"{path} has no poses, because the calibration has no answer: {why}")
    try:
        if number < FIRST_WITH_VERDICT:
            raw = as_version_4(raw)
        if number >= FIRST_WITH_REGION:
            check_says_what_it_is_about(raw)
        file = checked_file(
            {**raw, "format_version": FORMAT_VERSION}, number
        )  # version 4 lacks fields that have defaults
        result = _result_of(file)
        if number >= FIRST_WITH_VERDICT:
            check_verdict(file.verdict, file.verdict_grounds, result.judgement, number)
    except ValueError as error:
        of_version = (
            "" if number == FORMAT_VERSION else f" of version {number} (converted places are those of {FORMAT_VERSION})"
        )
        raise FileFormatError(f"{path} is not a valid result{of_version}: {in_words(error)}") from error
    return result


def _result_of(file: ResultFile) -> Result:
    refined = None if file.refined is None else _of_class(RefinedPoses, file.refined)
    return Result(_of_class(Solution, file.certified), refined, file.log, file.calibration)


def _of_class(base: Any, record: Any) -> Any:
    return base(**{field.name: getattr(record, field.name) for field in fields(base)})


def checked_file(tree: dict[str, Any], version: int) -> ResultFile:
    """Check the fields of a file of this version and make records of them.

    `POSED` at the top belong to the refined answer, if any.

    Raises
    ------
    ValueError
        A field is missing, unknown or wrong, or two fields contradict one another; the message has the JSON path.
    """
    posed = {name: tree[name] for name in POSED if name in tree}
    rest = {name: value for name, value in tree.items() if name not in posed}
    if isinstance(tree.get("refined"), dict):
        rest["refined"] = {**tree["refined"], **posed}
    file = ResultFile.model_validate_json(json.dumps(from_json(rest)))
    check_certificates(file.certified)
    check_scale(file.certified, "$.certified.scale")
    check_sizes(file.certified, file.refined)
    if file.log is not None:
        check_log(file.log, version)
    if file.refined is None:
        check_top(tree)
    else:
        check_scale(file.refined, "$.scale")
        check_joint(file.refined, file.certified)
        check_frames(file.refined, _of_class(RefinedPoses, file.refined))
        check_corners(file.refined)
    return file


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


#: The name of the result in an output folder.
RESULT_FILE = "result.json"


def result_path(path: str | Path) -> Path:
    """The result file that a path means: itself, or the one in this folder; FileFormatError if there is none."""
    path = Path(path)
    if not path.is_dir():
        return path
    inside = path / RESULT_FILE
    if not inside.is_file():
        raise FileFormatError(
            f"{path} has no {RESULT_FILE}; give a folder that gtsam-rwhec calibrate wrote, or a result file"
        )
    return inside


def read_calibration(path: str | Path) -> Result:
    """Read ``result.json``, or the one in a folder that ``calibrate`` wrote; raises as ``rw.results.read_result``."""
    return read_result(result_path(path))
