"""What the papers' scripts share: arguments, the papers' numbers, markdown tables, pictures."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

HERE = Path(__file__).resolve().parent
OUTPUT = HERE.parent / "output" / "papers"
sys.path.insert(1, str(HERE.parent))  # figures.py, which all examples share

from figures import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, YELLOW, plain  # noqa: E402

__all__ = [
    "BLUE",
    "GREEN",
    "GREY",
    "ORANGE",
    "PURPLE",
    "SKY",
    "VERMILLION",
    "YELLOW",
    "arguments_of",
    "markdown",
    "numbers_of",
    "plain",
    "plain_numbers",
    "quantity",
    "save_picture",
    "save_text",
]


def arguments_of(description: str | None, runs: int, of_what: str) -> argparse.ArgumentParser:
    """A parser that every script starts from."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=_at_least_two, default=runs, help=f"{of_what} (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of everything random (%(default)s)")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes (all cores: %(default)s)")
    parser.add_argument("--output", type=Path, default=OUTPUT, metavar="FOLDER", help="(%(default)s)")
    return parser


def _at_least_two(text: str) -> int:
    runs = int(text)
    if runs < 2:
        raise argparse.ArgumentTypeError(f"{runs} is too few; a spread needs at least 2")
    return runs


def numbers_of(name: str) -> Any:
    """A paper's numbers, ``data/<name>.yaml``."""
    return yaml.safe_load((HERE / "data" / f"{name}.yaml").read_text(encoding="utf-8"))


def markdown(headers: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """A markdown table whose first ``left`` columns are words, the others numbers."""
    widths = [max(len(row[k]) for row in (headers, *rows)) for k in range(len(headers))]
    align = [str.ljust if k < left else str.rjust for k in range(len(headers))]
    lines = ["| " + " | ".join(align[k](row[k], widths[k]) for k in range(len(row))) + " |" for row in (headers, *rows)]
    rule = [("-" * (width + 2)) if k < left else ("-" * (width + 1) + ":") for k, width in enumerate(widths)]
    lines.insert(1, "|" + "|".join(rule) + "|")
    return "\n".join(lines) + "\n"


def quantity(value: float | None, digits: int = 3) -> str:
    """A number to so many digits; an absent one as a dash."""
    if value is None or math.isnan(value):
        return "-"
    if value == 0.0:
        return "0"
    if not 1e-3 <= abs(value) < 1e5:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(0, digits - 1 - math.floor(math.log10(abs(value))))}f}"


def save_text(text: str, folder: Path, name: str) -> None:
    """Print and write a report."""
    print(text)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text, encoding="utf-8")
    print(f"Written to {folder / name}.")


def save_picture(figure: Figure, folder: Path, name: str) -> None:
    """Write the picture and say where it is."""
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / name, dpi=110)
    print(f"Written to {folder / name}.")


def plain_numbers(axis: Axis) -> None:
    """A logarithmic axis with 1, 2 and 5 written as such."""
    axis.set_major_locator(LogLocator(10.0, (1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
