"""Charts of the joint covariance: standard deviations of each frame by axis, and the correlation of all unknowns."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.files.terminal_text import natural_key
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.page.blocks import Block, Chart, Paragraph
from gtsam_rwhec.report.page.figures import INK, svg_figure
from gtsam_rwhec.report.plots.drawing import AXIS_COLOURS, AXIS_NAMES, plain_decades, shortened

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: A chart has a line for each of so many frames: those that are known least.
MOST_FRAMES = 40
#: Unknowns have a block with all their parameters up to this number; beyond it, one square each.
FEW_UNKNOWNS = 14
#: Names stand beside up to this number of blocks or squares.
MOST_NAMES = 45
#: The kinds of unknowns in their order, and what stands before the name of one.
KINDS = {
    UnknownKind.FRAME: "",
    UnknownKind.INTRINSICS: "lens of ",
    UnknownKind.SHAPE: "shape of ",
    UnknownKind.SCALE: "scale of ",
    UnknownKind.TIME_OFFSET: "clock of ",
}
#: One name for all that have one number each: beside one another their names would not be legible.
SINGLE = "scales, clocks"
MARKERS = ("o", "s", "^")


def deviations_chart(refined: RefinedPoses) -> Iterator[Block]:
    """Standard deviations of the frames along and about their own axes."""
    found = {
        name: refined.standard_deviations(name)
        for name in sorted((*refined.Y, *refined.X), key=natural_key)
        if name in refined.names
    }
    known = {name: pair for name, pair in found.items() if all(np.isfinite(each).all() for each in pair)}
    if not known:
        yield Paragraph("No frame has a finite standard deviation along all its axes.", "note")
        return
    if len(known) > MOST_FRAMES:
        worst = sorted(known, key=lambda name: known[name][1].max(), reverse=True)[:MOST_FRAMES]
        known = {name: known[name] for name in known if name in worst}
    left_out = len(found) - len(known)
    says = "One standard deviation of each frame along (left) and about (right) its own x, y and z axes."
    if left_out:
        says += f" {left_out} frames are left out, which are known better or have a free direction."

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, 2, sharey=True)
        for axes, which, unit in ((panels[0], 1, "mm"), (panels[1], 0, "degrees")):
            values = np.array([pair[which] for pair in known.values()])
            for k in range(3):
                axes.plot(values[:, k], range(len(known)), MARKERS[k], color=AXIS_COLOURS[k], label=AXIS_NAMES[k])
            low, high = float(values.min()), float(values.max())
            if low > 0.0 and high > 8.0 * low:
                axes.set_xscale("log")
                plain_decades(axes.xaxis, low, high)
                axes.set_xlim(0.8 * low, 1.25 * high)
            else:
                axes.set_xlim(0.0, 1.12 * high or 1.0)
                axes.locator_params(axis="x", nbins=4, steps=[1, 2, 4, 5, 10])
                axes.xaxis.set_major_formatter(lambda value, _: f"{value:.3g}")
            axes.set_xlabel(f"± {unit}")
        panels[0].set_yticks(range(len(known)), [shortened(name, 14) for name in known])
        panels[0].set_ylim(len(known) - 0.5, -0.5)
        figure.legend(*panels[1].get_legend_handles_labels(), loc="outside upper right", ncols=3, fontsize=9)

    yield Chart("deviations", "Standard deviations", says, svg_figure(draw, 1.1 + 0.24 * len(known)))


def correlation_chart(refined: RefinedPoses) -> Iterator[Block]:
    """The correlation of all unknowns, ordered by kind and name; of many, the largest of each pair."""
    order = sorted(refined.unknowns, key=lambda one: (list(KINDS).index(one.kind), natural_key(one.owner)))
    if not order:
        return
    rows = [np.arange(len(refined.joint.unit))[refined.joint.slots[one]] for one in order]
    place = np.concatenate(rows)
    matrix = correlation(refined.joint.finite[np.ix_(place, place)])
    sizes = [len(each) for each in rows]
    has_blocks = len(order) <= FEW_UNKNOWNS
    says = (
        "The correlation of all unknowns, from -1 (orange) through 0 (white) to 1 (blue). A block has the rotation of "
        "a frame about x, y, z, then its translation."
    )
    if not has_blocks:
        matrix, sizes = _largest_of_blocks(matrix, sizes), [1] * len(order)
        says = (
            "The largest correlation between the parameters of two unknowns, from 0 (white) to 1 (blue), without sign."
        )
    says += " Frames that are correlated are off together; the relative poses below count it."
    if refined.joint.free.shape[1]:
        says += " Free directions are left out."
    names, sizes = _groups(order, sizes)

    def draw(figure: Figure) -> None:
        from matplotlib.colors import LinearSegmentedColormap

        axes = figure.subplots()
        colours = LinearSegmentedColormap.from_list("correlation", ["#D55E00", "#FFFFFF", "#0072B2"])
        image = axes.imshow(matrix, cmap=colours, vmin=-1.0, vmax=1.0, interpolation="nearest")
        edges = np.cumsum([0, *sizes]) - 0.5
        middles = 0.5 * (edges[1:] + edges[:-1])
        size = 9 if len(names) <= FEW_UNKNOWNS else 6
        if len(names) <= MOST_NAMES:
            axes.set_xticks(middles, names, rotation=90, fontsize=size)
            axes.set_yticks(middles, names, fontsize=size)
        else:
            axes.set(xticks=[], yticks=[])
        axes.grid(visible=False)
        axes.tick_params(length=0)
        if has_blocks:
            for edge in edges[1:-1]:
                axes.axhline(edge, color="#555555", lw=0.5)
                axes.axvline(edge, color="#555555", lw=0.5)
        bar = figure.colorbar(image, ax=axes, shrink=0.7, ticks=[-1, 0, 1] if has_blocks else [0, 1])
        bar.outline.set_edgecolor(INK)
        if not has_blocks:
            bar.ax.set_ylim(0.0, 1.0)

    yield Chart("correlation", "Correlation", says, svg_figure(draw, 4.6))


def correlation(covariance: Array) -> Array:
    """The correlation matrix of a covariance; rows without variance correlate with nothing."""
    deviation = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    inverse = np.divide(1.0, deviation, out=np.zeros_like(deviation), where=deviation > 0.0)
    result: Array = np.clip(covariance * inverse[:, None] * inverse, -1.0, 1.0)
    return result


def _groups(unknowns: list[Unknown], sizes: list[int]) -> tuple[list[str], list[int]]:
    """The names beside the matrix and the sizes of their blocks; scales and clocks, which come last, have one name."""
    single = (UnknownKind.SCALE, UnknownKind.TIME_OFFSET)
    alone = [i for i, one in enumerate(unknowns) if one.kind not in single]
    names = [shortened(KINDS[unknowns[i].kind] + unknowns[i].owner, 18) for i in alone]
    rest = sum(sizes) - sum(sizes[i] for i in alone)
    return names + [SINGLE] * bool(rest), [sizes[i] for i in alone] + [rest] * bool(rest)


def _largest_of_blocks(matrix: Array, sizes: list[int]) -> Array:
    """The largest size of the entries in each block."""
    first = np.cumsum([0, *sizes[:-1]])
    of_rows = np.maximum.reduceat(np.abs(matrix), first, axis=0)
    result: Array = np.maximum.reduceat(of_rows, first, axis=1)
    return result
