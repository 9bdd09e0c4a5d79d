"""The result that a page shows: its JSON, the records that were read from it, and the evidence."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.report.report_blocks import Number
from gtsam_rwhec.results import Evidence
from gtsam_rwhec.results.earlier_versions import FIRST_WITH_CALIBRATION, as_version_4
from gtsam_rwhec.results.evidence import evidence_json
from gtsam_rwhec.results.json_tree import parse_json
from gtsam_rwhec.results.result_file import Result, parse_result
from gtsam_rwhec.results.schema import FORMAT, FORMAT_VERSION


@dataclass(frozen=True, eq=False)
class ShownResult:
    """A result as its page shows it.

    Attributes
    ----------
    tree : dict
        The result's JSON; of files of versions 1 to 3, as version 4 has it.
    result : Result or None
        The same as records; None where the calibration has no answer.
    evidence : Evidence or None
    name : str
        Of the result's file.
    images : bool
        Whether the page may show what cameras saw; images may be confidential.
    warnings : tuple of str
        What could not be shown although it is there.
    """

    tree: Mapping[str, Any]
    result: Result | None
    evidence: Evidence | None
    name: str
    images: bool = True
    warnings: tuple[str, ...] = ()

    @staticmethod
    def of(content: bytes, evidence: Evidence | None, name: str = "result.json", *, images: bool = True) -> ShownResult:
        """Of a result file's content.

        Raises
        ------
        FileFormatError, ResultVersionError
            As `read_result` does; a result without an answer is shown all the same.
        """
        try:
            tree = parse_json(content)
        except ValueError:
            tree = None  # what is wrong with it is said below
        if _has_no_answer(tree):
            return ShownResult(tree, None, evidence, name, images)
        result = parse_result(content, name)
        if "verdict" not in tree:  # of versions 1 to 3, whose fields have other places
            tree = as_version_4(tree)
        return ShownResult(tree, result, evidence, name, images)

    @cached_property
    def evidence_tree(self) -> Any:
        """The evidence's JSON; an empty object without evidence."""
        return {} if self.evidence is None else json.loads(evidence_json(self.evidence))

    def why_missing(self, part: object, otherwise: str) -> str:
        """Why a ``part`` of the evidence is not there; empty where it is."""
        if self.evidence is None:
            return "the result has no evidence.json beside it."
        return otherwise if part is None else ""

    def number(self, *path: str | int, times: float = 1.0, spec: str = ".4g", unit: str = "") -> Number:
        """The number at a place of the result's JSON."""
        return _number(self.tree, "result.json", path, times, spec, unit)

    def evident(self, *path: str | int, times: float = 1.0, spec: str = ".4g", unit: str = "") -> Number:
        """The number at a place of the evidence's JSON."""
        return _number(self.evidence_tree, "evidence.json", path, times, spec, unit)


def _has_no_answer(tree: Any) -> bool:
    """Whether this is the result of a calibration without an answer, which has a verdict and no poses."""
    return (
        isinstance(tree, dict)
        and tree.get("format") == FORMAT
        and tree.get("format_version") in range(FIRST_WITH_CALIBRATION, FORMAT_VERSION + 1)
        and "certified" not in tree
        and tree.get("verdict") == Verdict.DO_NOT_USE
        and isinstance(tree.get("verdict_reason"), str)
    )


def _number(tree: Any, file: str, path: tuple[str | int, ...], times: float, spec: str, unit: str) -> Number:
    value = tree
    for step in path:
        value = value[step]
    pointer = "".join(f"/{str(step).replace('~', '~0').replace('/', '~1')}" for step in path)
    return Number(f"{file}#{pointer}", value, times, spec, unit)
