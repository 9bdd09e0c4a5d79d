"""The report of a certified solution, for a terminal or a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from gtsam_rwhec.calibration.verdict import Finding, Judgement, Verdict
from gtsam_rwhec.report.advice import Advice, print_advice
from gtsam_rwhec.report.pair_grid import PairGrid
from gtsam_rwhec.report.pose_table import POSE_LEGEND, sensor_table, target_table
from gtsam_rwhec.report.printing import (
    NO_NOISE,
    STYLES,
    print_heading,
    print_sentence,
    print_tables,
    print_verdict,
    report_console,
)
from gtsam_rwhec.report.sentences import (
    certificate_sentence,
    part_sentences,
    scale_sentence,
    time_sentence,
    weights_sentence,
)
from gtsam_rwhec.report.short_report import LINES, PoseTables, ShortReport
from gtsam_rwhec.results.result_judgement import judge
from gtsam_rwhec.solver.solution import Solution

#: How to see everything, in Python.
WHOLE = "print_solution(solution)"


def print_solution(
    solution: Solution,
    console: Console | None = None,
    *,
    findings: Sequence[Finding] = (),
    verbose: bool = True,
    lines: int = LINES,
    page: Path | None = None,
    whole: str = WHOLE,
) -> None:
    """Print the verdict, what to do, the poses, and the details; or a screen of it.

    Parameters
    ----------
    solution : Solution
        The result of `gtsam_rwhec.solve`.
    console : rich.console.Console, optional
        Where to print; standard output by default.
    findings : sequence of Finding, optional
        What else is known against the poses: how A and B were read.
    verbose : bool
        Print everything; otherwise a screen: the verdict, what to do, poses with residuals, and what is proven.
    lines, page, whole
        The screen's lines, the page with everything, if one was written, and how to see everything here.
    """
    console = report_console() if console is None else console
    judgement = judge(solution, findings=findings)
    if not verbose:
        _short(solution, judgement).print(console, lines=lines, page=page, whole=whole)
        return
    print_verdict(console, judgement, solution)
    print_advice(console, solution.identifiability.free_directions, judgement=judgement)
    print_solution_body(console, solution)


def _short(solution: Solution, judgement: Judgement) -> ShortReport:
    advice = [(f"  - {NO_NOISE}", STYLES[Verdict.CARE])] if solution.is_relative else []
    advice += Advice.of(solution.identifiability.free_directions, judgement=judgement).items
    scale = () if solution.scale_mode == "known" else (scale_sentence(solution),)
    sentences = tuple((words, "") for words in (*scale, certificate_sentence(solution.certificate)))
    return ShortReport(judgement, tuple(advice), (), (solved_poses(solution),), sentences)


def solved_poses(solution: Solution) -> PoseTables:
    """Certified poses with their residuals, for a short report."""
    tables = (sensor_table(solution), target_table(solution))
    return PoseTables(tuple(replace(table, tight=True) for table in tables), POSE_LEGEND)


def print_solution_body(console: Console, solution: Solution) -> None:
    """Print the certified poses, and the details."""
    print_heading(console, "Poses")
    print_tables(console, (sensor_table(solution), target_table(solution)), POSE_LEGEND)
    print_sentence(console, scale_sentence(solution))
    print_heading(console, "Details")
    print_solution_details(console, solution)
    if solution.certificate.objective.form == "inverse":
        print_sentence(console, "Refine the answer for the exact model of each target's scale.")


def print_solution_details(
    console: Console, solution: Solution, weights_from: str = "as given", *, noise_is_estimated: bool = False
) -> None:
    """Print the facts behind a certified solution: the grid of Figure 8, the certificate, and its objective."""
    print_sentence(console, f"Calibration of {solution.counts}.")
    console.print()
    console.print(PairGrid(solution.identifiability))
    console.print()
    style = STYLES[Verdict.USE if solution.certificate.is_certified else Verdict.DO_NOT_USE]
    print_sentence(console, certificate_sentence(solution.certificate), style)
    for sentence in (
        *part_sentences(solution),
        weights_sentence(solution, weights_from, noise_is_estimated=noise_is_estimated),
        f"Objective: {solution.certificate.objective}",
        time_sentence(solution.certificate),
    ):
        print_sentence(console, sentence)
