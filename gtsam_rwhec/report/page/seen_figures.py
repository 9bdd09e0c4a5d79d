"""Figures of what was seen: detections by camera and time, and where in each image there were corners."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.report.page.figures import INK, SvgFigure, svg_figure
from gtsam_rwhec.report.plots.coverage import image_axes
from gtsam_rwhec.report.plots.drawing import GREY, ORANGE, PURPLE, VERMILLION, shortened
from gtsam_rwhec.results.detection_evidence import SeenEvidence, SeenTrack
from gtsam_rwhec.results.image_errors import SeenCamera

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

#: Ticks and corners: Okabe and Ito's blue, a little lighter, to be seen on dark as well as on light.
USED = "#2C8CC9"
#: Signs of what was removed, by stage.
SIGNS = {"detection": ("^", ORANGE), "cleaning": ("x", VERMILLION), "robust estimation": ("s", PURPLE)}
OTHER = ("+", GREY)
#: Half the height of a tick of a used measurement, and how far above its row the signs stand, rows.
TICK, ABOVE = 0.28, 0.36
#: So many cameras are drawn, in so many columns, each at most so high as wide.
MOST_CAMERAS, COLUMNS, TALLEST = 12, 2, 1.4
#: More signs than this in a row stand together, those of so many pieces as one.
MOST_SIGNS, TOGETHER = 100, 4
#: More corners than this have smaller marks.
MANY_CORNERS = 1500
#: A row's name has so many characters.
LONGEST = 26


def detections_figure(seen: SeenEvidence) -> SvgFigure:
    """A row for each pair, or sensor: a tick where a measurement is used, a sign where it was removed."""
    stages = sorted({stage for track in seen.tracks for stage in track.removed_at})
    signs = {stage: SIGNS.get(stage, OTHER) for stage in [*SIGNS, *stages] if stage in stages}

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        step = 1.0 if seen.span_s is None else seen.span_s / seen.pieces
        for row, track in enumerate(seen.tracks):
            _draw_track(axes, row, track, step, signs)
        axes.set_ylim(len(seen.tracks) - 0.5, -0.7)
        axes.set_yticks(range(len(seen.tracks)), [name_of(track) for track in seen.tracks])
        axes.grid(visible=False, axis="y")
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
        axes.margins(x=0.01)
        if seen.span_s is None:
            axes.set_xlim(-0.01 * seen.pieces, 1.01 * seen.pieces)
            axes.set_xticks([0, seen.pieces], ["first", "last"])
            axes.set_xlabel("measurement, in the order given")
        else:
            axes.set_xlabel("time (s)")
        handles = [_handle("used", "|", USED)] + [
            _handle(f"removed by {stage}", *sign) for stage, sign in signs.items()
        ]
        figure.legend(handles=handles, loc="outside upper left", ncols=2, handletextpad=0.2, columnspacing=1.0)

    return svg_figure(draw, 1.15 + 0.25 * len(seen.tracks) + 0.2 * ((2 + len(signs)) // 2))


def name_of(track: SeenTrack) -> str:
    """A row's name."""
    return shortened(track.sensor if track.target is None else f"{track.target}, {track.sensor}", LONGEST)


def _draw_track(axes: Axes, row: int, track: SeenTrack, step: float, signs: dict[str, tuple[str, str]]) -> None:
    # Ticks of single pieces are one line, and pieces that follow one another one area: few words in the SVG.
    at = np.array([piece for piece, _ in track.used_at], dtype=int)
    begins = np.flatnonzero(np.diff(at, prepend=-2) > 1)
    first, last = at[begins], at[np.append(begins[1:], len(at)) - 1] if len(at) else at
    alone = step * (first[first == last] + 0.5)
    gap = np.full(len(alone), np.nan)
    ends = np.column_stack([np.full(len(alone), row - TICK), np.full(len(alone), row + TICK), gap])
    axes.plot(np.column_stack([alone, alone, gap]).ravel(), ends.ravel(), color=USED, lw=1.0)
    wide = first != last
    areas = list(zip(step * first[wide], step * (last - first + 1)[wide], strict=True))
    axes.broken_barh(areas, (row - TICK, 2.0 * TICK), facecolor=USED, lw=0.0)
    for stage, pieces in track.removed_at.items():
        marker, colour = signs[stage]
        at = np.array(pieces)[:, 0]
        if len(at) > MOST_SIGNS:
            at = np.unique(at // TOGETHER) * TOGETHER + TOGETHER // 2
        axes.plot(
            step * (0.5 + at), np.full(len(at), row - ABOVE), marker,
            color=colour, markersize=4.5, markerfacecolor="none", zorder=3,
        )  # fmt: skip


def _handle(label: str, marker: str, colour: str) -> Line2D:
    from matplotlib.lines import Line2D

    return Line2D([], [], ls="", marker=marker, markersize=6, color=colour, markerfacecolor="none", label=label)


def coverage_figure(cameras: Sequence[SeenCamera]) -> SvgFigure:
    """The image of each camera with its corners; cells without corners are shaded."""
    shown = cameras[:MOST_CAMERAS]
    columns = min(len(shown), COLUMNS)
    rows = -(-len(shown) // columns)
    tallest = min(max(camera.height / camera.width for camera in shown), TALLEST)

    def draw(figure: Figure) -> None:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes, camera in zip(panels, shown, strict=False):
            _draw_camera(axes, camera)
        for axes in panels[len(shown) :]:
            axes.set_visible(False)

    return svg_figure(draw, rows * (0.75 + tallest * 4.4 / columns))


def _draw_camera(axes: Axes, camera: SeenCamera) -> None:
    image_axes(axes, (camera.width, camera.height))
    cells = np.array(camera.cells)
    height, width = camera.height / cells.shape[0], camera.width / cells.shape[1]
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    empty = [Rectangle((width * c - 0.5, height * r - 0.5), width, height) for r, c in np.argwhere(cells == 0)]
    axes.add_collection(
        PatchCollection(empty, facecolor=ORANGE, alpha=0.35, edgecolor=INK, lw=0.3, hatch="////", zorder=1)
    )
    size = 2.6 if len(camera.x) > MANY_CORNERS else 3.6
    # As a picture in the figure: thousands of marks would be most of the page.
    axes.plot(camera.x, camera.y, ".", color=USED, markersize=size, markeredgewidth=0, zorder=2, rasterized=True)
    axes.set_title(f"{shortened(camera.sensor)}: {camera.share:.0%}")
