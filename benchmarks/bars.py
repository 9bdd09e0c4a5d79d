"""What the benchmarks print: rows of a figure, its bar, whether it is met, and the last figure that was stored."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from importlib.metadata import version

from figures import Figure, compared, machine_class, stored, write
from rich.console import Console
from rich.table import Table


@dataclass(frozen=True)
class Row:
    """One line of the table; ``met`` is None for figures that have no bar."""

    what: str
    figure: str
    bar: str = ""
    met: bool | None = None


def benchmark_parser(description: str | None) -> argparse.ArgumentParser:
    """A parser with what all benchmarks take."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", action="store_true", help="write the figures to benchmarks/figures.json")
    return parser


def print_rows(title: str, rows: list[Row], *, store: bool = False) -> int:
    """Print the rows as a table beside the last stored figures; 1 if a bar is missed, else 0: a script's exit status.

    With `store` they become the last ones.
    """
    console = Console()
    if not console.is_terminal:  # in a pipe the width is unknown; nothing of the table may be cut
        console = Console(width=180)
    table = Table(title=title, title_justify="left")
    table.add_column("what", overflow="fold")
    table.add_column("figure", justify="right", overflow="fold")
    table.add_column("bar", justify="right", overflow="fold")
    table.add_column("met", justify="center", no_wrap=True)
    table.add_column("against the last", overflow="fold")
    last, found = stored(), {}
    above = ""
    for row in rows:
        # A row that is set in belongs to the one above it.
        above = above if row.what.startswith(" ") else row.what
        name = f"{title} | {above}" + (f" | {row.what.strip()}" if row.what.startswith(" ") else "")
        now = Figure(row.figure, row.bar, row.met, version("gtsam-rwhec"), machine_class())
        found[name] = now
        verdict = {None: "", True: "[green]yes[/green]", False: "[bold red]NO[/bold red]"}[row.met]
        table.add_row(row.what, row.figure, row.bar, verdict, compared(now, last.get(name)))
    console.print(table)
    if store:
        console.print(f"Stored in {write(found)}.")
    return int(any(row.met is False for row in rows))
