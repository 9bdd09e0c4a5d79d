"""Colours, style, text and files that all pictures share."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.files.whole_files import write_atomically
from gtsam_rwhec.report.report_blocks import Chart, Drawing, Page, every

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.figure import Figure as MatplotlibFigure


def image_axes(axes: Axes, size: tuple[float, float]) -> None:
    """Make axes those of an image of a (width, height): its pixels from the upper left, with a frame around it."""
    width, height = size
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.set_aspect("equal")
    axes.spines[:].set_visible(True)
    axes.grid(visible=False)


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


def write_figures(page: Page, folder: str | Path) -> list[Path]:
    """Write every chart of a page, and the still pictures of its scenes, as SVG and PNG, black on white.

    Returns
    -------
    list of Path
        The files, in the order of the page.

    Raises
    ------
    FileFormatError
        The folder cannot be made, or a file cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileFormatError(f"{folder} cannot be made a folder: {error.strerror}.") from error
    written = []
    for name, figure in figures_of(page):
        for path, content in ((f"{name}.svg", figure.svg_file()), (f"{name}.png", figure.png_file())):
            write_atomically(folder / path, content)
            written.append(folder / path)
    return written


def figures_of(page: Page) -> list[tuple[str, SvgFigure]]:
    """The drawn figures of a page by name, those that are folded too."""
    found: list[tuple[str, str]] = []
    for block in every(block for section in page.sections for block in section.blocks):
        if isinstance(block, Chart):
            found.append((block.name, block.svg))
        elif isinstance(block, Drawing):
            found.append((block.name, block.still_svg))
    return [(name, svg) for name, svg in found if isinstance(svg, SvgFigure)]
