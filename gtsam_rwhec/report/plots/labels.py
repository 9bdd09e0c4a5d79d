"""Names beside points, placed so that they cover neither each other nor what is drawn.

Measured on 2026-11-22 (tests/benchmarks/own_code_against_libraries.py): of 120 names among 1,200 points, those on
another name or on a point are 1 here, 33 with adjustText 1.4.0 and 0 with textalloc 1.2.4; but textalloc cannot draw on
a row of a figure (matplotlib's SubFigure), which our pictures need.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.geometry.poses import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Distances of a name from its point that are tried, in points, and directions.
DISTANCES, DIRECTIONS = (7.0, 14.0, 22.0, 32.0, 45.0, 60.0, 80.0, 105.0), 16
#: Beyond this distance a line leads from the name to the point.
LINE_FROM = 10.0
MARGIN_PX = 4.0


def label_points(axes: Axes, points: Array, names: Sequence[str], clear_of: Array) -> None:
    """Write names beside points.

    Greedy: each name takes the nearest place at which it covers the least. Limits of the axes and layout must be
    settled (``figure.draw_without_rendering``).

    Parameters
    ----------
    axes : matplotlib Axes
    points : (N, 2) array
        Data coordinates.
    names : N str
    clear_of : (M, 2) array
        Points that names should not cover, data coordinates.
    """
    figure = axes.get_figure(root=True)
    assert figure is not None
    pixels_a_point = figure.dpi / 72.0
    taken = axes.transData.transform(np.concatenate([points, clear_of]))
    at = axes.transData.transform(points)
    frame = axes.get_window_extent()
    boxes = np.empty((0, 4))
    lines = np.empty((0, 2))
    for (x, y), point, name in zip(at, points, names, strict=True):
        text = axes.annotate(name, point, fontsize=8.5, annotation_clip=False, zorder=6)
        text.set_in_layout(False)
        extent = text.get_window_extent()
        size = np.array([extent.width, extent.height])
        best, best_cost = (0.0, 0.0), np.inf
        for distance in DISTANCES:
            for k in range(DIRECTIONS):
                angle = 2.0 * np.pi * k / DIRECTIONS
                towards = np.array([np.cos(angle), np.sin(angle)])
                # The box's nearest corner or side is at the distance.
                middle = np.array([x, y]) + towards * (distance * pixels_a_point + 0.5 * np.abs(towards) @ size)
                low, high = middle - 0.5 * size - MARGIN_PX, middle + 0.5 * size + MARGIN_PX
                line = np.array([x, y]) + np.linspace(0.15, 0.95, 9)[:, None] * (middle - (x, y))
                line = line if distance > LINE_FROM else line[:0]
                cost = 3.0 * _overlapping(boxes, low, high) + _inside(taken, low, high) + _inside(lines, low, high)
                cost += 2.0 * sum(_inside(line, box[:2], box[2:]) > 0 for box in boxes)
                cost += 10.0 * (low[0] < frame.x0 or low[1] < frame.y0 or high[0] > frame.x1 or high[1] > frame.y1)
                if cost < best_cost:
                    best, best_cost = tuple(middle), cost
                    chosen = np.concatenate([low, high]), line
            if best_cost == 0.0:
                break
        text.remove()
        offset = (np.array(best) - (x, y)) / pixels_a_point
        far = len(chosen[1]) > 0
        annotation = axes.annotate(
            name,
            point,
            offset,
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=8.5,
            zorder=6,
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": "#777777", "lw": 0.6, "shrinkA": 0, "shrinkB": 3} if far else None,
        )
        annotation.set_in_layout(False)
        boxes, lines = np.vstack([boxes, chosen[0]]), np.vstack([lines, chosen[1]])


def _inside(points: Array, low: Array, high: Array) -> int:
    return int(((points >= low) & (points <= high)).all(axis=1).sum())


def _overlapping(boxes: Array, low: Array, high: Array) -> int:
    return int(((boxes[:, :2] < high) & (boxes[:, 2:] > low)).all(axis=1).sum())
