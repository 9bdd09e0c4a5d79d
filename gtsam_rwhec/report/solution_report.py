"""The whole report of a calibration, for a terminal or for a file."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console
from rich.text import Text

from gtsam_rwhec.files.terminal_text import printable
from gtsam_rwhec.report.pair_grid import PairGrid
from gtsam_rwhec.report.pose_table import POSE_LEGEND, FrameTable, sensor_table, target_table
from gtsam_rwhec.report.sentences import (
    certificate_sentence,
    identifiability_sentences,
    part_sentences,
    scale_sentence,
    summary_sentence,
    time_sentence,
    weights_sentence,
)
from gtsam_rwhec.results.verdict import Judgement, Verdict, judge
from gtsam_rwhec.solving.solution import Solution

#: Sentences in files are not cut into lines, but tables need some width to be laid out in.
PLAIN_WIDTH = 160
STYLES = {Verdict.USE: "bold green", Verdict.CARE: "bold yellow", Verdict.DO_NOT_USE: "bold red"}


def report_console() -> Console:
    """A console on standard output; where that is no terminal, plain and as wide as the tables need."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=PLAIN_WIDTH, no_color=True)


def print_solution(solution: Solution, console: Console | None = None) -> None:
    """Print the verdict, the poses, what to do, and the details.

    Parameters
    ----------
    solution
        What `gtsam_rwhec.solve` returned.
    console
        Where to; None for standard output.
    """
    console = report_console() if console is None else console
    print_verdict(console, judge(solution))
    print_tables(console, (sensor_table(solution), target_table(solution)), POSE_LEGEND)
    print_sentence(console, scale_sentence(solution))
    for sentence in identifiability_sentences(solution):
        print_sentence(console, sentence, "bold red")
    print_heading(console, "Details")
    print_solution_details(console, solution)


def print_solution_details(console: Console, solution: Solution) -> None:
    """Print what the certified answer rests on: the grid of Figure 8, the certificate and what it is about."""
    print_sentence(console, f"Calibration of {summary_sentence(solution)}.")
    console.print()
    console.print(PairGrid(solution.identifiability))
    console.print()
    style = STYLES[Verdict.USE if solution.certificate.is_certified else Verdict.DO_NOT_USE]
    print_sentence(console, certificate_sentence(solution.certificate), style)
    for sentence in (
        *part_sentences(solution),
        weights_sentence(solution),
        f"Objective: {solution.certificate.objective}",
        time_sentence(solution.certificate),
    ):
        print_sentence(console, sentence)


def print_verdict(console: Console, judgement: Judgement) -> None:
    """Print whether the poses are to be used, which begins every report."""
    print_sentence(console, str(judgement), STYLES[judgement.verdict])
    console.print()


def print_heading(console: Console, words: str) -> None:
    """Print the heading of a section."""
    console.print()
    console.print(Text(words, style="bold"))
    console.print()


def print_tables(console: Console, tables: Iterable[FrameTable], legend: str) -> None:
    """Print those tables that have rows, and what their columns mean."""
    for table in tables:
        if table.rows:
            console.print(table)
    print_sentence(console, legend, "dim")


def print_sentence(console: Console, words: str, style: str = "") -> None:
    """Wrapped to a terminal's width, but one line each in a file, where people search for words."""
    console.print(Text(printable(words), style=style), soft_wrap=not console.is_terminal)
