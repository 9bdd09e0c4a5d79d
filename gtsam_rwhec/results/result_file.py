"""Result files: calibrations are written as JSON and read back bit for bit, and what is read is checked.

Every file states its units and frame conventions itself; `gtsam_rwhec.results.schema` has the fields.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict
from pydantic_core import from_json as values_of
from pydantic_core import to_json as json_of

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.verdict import Judgement, Verdict
from gtsam_rwhec.errors import FileFormatError, ResultVersionError
from gtsam_rwhec.files.terminal_text import brief, shown
from gtsam_rwhec.files.whole_files import checked_path, read_whole, write_atomically
from gtsam_rwhec.fitting.refined import Refined, RefinedPoses
from gtsam_rwhec.fitting.refinement_from_poses import movements
from gtsam_rwhec.geometry.real_numbers import check_kind
from gtsam_rwhec.results.acceptance_record import Acceptance
from gtsam_rwhec.results.json_tree import MOST_BYTES, POSED, from_json, in_words, parse_json, to_json
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.results.result_checks import (
    check_acceptance,
    check_certificates,
    check_corners,
    check_joint,
    check_log,
    check_sizes,
    check_verdict,
)
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
from gtsam_rwhec.solver.free_directions import FreeDirection
from gtsam_rwhec.solver.solution import Solution

#: The name of the result in an output folder.
RESULT_FILE = "result.json"
#: Fields of the certified solution that the file does not repeat: they stand in its certificate.
OF_CERTIFICATE = ("cost", "is_relative")
#: Fields of a certificate that limit what it proves.
LIMITS = ("basis", "region")


@dataclass(frozen=True)
class Result:
    """The content of a result file."""

    solution: Solution  #: The certified solution
    refined: RefinedPoses | None  #: The refined calibration; None if the solution was not refined
    log: LogFields | None  #: What became of the measurements; None if they do not come from a log
    calibration: CalibrationFields | None = None  #: What ``calibrate`` found and chose; None if it did not run
    acceptance: tuple[Acceptance, ...] = ()  #: By sensor, what `gtsam_rwhec.accept` showed of it

    @property
    def free_directions(self) -> tuple[FreeDirection, ...]:
        """What the measurements leave free."""
        refined = () if self.refined is None else self.refined.free_directions
        return refined or self.solution.identifiability.free_directions

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
        Another version of this library wrote the file; the message says what to do.
    FileFormatError
        The file cannot be read, is not JSON, or is not a result; or a field is missing, unknown or wrong. The message
        gives the JSON path of the field.
    """
    return read_result(path).solution


def read_refined(path: str | Path) -> RefinedPoses:
    """Read the refined calibration of a result file; raises as `read_solution`, and if it holds no refined poses."""
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


def read_calibration(path: str | Path) -> Result:
    """Read ``result.json``, or the one in a folder that ``calibrate`` wrote; raises as `read_solution` does."""
    return read_result(result_path(path))


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


def parse_result(content: bytes, path: str | Path) -> Result:
    """Read the content of a file; messages name `path`. Raises as `read_solution` does."""
    return result_of(parse_tree(content, path), path)


def result_of(tree: dict[str, Any], path: str | Path) -> Result:
    """What the JSON values of a file hold; messages name `path`. Raises as `read_solution` does."""
    if has_no_answer(tree):
        why = shown(str(tree.get("verdict_reason")))
        raise FileFormatError(f"{path} has no poses, because the calibration has no answer: {why}")
    try:
        file = checked_file(tree)
        solution, refined = _of_class(Solution, file.certified), None
        if file.refined is not None:
            refined = _of_class(RefinedPoses, file.refined)
            refined = replace(refined, moved=movements(solution, refined.X, refined.Y))
        result = Result(solution, refined, file.log, file.calibration, file.acceptance)
        check_verdict(file.verdict, file.verdict_grounds, result.judgement)
    except ValueError as error:
        raise FileFormatError(f"{path} is not a valid result: {in_words(error)}") from error
    return result


def parse_tree(content: bytes, path: str | Path) -> dict[str, Any]:
    """The JSON values of a result file of this version; its fields are not checked."""
    try:
        raw = parse_json(content)
        heading = {name: raw[name] for name in _Header.model_fields if name in raw} if isinstance(raw, dict) else raw
        header = _Header.model_validate(heading)
    except ValueError as error:
        raise FileFormatError(f"{path} is not a result of gtsam-rwhec: {in_words(error)}") from error
    if header.format != FORMAT:
        raise FileFormatError(
            f"{path}: $.format is {brief(header.format)}, expected {FORMAT!r}: this is another kind of file."
        )
    if header.format_version != FORMAT_VERSION:
        is_newer = header.format_version > FORMAT_VERSION
        remedy = ", or install the gtsam-rwhec that wrote it" if is_newer else " to write a new file"
        raise ResultVersionError(
            f"{path} has version {header.format_version} of the result format (written by {shown(header.written_by)}); "
            f"this gtsam-rwhec reads version {FORMAT_VERSION}. Calibrate again{remedy}."
        )
    tree: dict[str, Any] = raw
    return tree


def has_no_answer(tree: Mapping[str, Any]) -> bool:
    """Whether a file is of a calibration without an answer: it has a verdict, and no poses."""
    return (
        "certified" not in tree
        and tree.get("verdict") == Verdict.DO_NOT_USE
        and isinstance(tree.get("verdict_reason"), str)
    )


def _of_class(base: Any, record: Any) -> Any:
    return base(**{field.name: getattr(record, field.name) for field in fields(base)})


def checked_file(tree: dict[str, Any]) -> ResultFile:
    """Check the fields of a file and make records of them.

    Raises `ValueError` if a field is missing, unknown or wrong, or two contradict one another, with the JSON path.
    """
    owner = "refined" if isinstance(tree.get("refined"), dict) else "certified"
    try:
        content = json_of(_with_what_follows(from_json(tree), owner), inf_nan_mode="constants")
        file = ResultFile.model_validate_json(content)
    except ValueError as error:
        raise ValueError(in_words(error, owner).removesuffix(".")) from error
    check_certificates(file.certified)
    check_sizes(file.certified, file.refined)
    if file.log is not None:
        check_log(file.log)
    if file.refined is not None:
        check_corners(file.refined)
        check_joint(file.refined, file.certified)
    check_acceptance(file.acceptance, file.certified.Y)
    return file


def _with_what_follows(tree: dict[str, Any], owner: str) -> dict[str, Any]:
    """The tree as the records have it: with `POSED` in its ``owner``, and with what a file does not repeat."""
    certified, answer = tree.get("certified"), tree.get(owner)
    if not isinstance(certified, dict) or not isinstance(answer, dict):
        return tree  # the schema says what is missing
    again = [
        *(f"$.{owner}.{name}" for name in POSED if name in answer),
        *(f"$.certified.{name}" for name in OF_CERTIFICATE if name in certified),
    ]
    if again:
        raise ValueError(f"{again[0]}: unknown field")
    answer |= {name: tree.pop(name) for name in POSED if name in tree}
    certificate, residuals = certified.get("certificate"), certified.get("residuals")
    if isinstance(certificate, dict):
        certified |= {name: certificate[name] for name in OF_CERTIFICATE if name in certificate}
        missing = [name for name in LIMITS if name not in certificate]
        if missing:  # without one it would claim too much
            raise ValueError(f"$.certified.certificate.{missing[0]}: is missing")
    identifiability = certified.get("identifiability")
    pairs = identifiability.get("pairs") if isinstance(identifiability, dict) else None
    if isinstance(residuals, dict) and isinstance(pairs, dict):
        for key, residual in residuals.items():
            of_pair = pairs.get(key)
            if isinstance(residual, dict) and isinstance(of_pair, dict) and "number_of_measurements" in of_pair:
                residual["number_of_measurements"] = of_pair["number_of_measurements"]
    if isinstance(tree.get("refined"), dict):
        tree["refined"]["moved"] = {}
    return tree


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
    write_atomically(path, result_json(solution, path=path))


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
    check_kind(refined, Refined, "refined", "what gtsam_rwhec.refine returned")
    write_atomically(path, result_json(refined, log, path))


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
    check_kind(calibration, Calibration, "calibration", "what gtsam_rwhec.calibrate returned")
    write_atomically(path, result_json(calibration, log, path))


def result_json(
    answer: Calibration | Refined | Solution, log: LogFields | None = None, path: str | Path = "the result"
) -> bytes:
    """The content of the file of an answer. It is read back here once, so that every written file can be read."""
    refined: Refined | None = None
    record: CalibrationFields | None = None
    targets, sensors = TARGET_CARRIER, SENSOR_CARRIER
    if isinstance(answer, Calibration):
        record = CalibrationFields.of(answer)
        if answer.solution is None:
            none = {"sensors": [], "targets": [], "conventions": CONVENTIONS}
            return encoded({**_heading(answer.judgement), **none, "calibration": to_json(record, "$.calibration")})
        solution, refined = answer.solution, answer.refined
        targets, sensors = answer.carriers.targets or targets, answer.carriers.sensors or sensors
    elif isinstance(answer, Refined):
        solution, refined = answer.solution, answer
    else:
        solution = answer
    if log is not None:
        targets, sensors = log.target_carrier, log.sensor_carrier
    try:
        judgement = judge(solution, refined, log, () if record is None else record.findings)
        wrong = contradicted_names(refined, log)
        certified = _posed(solution, "$.certified", (targets, sensors), wrong, OF_CERTIFICATE)
        for residual in certified["residuals"]:
            residual.pop("number_of_measurements")
        parts: dict[str, Any] = {"certified": certified}
        if refined is not None:
            parts["refined"] = _posed(_refined_fields(refined), "$.refined", (targets, sensors), wrong, ("moved",))
        owner = parts["certified" if refined is None else "refined"]
        poses = {name: owner.pop(name) for name in POSED}
        if record is not None:
            parts["calibration"] = to_json(record, "$.calibration")
        if log is not None:
            parts["log"] = log.model_dump(mode="json")
        content = encoded({**_heading(judgement), **poses, "conventions": CONVENTIONS, **parts})
        checked_file(values_of(content))
    except ValueError as error:
        raise FileFormatError(f"{path} was not written, because the result is not valid: {in_words(error)}") from error
    return content


def encoded(tree: dict[str, Any]) -> bytes:
    """JSON in UTF-8. Raises `ValueError` if a name has a lone surrogate, or a number is not finite."""
    content = json_of(tree, indent=2, inf_nan_mode="constants") + b"\n"
    values_of(content, allow_inf_nan=False)
    return content


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
    answer: Solution | RefinedPoses,
    place: str,
    carriers: tuple[str, str],
    contradicted: Collection[str],
    without: Collection[str],
) -> dict[str, Any]:
    """A record's JSON with its poses under the names that files have for them, without what stands elsewhere."""
    poses = {
        "targets": pose_rows(carriers[0], answer.X, contradicted),
        "sensors": pose_rows(carriers[1], answer.Y, contradicted),
    }
    tree = to_json(answer, place)
    return {**poses, **{name: value for name, value in tree.items() if name not in ("X", "Y", *without)}}


def _refined_fields(refined: Refined) -> RefinedFields:
    frames = {}
    for name in (*refined.X, *refined.Y):
        degrees, millimetres = (tuple(values.tolist()) for values in refined.standard_deviations(name))
        rows = [[None if np.isinf(value) else value for value in row] for row in refined.covariance(name).tolist()]
        frames[name] = FrameFields(degrees, millimetres, rows)
    kept = {field.name: getattr(refined, field.name) for field in fields(RefinedPoses)}
    return RefinedFields(**kept, residual=refined.options.residual, robust=refined.options.robust, frames=frames)
