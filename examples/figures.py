"""What the examples' pictures share: colours that everyone can tell apart, and where the files go."""

from __future__ import annotations

import argparse
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

# Okabe and Ito's palette, which people with any form of colour blindness tell apart.
BLUE, VERMILLION, GREEN, ORANGE = "#0072B2", "#D55E00", "#009E73", "#E69F00"
SKY, PURPLE, YELLOW, GREY = "#56B4E9", "#CC79A7", "#F0E442", "#999999"

OUTPUT = Path(__file__).resolve().parent / "output"


def arguments_of(description: str | None) -> argparse.ArgumentParser:
    """A parser that every example starts from: ``--save FOLDER``."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--save", type=Path, default=OUTPUT, metavar="FOLDER", help="for the picture (%(default)s)")
    return parser


def plain(axes: Axes) -> None:
    """Leave out what carries no information."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_axisbelow(True)


def save(figure: Figure, folder: Path, name: str) -> None:
    """Write the picture and say where it is."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    figure.savefig(path, dpi=110)
    print(f"Written to {path}.")
