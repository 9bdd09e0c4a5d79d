"""Result files of versions 1 to 3, converted to version 4.

In these versions ``sensors`` and ``targets`` at the top were the certified poses; ``refined`` had the refined poses.
Version 1 had no ``refined``, version 2 had no ``log``, and no version had a verdict.

Versions 4 to 6 need no conversion: the fields of certificates that version 4 lacks have defaults, which claim less,
versions 4 and 5 lack what ``calibrate`` found, and all lack what a refinement from corners found.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError, model_validator

from gtsam_rwhec.calibration.outliers import HALF
from gtsam_rwhec.results.json_tree import from_json, in_words
from gtsam_rwhec.results.log_history import OutlierCount, contradictions
from gtsam_rwhec.solver.certificate import Cause, SearchPath
from gtsam_rwhec.solver.free_directions import FreeDirection, FreeKind

FIRST_VERSION = 1
FIRST_WITH_VERDICT = 4
#: From this version on a certificate says what its bound is about.
FIRST_WITH_REGION = 5
#: From this version on a file has what ``calibrate`` found, also where there is no answer.
FIRST_WITH_CALIBRATION = 6

_RESIDUAL = ("translation_rms_m", "rotation_rms_rad")


class _Fields(BaseModel):
    """The fields that the conversion reads, under their old names. The rest is checked as fields of version 4."""

    model_config = ConfigDict(extra="allow", strict=True)


class _Certificate(_Fields):
    reason: str
    objective: str
    path: str


class _Part(_Fields):
    certificate: _Certificate


class _Scale(_Fields):
    mode: Any
    value: Any
    by_frame: Any


class _Determined(_Fields):
    free_directions: list[str]


class _Pair(_Determined):
    target: str
    sensor: str
    number_of_measurements: Any
    translation_rms_m: Any
    rotation_rms_rad: Any


class _Frame(_Fields):
    name: str
    moved_mm: Any
    moved_deg: Any


class _Noise(_Fields):
    target: str
    sensor: str
    redundancy: Any
    noise_rad: Any
    noise_m: Any
    inliers: Any


class _Unknown(_Fields):
    name: str
    rows: int


def _lower_triangle(rows: list[list[float]]) -> list[list[float]]:
    for i, row in enumerate(rows):
        if len(row) != i + 1:
            raise ValueError(f"row {i} must have {i + 1} numbers, a lower triangle (found {len(row)})")
    return rows


class _Joint(_Fields):
    unknowns: list[_Unknown]
    finite: Annotated[list[list[float]], AfterValidator(_lower_triangle)]
    free: list[list[float]]
    units: Any

    @model_validator(mode="after")
    def _directions_fit(self) -> _Joint:
        for k, direction in enumerate(self.free):
            if len(direction) != len(self.finite):
                raise ValueError(f"free[{k}] must have {len(self.finite)} numbers (found {len(direction)})")
        return self


class _Refined(_Determined):
    targets: Any
    sensors: Any
    scale: _Scale
    frames: list[_Frame]
    pairs: list[_Noise]
    joint: _Joint


class _Outliers(_Fields):
    target: str
    sensor: str
    used: int
    removed: dict[str, int]


class _Log(_Fields):
    outliers: list[_Outliers]
    contradicted: list[str] = []


class _Earlier(_Fields):
    """A file of versions 1 to 3."""

    written_by: Any
    conventions: Any
    targets: Any
    sensors: Any
    scale: _Scale
    certificate: _Certificate
    identifiability: _Determined
    pairs: list[_Pair]
    parts: list[_Part]
    refined: _Refined | None = None
    log: _Log | None = None


def as_version_4(raw: dict[str, Any]) -> dict[str, Any]:
    """Move a file's fields to their places in version 4.

    Raises `ValueError` if a field that it reads is missing, or is of another type than its version says.
    """
    from_json(raw)  # it refuses what is beyond the budget
    try:
        _Earlier.model_validate_json(json.dumps(raw))
    except ValidationError as error:
        raise ValueError(in_words(error, moved=()).removesuffix(".")) from error
    heading = ("format", "format_version", "written_by", "conventions", "refined", "log")
    certified = {name: value for name, value in raw.items() if name not in heading}
    rows = certified.pop("pairs")
    certified["certificate"] = _certificate(certified["certificate"])
    certified["parts"] = [{**part, "certificate": _certificate(part["certificate"])} for part in certified["parts"]]
    identifiability = _without(_with_directions(certified["identifiability"]), "explanation")
    certified["residuals"] = [_only(row, "target", "sensor", "number_of_measurements", *_RESIDUAL) for row in rows]
    pairs = [_with_directions(_without(row, *_RESIDUAL)) for row in rows]
    certified["identifiability"] = {**identifiability, "pairs": pairs}
    result = {
        **{name: raw[name] for name in ("format", "written_by", "conventions")},
        "format_version": 4,
        "verdict": "care",
        "verdict_reason": "an earlier version wrote this file, without a verdict",
        "verdict_grounds": [],
        "certified": _with_scale(certified),
    }
    if raw.get("log") is not None:
        result["log"] = _log(raw["log"])
    if raw.get("refined") is None:
        return {**result, **_only(certified, "targets", "sensors", "scale", "scale_mode")}
    refined = _with_scale(_with_directions(raw["refined"]))
    frames, pairs = refined["frames"], refined.pop("pairs")
    refined["moved"] = {f["name"]: {"translation_mm": f["moved_mm"], "rotation_deg": f["moved_deg"]} for f in frames}
    refined["frames"] = {frame["name"]: _without(frame, "name", "moved_mm", "moved_deg") for frame in frames}
    refined["noise"] = [
        {
            **_only(pair, "target", "sensor"),
            "degrees_of_freedom": pair["redundancy"],
            "rotation_rad": pair["noise_rad"],
            "translation_m": pair["noise_m"],
        }
        for pair in pairs
    ]
    refined["inlier_counts"] = [
        {**_only(pair, "target", "sensor"), "value": pair["inliers"]} for pair in pairs if pair["inliers"] is not None
    ]
    refined["joint"] = _joint(refined["joint"])
    posed = {name: refined.pop(name) for name in ("targets", "sensors", "scale", "scale_mode")}
    return {**result, **posed, "refined": refined}


def _log(log: dict[str, Any]) -> dict[str, Any]:
    """Convert a log: its outliers were counted by reason, and contradicted frames were names only."""
    outliers = [
        OutlierCount(**_only(row, "target", "sensor", "used"), left_out=sum(row["removed"].values()))
        for row in log["outliers"]
    ]
    contradicted = contradictions(outliers, HALF)
    named = log.get("contradicted")  # the first files of version 3 name none
    if named is not None and set(named) != {counts.frame for counts in contradicted}:
        frames = ", ".join(counts.frame for counts in contradicted) or "none"
        raise ValueError(
            f"$.log.contradicted: must be {frames}, by $.log.outliers (found {', '.join(named) or 'none'})"
        )
    records = {"outliers": outliers, "contradicted": contradicted}
    return {**log, **{name: [record.model_dump() for record in made] for name, made in records.items()}}


def _certificate(fields: dict[str, Any]) -> dict[str, Any]:
    """Convert a certificate: its cause, objective and path were sentences."""
    objective = fields["objective"]
    return {
        **_without(fields, "reason"),
        "cause": Cause.NOT_RECORDED,
        "words": fields["reason"],
        "objective": {
            "form": "inverse" if objective.startswith("the equation turned round") else "direct",
            "has_priors": objective.endswith(", and the priors"),
        },
        "path": asdict(SearchPath.parse(fields["path"])),
    }


def _with_directions(fields: dict[str, Any]) -> dict[str, Any]:
    """Convert free directions: they were sentences."""
    directions = [asdict(FreeDirection(FreeKind.WORDS, None, words=words)) for words in fields["free_directions"]]
    return {**fields, "free_directions": directions}


def _joint(joint: dict[str, Any]) -> dict[str, Any]:
    """Convert the joint covariance: only its lower triangle was written, and free directions were rows."""
    slots, first = {}, 0
    for unknown in joint["unknowns"]:
        slots[unknown["name"]] = [first, first := first + unknown["rows"]]
    lower = joint["finite"]
    full = [[lower[max(i, j)][min(i, j)] for j in range(len(lower))] for i in range(len(lower))]
    free = [[direction[i] for direction in joint["free"]] for i in range(len(lower))]
    return {"slots": slots, "finite": full, "free": free, "unit": joint["units"]}


def _with_scale(answer: dict[str, Any]) -> dict[str, Any]:
    scale = answer["scale"]
    answer["scale"] = scale["value"] if scale["by_frame"] is None else scale["by_frame"]
    answer["scale_mode"] = scale["mode"]
    return answer


def _only(fields: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: fields[name] for name in names}


def _without(fields: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: value for name, value in fields.items() if name not in names}
