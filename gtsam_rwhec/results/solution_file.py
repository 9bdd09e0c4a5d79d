"""Writing a solution to a JSON file and reading it back, bit for bit.

The fields are described one by one in `gtsam_rwhec.results.schema`; units and frame conventions are also written inside
every file. Poses carry the rotation twice: as a matrix, which is read back, and as a quaternion, for other programs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import gtsam
import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from gtsam_rwhec.errors import FileFormatError, ResultVersionError
from gtsam_rwhec.files.atomic_write import write_atomically
from gtsam_rwhec.identifiability.free_directions import FreeDirection, FreeKind
from gtsam_rwhec.identifiability.verdicts import Identifiability, PairIdentifiability
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.results.schema import (
    CONVENTIONS,
    FORMAT,
    FORMAT_VERSION,
    UNREFINED_VERSION,
    CertificateFields,
    IdentifiabilityFields,
    PairFields,
    Part,
    Pose,
    ResultFile,
    Scale,
)
from gtsam_rwhec.solver.cause import Cause, SearchPath
from gtsam_rwhec.solver.certificate import Certificate, Objective
from gtsam_rwhec.solver.parts import Kind
from gtsam_rwhec.solver.residuals import Residual
from gtsam_rwhec.solving.solution import Solution, SolvedPart


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
    write_result(path, lambda: fields_of(solution))


def write_result(path: str | Path, make: Callable[[], ResultFile]) -> None:
    """Write the fields that ``make`` returns.

    Raises
    ------
    FileFormatError
        The file cannot be written (the message says why), or ``make`` meets a number that is none.
    """
    write_atomically(path, result_json(make, path))


def result_json(make: Callable[[], ResultFile], path: str | Path) -> bytes:
    """The fields that ``make`` returns as JSON; `path` is for messages.

    Raises
    ------
    FileFormatError
        ``make`` meets a number that is none.
    """
    try:
        result = make()
    except ValidationError as error:
        raise FileFormatError(f"{path} was not written, the solution is not sound: {_in_words(error)}") from error
    absent = {name for name in ("refined", "log") if getattr(result, name) is None}
    return (result.model_dump_json(indent=2, exclude=absent) + "\n").encode("utf-8")


def read_solution(path: str | Path) -> Solution:
    """Read what `write_solution` wrote: every number is the same double as before.

    Of a refined calibration's file, the certified solution that was refined (`gtsam_rwhec.read_refined`: the rest).

    Raises
    ------
    ResultVersionError
        The file has another version of the format; the message says what to do.
    FileFormatError
        The file cannot be read, is not JSON, is not a result, or a field is missing, unknown or not what it should be;
        the message gives its JSON path.
    """
    return solution_of(read_result(path))


def read_result(path: str | Path) -> ResultFile:
    """Read a file's fields; raises as `read_solution` does."""
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise FileFormatError(f"{path} cannot be read: {error.strerror}.") from error
    return parse_result(content, path)


def parse_result(content: bytes, path: str | Path) -> ResultFile:
    """The fields of a file's content; `path` is for messages. Raises as `read_solution` does."""
    try:
        header = _Header.model_validate_json(content)
    except ValidationError as error:
        raise FileFormatError(f"{path} is not a result of gtsam-rwhec: {_in_words(error)}") from error
    if header.format != FORMAT:
        raise FileFormatError(
            f"{path}: $.format is {header.format!r}, expected {FORMAT!r}: this is another kind of file."
        )
    if not UNREFINED_VERSION <= header.format_version <= FORMAT_VERSION:
        remedy = (
            "install a newer gtsam-rwhec"
            if header.format_version > FORMAT_VERSION
            else "calibrate again to write it anew"
        )
        raise ResultVersionError(
            f"{path} has version {header.format_version} of the result format (written by {header.written_by}); this "
            f"gtsam-rwhec reads versions {UNREFINED_VERSION} to {FORMAT_VERSION}: {remedy}."
        )
    try:
        return ResultFile.model_validate_json(content)
    except ValidationError as error:
        raise FileFormatError(f"{path} is not a sound result: {_in_words(error)}") from error


def _in_words(error: ValidationError) -> str:
    """Every fault with its JSON path, the first three in full."""
    faults = []
    for fault in error.errors(include_url=False):
        place = "$" + "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in fault["loc"])
        given = repr(fault["input"])
        value = f" (found {given})" if len(given) <= 60 and fault["type"] != "missing" else ""
        faults.append(f"{place}: {fault['msg'].removeprefix('Value error, ')}{value}")
    rest = f"; and {len(faults) - 3} more" if len(faults) > 3 else ""
    return "; ".join(faults[:3]) + rest + "."


def fields_of(solution: Solution) -> ResultFile:
    """A solution's fields."""
    identifiability = solution.identifiability
    return ResultFile(
        format=FORMAT,
        format_version=UNREFINED_VERSION,
        written_by=f"gtsam-rwhec {version('gtsam-rwhec')}",
        conventions=CONVENTIONS,
        targets=tuple(pose_to_file("targetcarrier", name, pose) for name, pose in solution.X.items()),
        sensors=tuple(pose_to_file("sensorcarrier", name, pose) for name, pose in solution.Y.items()),
        scale=scale_to_file(solution.scale_mode, solution.scale),
        cost=solution.cost,
        is_relative=solution.is_relative,
        certificate=_certificate_to_file(solution.certificate),
        identifiability=IdentifiabilityFields(
            is_unique=identifiability.is_unique,
            free_directions=tuple(map(str, identifiability.free_directions)),
            weakest=identifiability.weakest,
            threshold=identifiability.threshold,
            explanation=str(identifiability),
            parts=identifiability.parts,
        ),
        pairs=tuple(
            PairFields(
                target=pair.target,
                sensor=pair.sensor,
                number_of_measurements=residual.number_of_measurements,
                translation_rms_m=residual.translation_rms_m,
                rotation_rms_rad=residual.rotation_rms_rad,
                is_unique=identifiability.pairs[pair].is_unique,
                free_directions=tuple(map(str, identifiability.pairs[pair].free_directions)),
                rotation_axes=identifiability.pairs[pair].rotation_axes,
                weakest=identifiability.pairs[pair].weakest,
                threshold=identifiability.pairs[pair].threshold,
            )
            for pair, residual in solution.residuals.items()
        ),
        parts=tuple(
            Part(names=part.names, certificate=_certificate_to_file(part.certificate)) for part in solution.parts
        ),
    )


def solution_of(file: ResultFile) -> Solution:
    """The certified solution among a file's fields."""
    identifiability = Identifiability(
        is_unique=file.identifiability.is_unique,
        free_directions=in_words(file.identifiability.free_directions),
        weakest=file.identifiability.weakest,
        threshold=file.identifiability.threshold,
        pairs={
            Pair(pair.target, pair.sensor): PairIdentifiability(
                is_unique=pair.is_unique,
                free_directions=in_words(pair.free_directions),
                rotation_axes=pair.rotation_axes,
                number_of_measurements=pair.number_of_measurements,
                weakest=pair.weakest,
                threshold=pair.threshold,
            )
            for pair in file.pairs
        },
        parts=file.identifiability.parts,
    )
    return Solution(
        X={pose.child: pose_from_file(pose) for pose in file.targets},
        Y={pose.child: pose_from_file(pose) for pose in file.sensors},
        scale=scale_from_file(file.scale),
        scale_mode=file.scale.mode,
        cost=file.cost,
        is_relative=file.is_relative,
        certificate=_certificate_from_file(file.certificate),
        identifiability=identifiability,
        residuals={
            Pair(pair.target, pair.sensor): Residual(
                pair.number_of_measurements, pair.translation_rms_m, pair.rotation_rms_rad
            )
            for pair in file.pairs
        },
        parts=tuple(SolvedPart(part.names, _certificate_from_file(part.certificate)) for part in file.parts),
    )


def in_words(sentences: tuple[str, ...]) -> tuple[FreeDirection, ...]:
    """Free directions of a format that has them in words only."""
    return tuple(FreeDirection(FreeKind.WORDS, None, words=words) for words in sentences)


def scale_to_file(mode: ScaleMode, scale: float | Mapping[str, float]) -> Scale:
    """A scale's fields."""
    if isinstance(scale, Mapping):
        return Scale(mode=mode, value=None, by_frame=dict(scale))
    return Scale(mode=mode, value=scale, by_frame=None)


def scale_from_file(fields: Scale) -> float | dict[str, float]:
    """One scale, or each one's own; Scale's own check has seen to it that one of the two is there."""
    return fields.value if fields.value is not None else dict(fields.by_frame or {})


def pose_to_file(parent: Literal["targetcarrier", "sensorcarrier"], child: str, pose: gtsam.Pose3) -> Pose:
    """A pose's fields."""
    q: Any = pose.rotation().toQuaternion()  # Eigen's quaternion, of which gtsam's stubs say nothing
    first, second, third = pose.rotation().matrix().tolist()
    return Pose(
        parent=parent,
        child=child,
        translation_m=tuple(pose.translation().tolist()),
        quaternion_wxyz=(q.w(), q.x(), q.y(), q.z()),
        rotation_matrix=(tuple(first), tuple(second), tuple(third)),
    )


def pose_from_file(pose: Pose) -> gtsam.Pose3:
    """The pose that the fields are of."""
    return gtsam.Pose3(gtsam.Rot3(np.array(pose.rotation_matrix)), np.array(pose.translation_m))


#: The objectives as formats up to version 3 have them.
_FORMS: tuple[tuple[Kind, str], ...] = (
    (
        "direct",
        "Problem 3: half the squared residuals of A X = Y B, R_A t_X + alpha t_A - t_Y - R_Y t_B over sigma and "
        "R_A R_X - R_Y R_B times the square root of kappa",
    ),
    (
        "inverse",
        "the equation turned round: half the squared residuals of B X^-1 = Y^-1 A, with each t_B divided by its "
        "scale (refine for the exact per-target model)",
    ),
)
_OBJECTIVES = {
    text + priors: Objective(form, bool(priors)) for form, text in _FORMS for priors in ("", ", and the priors")
}


def _certificate_to_file(certificate: Certificate) -> CertificateFields:
    return CertificateFields(
        status=certificate.status,
        reason=certificate.reason,
        objective=next(text for text, objective in _OBJECTIVES.items() if objective == certificate.objective),
        path=str(certificate.path),
        cost=certificate.cost,
        lower_bound=certificate.lower_bound,
        float_bound=certificate.float_bound,
        min_eigenvalue=certificate.min_eigenvalue,
        tolerance=certificate.tolerance,
        is_relative=certificate.is_relative,
        seconds=certificate.seconds,
    )


def _certificate_from_file(fields: CertificateFields) -> Certificate:
    return Certificate(
        status=fields.status,
        cause=Cause.NOT_RECORDED,
        objective=_OBJECTIVES[fields.objective],
        path=SearchPath.parse(fields.path),
        cost=fields.cost,
        lower_bound=fields.lower_bound,
        float_bound=fields.float_bound,
        min_eigenvalue=fields.min_eigenvalue,
        tolerance=fields.tolerance,
        is_relative=fields.is_relative,
        seconds=dict(fields.seconds),
        words=fields.reason,
    )
