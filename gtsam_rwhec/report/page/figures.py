"""Figures of a page: drawn by matplotlib as SVG whose words are text and take the page's colour."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Literal

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

#: Files are on white, and their pictures have this many pixels an inch.
ON_WHITE = {"figure.facecolor": "white", "axes.facecolor": "white"}
FILE_DPI = 200


class SvgFigure(str):
    """A figure as an SVG element of the page. It knows how it was drawn, so that it can be written as files too."""

    draw: Callable[[MatplotlibFigure], None]
    size_in: tuple[float, float]

    def svg_file(self) -> bytes:
        """The figure as an SVG file: black on white, whatever the page's colours."""
        return _drawn(self.draw, self.size_in, "svg", ON_WHITE)

    def png_file(self) -> bytes:
        """The figure as a PNG file: black on white."""
        return _drawn(self.draw, self.size_in, "png", ON_WHITE)


def svg_figure(
    draw: Callable[[MatplotlibFigure], None], height_in: float = 3.2, width_in: float = WIDTH_IN
) -> SvgFigure:
    """Draw a figure and give it as an SVG element, fit to stand in a page; equal figures give equal text."""
    size_in = (width_in, height_in)
    figure = SvgFigure(in_page(_drawn(draw, size_in, "svg", {}).decode("utf-8")))
    figure.draw, figure.size_in = draw, size_in
    return figure


def _drawn(
    draw: Callable[[MatplotlibFigure], None],
    size_in: tuple[float, float],
    form: Literal["svg", "png"],
    style_too: Mapping[str, Any],
) -> bytes:
    from matplotlib import style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with style.context(["default", PAGE_STYLE, dict(style_too)]):
        figure = Figure(figsize=size_in, layout="constrained", dpi=72 if form == "svg" else FILE_DPI)
        stream = io.BytesIO()
        # figure.savefig goes over everything twice.
        if form == "svg":
            svg = FigureCanvasSVG(figure)
            draw(figure)
            svg.print_svg(stream, metadata={"Date": None, "Creator": None})  # type: ignore[no-untyped-call]
        else:
            agg = FigureCanvasAgg(figure)
            draw(figure)
            agg.print_png(stream, metadata={"Software": None})  # type: ignore[no-untyped-call]
    return stream.getvalue()


def in_page(svg: str) -> str:
    """The element alone, of any width, with the page's colour of text."""
    element = svg[svg.index("<svg") :]
    element = re.sub(r' width="[^"]*"| height="[^"]*"', "", element, count=2)
    return element.replace(INK, "currentColor")
