"""Colours, style, text and files that all pictures share."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from gtsam_rwhec.files.whole_files import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

#: The palette of Okabe and Ito: people with any form of colour blindness can tell its colours apart.
BLUE, VERMILLION, GREEN, ORANGE = "#0072B2", "#D55E00", "#009E73", "#E69F00"
SKY, PURPLE, BLACK, GREY, PALE = "#56B4E9", "#CC79A7", "#000000", "#777777", "#DDDDDD"
#: The axes x, y, z of frames have these colours.
AXIS_COLOURS = (VERMILLION, GREEN, BLUE)
AXIS_NAMES = ("x", "y", "z")

DPI = 120
STYLE = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10.5,
    "figure.dpi": DPI,
    "figure.titlesize": 12,
    "font.size": 9.5,
    "grid.color": PALE,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "savefig.dpi": "figure",
    # Reasons and names come from logs: a "$" in them does not begin a formula.
    "text.parse_math": False,
}
#: A legend has room for a reason of this many characters.
LONGEST_REASON = 60
#: A title or an axis has room for a name of this many characters.
LONGEST_NAME = 28


@contextmanager
def picture(
    path: str | Path, width_in: float, height_in: float, layout: Literal["constrained", "compressed"] = "constrained"
) -> Iterator[Figure]:
    """Yield a figure, and write it as a PNG when the block ends without an error; equal figures give equal bytes.

    The layout "compressed" is for panels with a fixed ratio of their sides.
    Raises `FileFormatError` if the file cannot be written.
    """
    from matplotlib import style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with style.context(["default", STYLE]):
        figure = Figure(figsize=(width_in, height_in), layout=layout)
        canvas = FigureCanvasAgg(figure)
        yield figure
        content = io.BytesIO()
        # figure.savefig goes over everything twice.
        canvas.print_png(content, metadata={"Software": None})  # type: ignore[no-untyped-call]
    write_atomically(path, content.getvalue())


def say(axes: Axes, words: str) -> None:
    """Write words in the middle of empty axes."""
    axes.text(0.5, 0.5, words, transform=axes.transAxes, ha="center", va="center", color=GREY)
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def shortened(text: str, most: int = LONGEST_NAME) -> str:
    """The text as one line of at most `most` characters that the font has; a long text is cut in the middle."""
    line = "".join(c if c.isprintable() else " " for c in text.encode("latin-1", "replace").decode("latin-1"))
    line = " ".join(line.split())
    if len(line) <= most:
        return line
    begin = (most - 3) // 2
    return f"{line[:begin]}...{line[len(line) - (most - 3 - begin) :]}"


def plain_decades(axis: Axis, low: float, high: float) -> None:
    """Label a logarithmic axis with plain numbers; for a ratio below 30 also between the powers of ten."""
    few = high < 30.0 * low
    powers = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
    for steps, minor in (((1.0, 2.0, 5.0) if few else (1.0,), False), (() if few else (2.0, 5.0), True)):
        ticks = [step * power for power in powers for step in steps if low <= step * power <= high]
        axis.set_ticks(ticks, ["" if minor else f"{tick:g}" for tick in ticks], minor=minor)


def round_down(number: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not above a positive number."""
    power = 10.0 ** np.floor(np.log10(number))
    return float(max(step * power for step in (0.5, 1.0, 2.0, 5.0) if step * power <= number * (1.0 + 1e-12)))
