"""The result that a report shows: its JSON, the records that were read from it, and the evidence."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from operator import getitem
from typing import Any

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.calibration.verdict import Finding, Judgement
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.report.report_blocks import Number
from gtsam_rwhec.results import Evidence
from gtsam_rwhec.results.derived import derived_of
from gtsam_rwhec.results.evidence import evidence_json
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.results.result_file import Result, has_no_answer, parse_tree, result_json, result_of
from gtsam_rwhec.results.result_judgement import judge
from gtsam_rwhec.solver.solution import Solution


@dataclass(frozen=True, eq=False)
class ShownResult:
    """A result as its report shows it."""

    tree: Mapping[str, Any]  #: The result's JSON
    result: Result | None  #: The same as records; None where the calibration has no answer
    evidence: Evidence | None
    name: str  #: Of the result's file
    images: bool = True  #: Whether the page may show what cameras saw; images may be confidential
    warnings: tuple[str, ...] = ()  #: What could not be shown although it is there
    #: What is known against a solution that was not calibrated, beside what the file holds
    findings: tuple[Finding, ...] = ()
    in_memory: bool = False  #: Whether it was just computed: then it has no files, and no page that shows it

    @staticmethod
    def of(content: bytes, evidence: Evidence | None, name: str = "result.json", *, images: bool = True) -> ShownResult:
        """From a result file's content; raises as `read_result`. A result without an answer is shown too."""
        tree = parse_tree(content, name)
        return ShownResult(tree, None if has_no_answer(tree) else result_of(tree, name), evidence, name, images)

    @staticmethod
    def of_answer(
        answer: Calibration | Refined | Solution, log: LogFields | None = None, findings: Sequence[Finding] = ()
    ) -> ShownResult:
        """From an answer that was just computed."""
        evidence = Evidence(derived=derived_of(answer)) if isinstance(answer, Calibration) else None
        shown = replace(ShownResult.of(result_json(answer, log), evidence), in_memory=True)
        if not findings or not isinstance(answer, Solution):
            return shown
        judgement = judge(answer, findings=findings)
        more = {"verdict": judgement.verdict.value, "verdict_reason": judgement.reason}
        return replace(shown, tree={**shown.tree, **more}, findings=tuple(findings))

    @property
    def judgement(self) -> Judgement:
        """The verdict, with its grounds."""
        assert self.result is not None
        return judge(self.result.solution, findings=self.findings) if self.findings else self.result.judgement

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

    def numbers(self, *path: str | int, times: float = 1.0, spec: str = ".4g") -> tuple[Number, ...]:
        """The numbers of a list in the result's JSON."""
        return _numbers(self.tree, "result.json", path, times, spec)

    def evidents(self, *path: str | int, times: float = 1.0, spec: str = ".4g") -> tuple[Number, ...]:
        """The numbers of a list in the evidence's JSON."""
        return _numbers(self.evidence_tree, "evidence.json", path, times, spec)


def _numbers(tree: Any, file: str, path: tuple[str | int, ...], times: float, spec: str) -> tuple[Number, ...]:
    values = reduce(getitem, path, tree)
    return tuple(_number(tree, file, (*path, k), times, spec, "") for k in range(len(values)))


def _number(tree: Any, file: str, path: tuple[str | int, ...], times: float, spec: str, unit: str) -> Number:
    value = reduce(getitem, path, tree)
    pointer = "".join(f"/{str(step).replace('~', '~0').replace('/', '~1')}" for step in path)
    return Number(f"{file}#{pointer}", value, times, spec, unit)
