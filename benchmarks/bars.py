"""What the benchmarks print: rows of a figure, its bar, and whether it is met.

Whoever imports this module also finds the helpers of the tests, whose simulated rigs and logs the benchmarks share.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path += [str(TESTS), *sorted(str(folder) for folder in TESTS.iterdir() if folder.is_dir())]


@dataclass(frozen=True)
class Row:
    """One line of the table; ``met`` is None for figures that have no bar."""

    what: str
    figure: str
    bar: str = ""
    met: bool | None = None


def benchmark_parser(description: str | None) -> argparse.ArgumentParser:
    """A parser that prints a script's docstring as it stands."""
    return argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)


def print_rows(title: str, rows: list[Row]) -> int:
    """Print the rows as a table; 1 if a bar is missed, else 0: a script's exit status."""
    console = Console()
    if not console.is_terminal:  # in a pipe the width is unknown; nothing of the table may be cut
        console = Console(width=180)
    table = Table(title=title, title_justify="left")
    table.add_column("what", overflow="fold")
    table.add_column("figure", justify="right", overflow="fold")
    table.add_column("bar", justify="right", overflow="fold")
    table.add_column("met", justify="center", no_wrap=True)
    for row in rows:
        verdict = {None: "", True: "[green]yes[/green]", False: "[bold red]NO[/bold red]"}[row.met]
        table.add_row(row.what, row.figure, row.bar, verdict)
    console.print(table)
    return int(any(row.met is False for row in rows))
