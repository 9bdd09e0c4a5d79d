"""Charts of residuals: by pair, over time, over the image, over the carriers' pose, and against normal noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtri

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.page.figures import INK, SvgFigure, svg_figure
from gtsam_rwhec.report.plots.coverage import image_axes
from gtsam_rwhec.report.plots.drawing import GREEN, GREY, ORANGE, PURPLE, VERMILLION, shortened
from gtsam_rwhec.results.image_errors import SeenCamera
from gtsam_rwhec.results.residual_evidence import Dependence, ResidualsEvidence

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Blue that is seen on dark as well as on light.
BLUE = "#2C8CC9"
#: Sensors are told apart by colour and by sign, up to this number; more are drawn alike.
SIGNS = ((BLUE, "o"), (VERMILLION, "^"), (GREEN, "s"), (ORANGE, "D"), (PURPLE, "v"), (GREY, "P"))
#: With more pairs there is one box a sensor.
MOST_BOXES = 14
#: More signs than this become pixels.
MANY = 600
#: Arrows over the image: cells along its longer and its shorter side.
CELLS = (8, 6)
#: A cell with fewer corners has no arrow.
FEWEST_CORNERS = 3
#: The longest arrow, in cells.
ARROW = 0.9


def boxes_figure(found: ResidualsEvidence) -> SvgFigure:
    """Boxes of angles and lengths by pair, or by sensor where there are many pairs."""
    grouped: dict[str, list[tuple[Array, Array]]] = {}
    for pair in found.pairs:
        if not pair.used:
            continue
        name = f"{pair.target}, {pair.sensor}" if len(found.pairs) <= MOST_BOXES else pair.sensor
        inside = np.array(pair.in_answer, dtype=bool)
        grouped.setdefault(name, []).append((np.array(pair.deg)[inside], np.array(pair.mm)[inside]))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, 2, sharey=True)
        for axes, k, unit in zip(panels, (0, 1), ("degrees", "mm"), strict=True):
            values = [np.concatenate([part[k] for part in parts]) for parts in grouped.values()]
            line = {"color": INK, "linewidth": 0.8}
            axes.boxplot(
                values, orientation="horizontal", widths=0.6, flierprops={"marker": ".", "markersize": 3,
                "markeredgecolor": BLUE}, medianprops={"color": VERMILLION, "linewidth": 1.6}, boxprops=line,
                whiskerprops=line, capprops=line,
            )  # fmt: skip
            axes.set_xlabel(f"residual ({unit})")
            axes.set_xlim(left=0.0)
            axes.grid(visible=False, axis="y")
        panels[0].set_yticks(range(1, len(grouped) + 1), [shortened(name, 24) for name in grouped])
        panels[0].invert_yaxis()

    return svg_figure(draw, 0.9 + 0.27 * len(grouped))


def time_figure(found: ResidualsEvidence) -> SvgFigure:
    """Angles and lengths over time, by sensor; those that are not in the answer as crosses."""
    sensors = list(dict.fromkeys(pair.sensor for pair in found.pairs))
    rasterized = sum(len(pair.times) for pair in found.pairs) > MANY

    def draw(figure: Figure) -> None:
        panels = figure.subplots(2, 1, sharex=True)
        has_removed = False
        for axes, field, unit in zip(panels, ("deg", "mm"), ("degrees", "mm"), strict=True):
            for number, sensor in enumerate(sensors):
                colour, sign = SIGNS[number] if len(sensors) <= len(SIGNS) else SIGNS[0]
                mine = [pair for pair in found.pairs if pair.sensor == sensor]
                inside = np.concatenate([np.array(pair.in_answer, dtype=bool) for pair in mine])
                times, values = (np.concatenate([getattr(p, name) for p in mine]) for name in ("times", field))
                label = shortened(sensor) if len(sensors) <= len(SIGNS) else None
                axes.plot(
                    times[inside], values[inside], sign, color=colour, markersize=2.4, markeredgewidth=0,
                    label=label, rasterized=rasterized,
                )  # fmt: skip
                axes.plot(times[~inside], values[~inside], "x", color=INK, markersize=4, rasterized=rasterized)
                has_removed |= bool((~inside).any())
            _positive_log(axes)
            axes.set_ylabel(f"residual ({unit})")
        panels[1].set_xlabel("time (s)" if found.has_stamps else "place in its pair")
        handles, labels = panels[0].get_legend_handles_labels()
        if has_removed:
            handles.append(panels[0].plot([], [], "x", color=INK, markersize=4)[0])
            labels.append("not in the answer")
        if handles:
            figure.legend(handles, labels, loc="outside upper left", ncols=3, handletextpad=0.2, markerscale=1.8)

    return svg_figure(draw, 3.8)


def _positive_log(axes: Axes) -> None:
    """A logarithmic axis whose labels are plain numbers."""
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_formatter(lambda value, _: "")


def image_figure(cameras: tuple[SeenCamera, ...]) -> SvgFigure:
    """The mean error of corners in each cell of the image, as arrows: what is left of the lens."""

    def draw(figure: Figure) -> None:
        rows = -(-len(cameras) // 2)
        grid = figure.subplots(rows, min(2, len(cameras)), squeeze=False).ravel()
        for axes in grid[len(cameras) :]:
            axes.set_axis_off()
        for axes, camera in zip(grid, cameras, strict=False):
            image_axes(axes, (camera.width, camera.height))
            at, mean = _means(camera)
            largest = float(np.linalg.norm(mean, axis=1).max(initial=0.0))
            times = ARROW * camera.width / CELLS[0] / largest if largest > 0.0 else 1.0
            axes.quiver(
                at[:, 0], at[:, 1], times * mean[:, 0], times * mean[:, 1], angles="xy", scale_units="xy", scale=1.0,
                color=VERMILLION, width=0.008,
            )  # fmt: skip
            axes.set_title(f"{shortened(camera.sensor, 18)}: longest {largest:.2g} px", size=9)

    return svg_figure(draw, 0.3 + 2.1 * -(-len(cameras) // 2))


def _means(camera: SeenCamera) -> tuple[Array, Array]:
    """Middles (n, 2) of cells with corners, and their mean errors (n, 2)."""
    across, down = CELLS if camera.width >= camera.height else CELLS[::-1]
    x, y = np.array(camera.x), np.array(camera.y)
    column = np.clip((x / camera.width * across).astype(int), 0, across - 1)
    row = np.clip((y / camera.height * down).astype(int), 0, down - 1)
    cell, number = row * across + column, across * down
    count = np.bincount(cell, minlength=number)
    kept = count >= FEWEST_CORNERS
    sums = np.column_stack([np.bincount(cell, weights=np.array(d), minlength=number) for d in (camera.dx, camera.dy)])
    cells = np.arange(number)
    middles = np.column_stack(
        [(cells % across + 0.5) * camera.width / across, (cells // across + 0.5) * camera.height / down]
    )
    return middles[kept], sums[kept] / count[kept, None]


def dependence_figure(found: Dependence) -> SvgFigure:
    """A residual over a coordinate of A, with its mean in ten pieces."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        x, y = np.array(found.x), np.array(found.y)
        axes.plot(x, y, ".", color=BLUE, markersize=4, markeredgewidth=0, rasterized=len(x) > MANY)
        pieces = np.array_split(np.argsort(x), min(10, max(len(x) // 4, 1)))
        axes.plot([x[p].mean() for p in pieces], [y[p].mean() for p in pieces], "-", color=VERMILLION, lw=2)
        axes.set_xlabel(found.by)
        axes.set_ylabel("residual / noise")

    return svg_figure(draw, 2.9)


def normal_figure(found: ResidualsEvidence) -> SvgFigure:
    """Histogram and quantiles of normalised residuals, against those of normal noise."""
    values = np.sort(np.concatenate([np.array(pair.normalised).reshape(-1) for pair in found.pairs]))

    def draw(figure: Figure) -> None:
        left, right = figure.subplots(1, 2)
        edges = np.linspace(-4.0, 4.0, 41)
        left.hist(np.clip(values, -4.0, 4.0), edges, density=True, color=BLUE, alpha=0.7)
        at = np.linspace(-4.0, 4.0, 161)
        left.plot(at, np.exp(-0.5 * at**2) / np.sqrt(2.0 * np.pi), color=VERMILLION, lw=1.8)
        left.set_xlabel("residual / noise")
        left.set_yticks([])
        left.set_title("bars: found, line: normal", size=9)
        shown = values if len(values) <= MANY else values[np.unique(np.linspace(0, len(values) - 1, MANY).astype(int))]
        expected = ndtri((np.searchsorted(values, shown) + 0.5) / len(values))
        limit = 1.05 * float(max(np.abs(shown).max(initial=1.0), np.abs(expected).max(initial=1.0)))
        right.plot([-limit, limit], [-limit, limit], color=VERMILLION, lw=1.2)
        right.plot(expected, shown, ".", color=BLUE, markersize=4, markeredgewidth=0)
        right.set_xlabel("normal quantile")
        right.set_ylabel("found quantile")
        right.set_title("on the line: as normal noise", size=9)

    return svg_figure(draw, 2.9)
