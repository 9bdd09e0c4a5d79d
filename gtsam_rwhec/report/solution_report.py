"""The whole report of a calibration, for a terminal or for a file."""

from __future__ import annotations

from rich.console import Console
from rich.text import Text

from gtsam_rwhec.report.pair_grid import PairGrid
from gtsam_rwhec.report.pose_table import POSE_LEGEND, sensor_table, target_table
from gtsam_rwhec.report.sentences import (
    certificate_sentence,
    identifiability_sentences,
    part_sentences,
    scale_sentence,
    summary_sentence,
    time_sentence,
    weights_sentence,
)
from gtsam_rwhec.solving.solution import Solution

#: Sentences in files are not cut into lines, but tables need some width to be laid out in.
PLAIN_WIDTH = 160


def report_console() -> Console:
    """A console on standard output; where that is no terminal, plain and as wide as the tables need."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=PLAIN_WIDTH, no_color=True)


def print_solution(solution: Solution, console: Console | None = None) -> None:
    """Print the tables, the grid of Figure 8 and the sentences about them.

    Parameters
    ----------
    solution
        What `gtsam_rwhec.solve` returned.
    console
        Where to; None for standard output.
    """
    console = report_console() if console is None else console
    style = "bold green" if solution.certificate.is_certified and solution.identifiability.is_unique else "bold red"
    console.print(Text(f"Calibration of {summary_sentence(solution)}", style="bold"))
    console.print()
    for table in (sensor_table(solution), target_table(solution)):
        if table.rows:
            console.print(table)
    _print_sentence(console, Text(POSE_LEGEND, style="dim"))
    console.print()
    console.print(PairGrid(solution.identifiability))
    console.print()
    _print_sentence(console, Text(certificate_sentence(solution.certificate), style=style))
    for sentence in identifiability_sentences(solution):
        _print_sentence(console, Text(sentence, style="bold red"))
    for sentence in part_sentences(solution):
        _print_sentence(console, Text(sentence))
    for sentence in (
        scale_sentence(solution),
        weights_sentence(solution),
        f"Objective: {solution.certificate.objective}",
        time_sentence(solution.certificate),
    ):
        _print_sentence(console, Text(sentence))


def _print_sentence(console: Console, text: Text) -> None:
    """Wrapped to a terminal's width, but one line each in a file, where people search for words."""
    console.print(text, soft_wrap=not console.is_terminal)
