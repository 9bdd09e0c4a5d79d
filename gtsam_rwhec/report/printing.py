"""How reports are printed: the console, the verdict, headings, tables and sentences."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console
from rich.text import Text

from gtsam_rwhec.calibration.verdict import Judgement, Verdict
from gtsam_rwhec.files.terminal import SafeConsole
from gtsam_rwhec.files.terminal_text import LONGEST_LINE, printable, shown
from gtsam_rwhec.report.pose_table import FrameTable
from gtsam_rwhec.solver.solution import Solution

#: Tables in a file have this many columns. Sentences in a file are not wrapped.
PLAIN_WIDTH = 160
#: What to do where no noise was stated.
NO_NOISE = "Look at the residuals, in mm and degrees, before you trust the poses: no noise was stated."
#: Each verdict has its colour.
STYLES = {Verdict.USE: "bold green", Verdict.CARE: "bold yellow", Verdict.DO_NOT_USE: "bold red"}


def report_console() -> Console:
    """A console on standard output; in a file it is plain and as wide as the tables need."""
    console = SafeConsole()
    return console if console.is_terminal else SafeConsole(width=PLAIN_WIDTH, no_color=True)


def print_verdict(console: Console, judgement: Judgement, solution: Solution) -> None:
    """Print whether to use the poses: every report begins with this sentence. Below: whether the noise was stated."""
    print_sentence(console, str(judgement), STYLES[judgement.verdict])
    if solution.is_relative:
        print_sentence(console, NO_NOISE, STYLES[Verdict.CARE])


def print_heading(console: Console, words: str, *, tight: bool = False) -> None:
    """Print the heading of a section; a ``tight`` one has no empty line below it."""
    console.print()
    console.print(Text(printable(words), style="bold"), soft_wrap=not console.is_terminal)
    if not tight:
        console.print()


def print_tables(console: Console, tables: Iterable[FrameTable], legend: str) -> None:
    """Print the tables that have rows, and the meaning of their columns."""
    for table in tables:
        if table.rows:
            console.print(table)
    print_sentence(console, legend, "dim")


def print_list(console: Console, words: Iterable[str], style: str = "") -> None:
    """Print sentences as the items of a list."""
    for sentence in words:
        print_sentence(console, f"  - {sentence}", style)


def print_sentence(console: Console, words: str, style: str = "") -> None:
    """Print a sentence: wrapped on a terminal, in one line in a file, where people search for words."""
    console.print(Text(shown(words, LONGEST_LINE), style=style), soft_wrap=not console.is_terminal)
