"""A comparison of methods as JSON: one object, lengths in metres, angles in radians, times in seconds."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.methods.chained import Chained
from gtsam_rwhec.methods.comparison import Compared, Comparison
from gtsam_rwhec.results.schema import CONVENTIONS, SENSOR_CARRIER, TARGET_CARRIER, pose_rows

FORMAT = "gtsam-rwhec comparison"
FORMAT_VERSION = 1


def comparison_fields(comparison: Comparison) -> dict[str, Any]:
    """The file's fields: the lower bound, and each method with its answer or the reason why it has no answer."""
    certificate = comparison.certificate
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "conventions": {name: CONVENTIONS[name] for name in ("pose", "model", "scale", "units")},
        "objective": None if certificate is None else str(certificate.objective),
        "certificate": None if certificate is None else str(certificate),
        "no_certificate": None if comparison.error is None else str(comparison.error),
        "lower_bound": None if certificate is None else _finite(certificate.lower_bound),
        "tolerance": None if certificate is None else certificate.tolerance,
        "methods": [_row(comparison, row) for row in comparison.rows],
        "chained": [_chained_row(row) for row in comparison.chained],
        "pairs_that_no_tree_takes": list(map(str, comparison.undetermined)),
    }


def write_comparison(comparison: Comparison, path: str | Path) -> None:
    """Write the JSON file.

    Raises
    ------
    FileFormatError
        The file cannot be written; the message says why.
    """
    content = json.dumps(comparison_fields(comparison), indent=2, allow_nan=False) + "\n"
    write_atomically(path, content.encode("utf-8"))


def _row(comparison: Comparison, row: Compared) -> dict[str, Any]:
    method, estimate = row.method, row.estimate
    fields: dict[str, Any] = {
        "method": method.name,
        "source": method.source,
        "assumes": method.assumes,
        "properties": dataclasses.asdict(method.properties),
        "reason": None if row.error is None else str(row.error),
    }
    if estimate is None:
        return fields | {"answer": None}
    return fields | {
        "answer": {
            "cost": estimate.cost,
            "gap": comparison.gap(row),
            "is_optimal": comparison.is_optimal(row),
            "translation_rms_m": _finite(row.translation_rms_m),
            "rotation_rms_rad": _finite(row.rotation_rms_rad),
            "seconds": estimate.seconds,
            "starts_from": estimate.starts_from,
            "notes": list(estimate.notes),
            "free_directions": [str(direction) for direction in estimate.free_directions],
            "scale": estimate.scale,
            "targets": pose_rows(TARGET_CARRIER, estimate.X),
            "sensors": pose_rows(SENSOR_CARRIER, estimate.Y),
        }
    }


def _chained_row(row: Chained) -> dict[str, Any]:
    return {
        "method": row.method,
        "tree": list(map(str, row.tree)),
        "failed": {str(pair): why for pair, why in row.failed.items()},
        "unreached": list(row.unreached),
        "cost": None if row.estimate is None else row.estimate.cost,
        "off_mm": _finite(row.off_mm),
        "off_deg": _finite(row.off_deg),
        "targets": pose_rows(TARGET_CARRIER, row.X),
        "sensors": pose_rows(SENSOR_CARRIER, row.Y),
    }


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None
