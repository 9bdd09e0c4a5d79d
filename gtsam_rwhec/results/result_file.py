"""Result files: calibrations are read back bit for bit, and everything in a file is checked.

`gtsam_rwhec.results.schema` has the fields, `gtsam_rwhec.results.written_result` writes them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from gtsam_rwhec.calibration.verdict import Judgement, Verdict
from gtsam_rwhec.errors import FileFormatError, ResultVersionError
from gtsam_rwhec.files.terminal_text import brief, shown
from gtsam_rwhec.files.whole_files import read_whole
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.results.agreement import (
    check_certificates,
    check_log,
    check_says_what_it_is_about,
    check_scale,
    check_sizes,
    check_top,
    check_verdict,
)
from gtsam_rwhec.results.calibration_fields import CalibrationFields
from gtsam_rwhec.results.corners_agreement import check_corners
from gtsam_rwhec.results.covariance_agreement import check_frames, check_joint
from gtsam_rwhec.results.earlier_versions import (
    FIRST_VERSION,
    FIRST_WITH_CALIBRATION,
    FIRST_WITH_REGION,
    FIRST_WITH_VERDICT,
    as_version_4,
)
from gtsam_rwhec.results.json_text import MOST_BYTES, parse_json
from gtsam_rwhec.results.json_tree import POSED, from_json, in_words
from gtsam_rwhec.results.judging import judge
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.results.schema import FORMAT, FORMAT_VERSION, ResultFile
from gtsam_rwhec.solving.solution import Solution


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
