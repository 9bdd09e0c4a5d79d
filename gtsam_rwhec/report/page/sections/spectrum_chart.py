"""The spectrum of Z as a chart: a logarithmic axis above rounding, and zeros as zeros."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.page.figures import INK, SvgFigure, svg_figure
from gtsam_rwhec.report.plots.drawing import BLUE, GREY, ORANGE, VERMILLION

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def spectrum_svg(values: Array, rounding: float) -> SvgFigure:
    """The eigenvalues in order; those that are zero up to rounding, and negative ones, look different."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        place = np.arange(1, len(values) + 1)
        size = np.maximum(np.abs(values), 1e-30)
        level = max(rounding, 1e-30)
        kinds = (
            (values > rounding, "o", BLUE, "positive"),
            (np.abs(values) <= rounding, "D", ORANGE, "zero up to rounding"),
            (values < -rounding, "v", VERMILLION, "negative (its size)"),
        )
        low = 0.03 * level
        for which, marker, colour, words in kinds:
            if which.any():
                shown = np.maximum(size[which], 2.0 * low)
                axes.plot(place[which], shown, marker, color=colour, ms=4.5, ls="none", label=f"{words}: {which.sum()}")
        axes.axhspan(low, level, color=GREY, alpha=0.25, lw=0)
        axes.annotate(
            "rounding", (1.0, level), xycoords=("axes fraction", "data"), xytext=(-3, -3), textcoords="offset points",
            ha="right", va="top", color=INK, fontsize=9,
        )  # fmt: skip
        axes.set(yscale="log", xlabel="number, in order", ylabel="eigenvalue")
        axes.set_ylim(low, 5.0 * max(float(size.max()), level))
        # The style takes "$" as it is, so powers of ten are written out.
        axes.yaxis.set_major_formatter(lambda value, _: f"1e{round(float(np.log10(value)))}")
        axes.yaxis.set_minor_formatter(lambda value, _: "")
        axes.legend(loc="center right", fontsize=9)

    return svg_figure(draw, 3.0)
