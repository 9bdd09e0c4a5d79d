"""A picture of what is known of each camera: residuals of corners, uncertainty of projections, held-out errors."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import fdtrc

from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.plots.coverage import ARROW_SHARE, MEAN_CELLS, cells_of
from gtsam_rwhec.report.plots.drawing import BLUE, GREY, picture, round_down, say, shortened
from gtsam_rwhec.report.plots.plotted import PlottedIntrinsics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap

#: Errors of a cell are alike in its images where chance gives such a mean with less than this probability.
LEVEL = 1e-3
#: The share of the colours, from bright to dark, on which black lines and numbers can be read.
READABLE = 0.55
#: Corners are dots of this size, points.
DOT = 1.4
#: Lines of equal deviation are drawn at these steps of each power of ten.
STEPS = (1.0, 2.0, 5.0)
#: Of more lines than these only those at the powers of ten are drawn.
MOST_LINES = 6


def plot_intrinsics(cameras: Mapping[str, PlottedIntrinsics], path: str | Path) -> None:
    """Draw three maps of each camera's image: mean residuals, uncertainty of projections, errors of held-out corners.

    Parameters
    ----------
    cameras : dict of str to PlottedIntrinsics
        By sensor, a row each.
    path
        The PNG file. An existing file is replaced.

    Raises
    ------
    FileFormatError
        The file cannot be written.
    """
    heights = [3.7 * min(of.size[1] / of.size[0], 1.5) + 0.9 for of in cameras.values()]
    with picture(path, 12.5, sum(heights) + 0.4 if heights else 3.0) as figure:
        if not cameras:
            say(figure.subplots(), "no intrinsics were estimated")
            return
        from matplotlib.lines import Line2D

        rows = figure.subplots(len(cameras), 3, squeeze=False, height_ratios=heights)
        for (residuals, uncertainty, held_out), (sensor, of) in zip(rows, cameras.items(), strict=True):
            _draw_residuals(residuals, shortened(sensor), of)
            _draw_uncertainty(uncertainty, of)
            _draw_held_out(held_out, of)
        arrows = (
            (BLUE, "mean error of neighbouring corners, enlarged; alike in the images: the lens model lacks something"),
            (GREY, "the same, by chance"),
        )
        handles = [
            Line2D([], [], marker=">", markersize=5, lw=1.2, color=colour, label=says) for colour, says in arrows
        ]
        figure.legend(handles=handles, loc="outside lower left", ncols=2)


def _colours() -> Colormap:
    """From yellow to grey: the bright part of a map that is read with any form of colour blindness."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    return ListedColormap(colormaps["cividis_r"](np.linspace(0.0, READABLE, 256)))


def _frame(axes: Axes, of: PlottedIntrinsics, title: str) -> None:
    width, height = of.size
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), title=title)
    axes.set_aspect("equal")
    axes.spines[:].set_visible(True)
    axes.grid(visible=False)
    axes.tick_params(labelsize=8)


def _draw_residuals(axes: Axes, sensor: str, of: PlottedIntrinsics) -> None:
    """Mean residuals of cells as arrows; grey where chance explains them."""
    seen = of.corners
    if not len(seen.pixels):
        _frame(axes, of, f"{sensor}: no corners")
        return
    rms = float(np.sqrt((seen.errors_px**2).mean()))
    at, mean, is_alike = _means(of)
    axes.plot(*seen.pixels.T, ls="", marker=".", markersize=DOT, color="#BBBBBB", zorder=1)
    title = f"{sensor}: errors that stay in the refinement\nrms {rms:.2g} px along each axis"
    longest = float(np.linalg.norm(mean, axis=1).max(initial=0.0))
    if longest > 0.0:
        times = round_down(ARROW_SHARE * max(of.size) / MEAN_CELLS / longest)
        axes.quiver(
            *at.T, *(times * mean).T, color=np.where(is_alike, BLUE, GREY),
            angles="xy", scale_units="xy", scale=1.0, width=0.006, minlength=0.3, zorder=3,
        )  # fmt: skip
        title += f"; arrows {times:,g}x"
    _frame(axes, of, title)


def _means(of: PlottedIntrinsics) -> tuple[Array, Array, np.ndarray]:
    """Middles (c, 2) and mean errors (c, 2) of cells that several images have, and where the images' means are alike.

    Corners of an image share its errors of A, so that each image counts once. With n images' means m_i, of mean m,
    n (n - 1) |m|^2 / sum |m_i - m|^2 is F-distributed with 2 and 2 (n - 1) degrees of freedom, if m is by chance.
    """
    cells, number = cells_of(of.corners.pixels, of.size, MEAN_CELLS)
    _, of_pair, count = np.unique(np.stack([cells, of.image], axis=1), axis=0, return_inverse=True, return_counts=True)
    of_pair = of_pair.ravel()
    middles, means = (_mean(values, of_pair, count) for values in (of.corners.pixels, of.corners.errors_px))
    cell = np.zeros(len(count), dtype=np.int64)
    cell[of_pair] = cells
    n = np.bincount(cell, minlength=number)
    middle, mean = (_mean(values, cell, np.maximum(n, 1)) for values in (middles, means))
    scatter = np.bincount(cell, ((means - mean[cell]) ** 2).sum(axis=1), number)
    several = (n > 1) & (scatter > 0.0)
    n, mean = n[several], mean[several]
    F = n * (n - 1.0) * (mean**2).sum(axis=1) / scatter[several]
    return middle[several], mean, fdtrc(2.0, 2.0 * (n - 1.0), F) < LEVEL


def _mean(values: Array, group: np.ndarray, count: np.ndarray) -> Array:
    """Means (g, 2) of values (N, 2) by their group."""
    return np.stack([np.bincount(group, values[:, k], len(count)) / count for k in range(2)], axis=1)


def _draw_uncertainty(axes: Axes, of: PlottedIntrinsics) -> None:
    """The deviation of projections as shades with lines of equal deviation; dots where corners were seen."""
    from matplotlib.colors import LogNorm

    known = of.deviations_px[np.isfinite(of.deviations_px)]
    if not len(known):
        _frame(axes, of, "no projections")
        return
    low, high = float(known.min()), float(known.max())
    u, v = of.grid[0, :, 0], of.grid[:, 0, 1]
    shades = np.ma.masked_invalid(of.deviations_px)
    width, height = of.size
    axes.imshow(
        shades, cmap=_colours(), norm=LogNorm(low, max(high, 30.0 * low)), interpolation="bilinear", zorder=0,
        extent=(-0.5, width - 0.5, height - 0.5, -0.5),
    )  # fmt: skip
    every = [step * 10.0**power for power in range(-6, 7) for step in STEPS]
    levels = [level for level in every if low < level < high]
    if len(levels) > MOST_LINES:
        levels = [level for level in levels if round(np.log10(level), 6).is_integer()]
    if levels and min(of.deviations_px.shape) > 1:
        lines = axes.contour(u, v, shades, levels=levels, colors="black", linewidths=0.8, zorder=3)
        axes.clabel(lines, fmt=lambda level: f"{level:g} px", fontsize=8)
    axes.plot(*of.corners.pixels.T, ls="", marker=".", markersize=DOT, color="black", alpha=0.4, zorder=2)
    where = f"how sure the lens is of single points at {rounded(of.distance_m)} m:"
    _frame(axes, of, f"{where}\nprojections deviate by {rounded(low)} to {rounded(high)} px")
    axes.tick_params(labelleft=False)


def _draw_held_out(axes: Axes, of: PlottedIntrinsics) -> None:
    """The errors of held-out corners as numbers."""
    colours = _colours()
    width, height = of.size
    every = [px for row in of.held_out_px for px in row if px is not None]
    if not every:
        _frame(axes, of, "no images were left out")
        axes.tick_params(labelleft=False)
        return
    largest = max(every) or 1.0
    rows, columns = len(of.held_out_px), len(of.held_out_px[0])
    across, down = width / columns, height / rows
    for i, row in enumerate(of.held_out_px):
        for j, px in enumerate(row):
            left, top = j * across - 0.5, i * down - 0.5
            colour = "white" if px is None else colours(px / largest)
            axes.fill_between([left, left + across], top, top + down, color=colour, lw=0, zorder=0)
            words = "no corner" if px is None else f"{px:.2g}"
            axes.text(
                left + 0.5 * across, top + 0.5 * down, words, ha="center", va="center",
                color=GREY if px is None else "black", fontsize=9 if px is None else 12,
            )  # fmt: skip
    _frame(axes, of, "rms error of corners by part of the image,\nin images that were left out (px)")
    axes.tick_params(labelleft=False)
