"""Figures of a report: drawn by matplotlib when somebody looks, as SVG whose words are text, or as files.

matplotlib is imported by the first figure. No figure can end a run: one that cannot be drawn says why in its place.
"""

from __future__ import annotations

import io
import logging
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

#: The palette of Okabe and Ito: people with any form of colour blindness can tell its colours apart.
BLUE, VERMILLION, GREEN, ORANGE = "#0072B2", "#D55E00", "#009E73", "#E69F00"
SKY, PURPLE, GREY = "#56B4E9", "#CC79A7", "#777777"
#: Of views, in order: no two beside each other are alike in lightness.
VIEW_COLOURS = (BLUE, ORANGE, GREEN, VERMILLION, SKY, "#882255", "#999933", PURPLE, GREY)
#: Blue that is seen on dark as well as on light.
LIGHT_BLUE = "#2C8CC9"
#: The axes x, y, z of frames have these colours.
AXIS_COLOURS = (VERMILLION, GREEN, BLUE)
AXIS_NAMES = ("x", "y", "z")
#: Lines and words of this colour take the colour of the page's text, on light and on dark.
INK = "#010203"
#: Figures have this width, inches, so that their words can still be read on a telephone.
WIDTH_IN = 5.2
STYLE = {
    "axes.axisbelow": True,
    "axes.edgecolor": INK,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.titlesize": 10.5,
    "figure.facecolor": "none",
    "figure.titlesize": 12,
    "font.size": 10.0,
    "grid.color": "#8888884D",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.labelcolor": INK,
    "savefig.dpi": "figure",
    "savefig.facecolor": "none",
    "svg.fonttype": "none",
    "svg.hashsalt": "gtsam-rwhec",
    "text.color": INK,
    # Reasons and names come from logs: a "$" in them does not begin a formula.
    "text.parse_math": False,
    "xtick.color": INK,
    "ytick.color": INK,
}
#: Files are on white, and their pictures have this many pixels an inch.
ON_WHITE = {"figure.facecolor": "white", "axes.facecolor": "white"}
FILE_DPI = 200
#: A title or an axis has room for a name of this many characters.
LONGEST_NAME = 28
#: A logarithmic axis shows at most so many powers of ten, and any other axis so many ticks.
DECADES, MOST_TICKS = 40, 200
#: What drawing may raise on numbers that no axis can show.
CANNOT_DRAW = (ArithmeticError, LookupError, MemoryError, RuntimeError, TypeError, ValueError)


@dataclass(frozen=True)
class SvgFigure:
    """A figure that is drawn when it is asked for: for a page, or as a file."""

    draw: Callable[[Figure], None]
    height_in: float
    width_in: float

    @property
    def in_page(self) -> str:
        """An SVG element of any width, with the page's colour of text; equal figures give equal text."""
        svg = self._drawn("svg", {}).decode("utf-8")
        element = re.sub(r' width="[^"]*"| height="[^"]*"', "", svg[svg.index("<svg") :], count=2)
        return element.replace(INK, "currentColor")

    def file(self, form: Literal["svg", "png"]) -> bytes:
        """The figure as a file: black on white, whatever the page's colours."""
        return self._drawn(form, ON_WHITE)

    def _drawn(self, form: Literal["svg", "png"], style_too: Mapping[str, Any]) -> bytes:
        try:
            return _drawn(self.draw, (self.width_in, self.height_in), form, style_too)
        except CANNOT_DRAW as error:
            why = str(error).splitlines()[0] if str(error) else type(error).__name__

            def say(figure: Figure) -> None:
                figure.text(0.02, 0.5, f"This figure cannot be drawn: {shortened(why, 60)}", va="center", size=9)

            return _drawn(say, (self.width_in, min(self.height_in, 1.0)), form, style_too)


def svg_figure(draw: Callable[[Figure], None], height_in: float = 3.2, width_in: float = WIDTH_IN) -> SvgFigure:
    """A figure of this size, inches."""
    return SvgFigure(draw, height_in, width_in)


def _drawn(
    draw: Callable[[Figure], None],
    size_in: tuple[float, float],
    form: Literal["svg", "png"],
    style_too: Mapping[str, Any],
) -> bytes:
    from matplotlib import style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # of what it draws otherwise no reader needs to hear
    with warnings.catch_warnings(action="ignore"), style.context(["default", STYLE, dict(style_too)]):
        figure = Figure(figsize=size_in, layout="constrained", dpi=72 if form == "svg" else FILE_DPI)
        stream = io.BytesIO()
        # figure.savefig goes over everything twice.
        canvas: Any = FigureCanvasSVG(figure) if form == "svg" else FigureCanvasAgg(figure)
        draw(figure)
        bound_axes(figure)
        if form == "svg":
            canvas.print_svg(stream, metadata={"Date": None, "Creator": None})
        else:
            canvas.print_png(stream, metadata={"Software": None})
    return stream.getvalue()


def bound_axes(figure: Figure) -> None:
    """Show of a logarithmic axis the upper ``DECADES`` only, and at most ``MOST_TICKS`` ticks of any other.

    A single value of 1e-200 makes 1601 ticks, each of which is laid out many times.
    """
    from matplotlib.ticker import MaxNLocator

    for axes in figure.axes:
        for axis, limit in ((axes.xaxis, axes.set_xlim), (axes.yaxis, axes.set_ylim)):
            low, high = sorted(map(float, axis.get_view_interval()))
            if not (np.isfinite([low, high]).all()):
                continue
            if axis.get_scale() == "log":
                if high > 0.0 and low < high * 10.0**-DECADES:
                    ends = (high * 10.0**-DECADES, high)
                    limit(*(ends if axis.get_view_interval()[0] <= axis.get_view_interval()[1] else ends[::-1]))
            elif len(axis.get_majorticklocs()) > MOST_TICKS:
                axis.set_major_locator(MaxNLocator(5))


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
    low = max(low, 1e-6 * high)  # an error may be zero
    few = high < 30.0 * low
    powers = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
    for steps, minor in (((1.0, 2.0, 5.0) if few else (1.0,), False), (() if few else (2.0, 5.0), True)):
        ticks = [step * power for power in powers for step in steps if low <= step * power <= high]
        axis.set_ticks(ticks, ["" if minor else f"{tick:g}" for tick in ticks], minor=minor)


def image_axes(axes: Axes, size: tuple[float, float]) -> None:
    """Make axes those of an image of a (width, height): its pixels from the upper left, with a frame around it."""
    width, height = size
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.set_aspect("equal")
    axes.spines[:].set_visible(True)
    axes.grid(visible=False)


def round_down(number: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not above a positive number; 1 for zero."""
    if number <= 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(number))
    return float(max(step * power for step in (0.5, 1.0, 2.0, 5.0) if step * power <= number * (1.0 + 1e-12)))
