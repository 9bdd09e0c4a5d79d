"""Result files of versions 1 to 3, converted to version 4.

In these versions ``sensors`` and ``targets`` at the top were the certified poses; ``refined`` had the refined poses.
Version 1 had no ``refined``, version 2 had no ``log``, and no version had a verdict.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from gtsam_rwhec.identifiability.free_directions import FreeDirection, FreeKind
from gtsam_rwhec.results.log_history import OutlierCount, contradictions
from gtsam_rwhec.solver.cause import Cause, SearchPath

FIRST_VERSION = 1

_RESIDUAL = ("translation_rms_m", "rotation_rms_rad")


def as_version_4(raw: dict[str, Any]) -> dict[str, Any]:
    """Move a file's fields to their places in version 4.

    Raises `ValueError`, `KeyError`, `TypeError` or `AttributeError` if a field is missing, or is of another type than
    its version says.
    """
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
    records = {"outliers": outliers, "contradicted": contradictions(outliers)}
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
