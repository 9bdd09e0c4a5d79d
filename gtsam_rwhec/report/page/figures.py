"""Figures of a page: drawn by matplotlib as SVG whose words are text and take the page's colour."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from typing import TYPE_CHECKING

from gtsam_rwhec.report.plots.drawing import STYLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

#: Lines and words of this colour take the colour of the page's text, on light and on dark.
INK = "#010203"
#: Figures have this width, inches, so that their words can still be read on a telephone.
WIDTH_IN = 5.2
PAGE_STYLE = {
    **STYLE,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "font.size": 10.0,
    "grid.color": "#8888884D",
    "legend.labelcolor": INK,
    "svg.fonttype": "none",
    "svg.hashsalt": "gtsam-rwhec",
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
}


def svg_figure(draw: Callable[[MatplotlibFigure], None], height_in: float = 3.2, width_in: float = WIDTH_IN) -> str:
    """Draw a figure and give it as an SVG element, fit to stand in a page; equal figures give equal text."""
    from matplotlib import style
    from matplotlib.figure import Figure

    with style.context(["default", PAGE_STYLE]):
        figure = Figure(figsize=(width_in, height_in), layout="constrained")
        draw(figure)
        stream = io.StringIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    return in_page(stream.getvalue())


def in_page(svg: str) -> str:
    """The element alone, of any width, with the page's colour of text."""
    element = svg[svg.index("<svg") :]
    element = re.sub(r' width="[^"]*"| height="[^"]*"', "", element, count=2)
    return element.replace(INK, "currentColor")
