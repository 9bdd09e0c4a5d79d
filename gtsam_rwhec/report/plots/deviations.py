"""A picture of each frame's standard deviations, about and along its axes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.geometry.pose_covariances import standard_deviations
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.plots.drawing import (
    AXIS_COLOURS,
    AXIS_NAMES,
    GREY,
    PALE,
    picture,
    plain_decades,
    say,
    shortened,
)
from gtsam_rwhec.rig.rig_frames import RigFrames

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

#: The axes x, y, z have these markers.
MARKERS = ("o", "s", "^")
#: The markers in a frame's row have these heights, in rows.
HEIGHTS = (-0.22, 0.0, 0.22)


def plot_deviations(frames: RigFrames, covariances: Mapping[str, Array], path: str | Path) -> None:
    """Draw standard deviations in degrees and millimetres, a row for each frame, on logarithmic axes.

    Parameters
    ----------
    frames : RigFrames
    covariances : dict of str to (6, 6) array
        Covariance of T_carrier_frame's right perturbation [omega (rad), v (m)], by frame. A frame without a covariance
        is drawn as not estimated, an infinite variance as undetermined.
    path
        The PNG file. An existing file is replaced.

    Raises
    ------
    NoiseError
        A covariance has another shape or negative variances.
    FileFormatError
        The file cannot be written.
    """
    carried = ((frames.sensor_carrier, frames.sensors), (frames.target_carrier, frames.targets))
    groups = [
        (f"{what} on {carrier}", list(poses))
        for what, (carrier, poses) in zip(("Sensors", "Targets"), carried, strict=True)
        if poses
    ]
    every = [name for _, names in groups for name in names]
    deviations = {name: standard_deviations(covariances[name]) for name in every if name in covariances}
    rows = len(every)
    with picture(path, 11.0, 1.6 + 0.42 * rows + 0.5 * len(groups)) as figure:
        if not groups:
            say(figure.subplots(), "no frames")
            return
        grid = figure.subplots(
            len(groups), 2, squeeze=False, sharex="col", height_ratios=[len(names) + 0.4 for _, names in groups]
        )
        for column, unit in enumerate(("deg", "mm")):
            values = np.array([deviation[column] for deviation in deviations.values()]).reshape(-1, 3)
            limits = _limits(values)
            unbounded = bool(np.isinf(values).any())
            for row, (title, names) in zip(grid[:, column], groups, strict=True):
                _draw(row, {name: deviations[name][column] for name in names if name in deviations}, names, limits)
                if unbounded:
                    row.axvspan(limits[1] / limits[2], limits[1], color=PALE, lw=0, zorder=0)
                if column == 0:
                    row.set_title(title)
                else:
                    row.tick_params(labelleft=False)
            what = "about the frame's axes (deg)" if unit == "deg" else "along the frame's axes (mm)"
            grid[-1, column].set_xlabel(f"standard deviation {what}")
            if unbounded:
                grid[0, column].set_title("undetermined", loc="right", color=GREY)
        figure.legend(handles=_handles(), loc="outside lower center", ncols=3)


def _draw(axes: Axes, deviations: dict[str, Array], names: list[str], limits: tuple[float, float, float]) -> None:
    low, high, strip = limits
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    plain_decades(axes.xaxis, low, high / strip)
    axes.set_yticks(range(len(names)), [shortened(name) for name in names])
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    for y, name in enumerate(names):
        if y:
            axes.axhline(y - 0.5, color=PALE, lw=0.6)
        if name not in deviations:
            axes.text(np.sqrt(low * high / strip), y, "not estimated", ha="center", va="center", color=GREY)
            continue
        for k, value in enumerate(deviations[name]):
            known = np.isfinite(value)
            at = float(np.clip(value, low, high)) if known else high / np.sqrt(strip)
            axes.plot(
                at, y + HEIGHTS[k], MARKERS[k], color=AXIS_COLOURS[k], markerfacecolor=None if known else "none",
                markersize=5.5, clip_on=False, zorder=3,
            )  # fmt: skip


def _limits(values: Array) -> tuple[float, float, float]:
    """Lower and upper end of the axis, and upper over lower end of its last part, where infinite values are drawn."""
    finite = values[np.isfinite(values) & (values > 0.0)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.1, 1.0)
    middle = np.sqrt(low * high)
    low, high = min(low / 1.5, middle / 4.0), max(high * 1.5, middle * 4.0)
    strip = (high / low) ** 0.12 if np.isinf(values).any() else 1.0
    return low, high * strip, strip


def _handles() -> list[Line2D]:
    from matplotlib.lines import Line2D

    return [
        Line2D([], [], ls="", marker=marker, color=colour, label=f"{name} axis")
        for marker, colour, name in zip(MARKERS, AXIS_COLOURS, AXIS_NAMES, strict=True)
    ]
