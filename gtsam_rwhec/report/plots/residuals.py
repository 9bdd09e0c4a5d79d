"""How far each measurement is from what the answer predicts, over time; and what was removed, by reason."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import ByPair
from gtsam_rwhec.report.plots.drawing import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LONGEST_REASON,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    picture,
    plain_decades,
    say,
    shortened,
)
from gtsam_rwhec.report.plots.plotted import PlottedMeasurement

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

#: The most frequent reasons have these, the rest share `REST`.
SYMBOLS = (("x", VERMILLION), ("^", ORANGE), ("s", GREEN), ("D", PURPLE), ("v", SKY), ("+", BLACK))
REST = ("1", GREY)
OTHER = "other reasons"
#: Where those are whose residual is not known: along the lower edge.
UNKNOWN_AT, UNKNOWN = 0.04, "(on the lower edge: residual not known)"
NO_REASON = "not used"


def plot_residuals(measurements: ByPair[PlottedMeasurement], path: str | Path) -> None:
    """Draw rotation and translation residuals over time, a row for each sensor.

    Parameters
    ----------
    measurements : dict of (target, sensor) to PlottedMeasurement
    path
        The PNG; replaced if it is there.

    Raises
    ------
    FileFormatError
        The file cannot be written.
    """
    sensors = {sensor: _joined(sensor, measurements) for sensor in dict.fromkeys(sensor for _, sensor in measurements)}
    reasons = Counter(reason for row in sensors.values() for reason in row.reason if reason)
    kinds = [reason for reason, _ in sorted(reasons.items(), key=lambda item: (-item[1], item[0]))]
    symbols = dict(zip(kinds, SYMBOLS, strict=False))
    with picture(path, 12.0, 1.3 + 2.1 * max(len(sensors), 1)) as figure:
        if not sensors:
            say(figure.subplots(), "no measurements")
            return
        grid = figure.subplots(len(sensors), 2, sharex=True, squeeze=False)
        begin = min((row.stamps_s.min() for row in sensors.values() if len(row.stamps_s)), default=0.0)
        for (left, right), (sensor, row) in zip(grid, sensors.items(), strict=True):
            for axes, values, what, unit in (
                (left, row.rotation_deg, "rotation", "deg"),
                (right, row.translation_mm, "translation", "mm"),
            ):
                _draw(axes, row, values, begin, symbols)
                axes.set_ylabel(f"{what} (mm)" if unit == "mm" else f"{what} (deg)")
                axes.set_title(f"{shortened(sensor)}: {_counted(row.inlier, values, unit)}")
        for axes in grid[-1]:
            axes.set_xlabel("time (s)")
        unknown = any((~np.isfinite(row.rotation_deg[~row.inlier])).any() for row in sensors.values())
        figure.legend(handles=_handles(symbols, reasons, has_unknown=unknown), loc="outside upper left", ncols=3)


@dataclass(frozen=True, eq=False)
class _Row:
    """All measurements of a sensor."""

    stamps_s: Array
    rotation_deg: Array
    translation_mm: Array
    inlier: np.ndarray
    reason: list[str]


def _joined(sensor: str, measurements: ByPair[PlottedMeasurement]) -> _Row:
    of_sensor = [measured for (_, name), measured in measurements.items() if name == sensor]
    inlier = np.concatenate([np.asarray(measured.inlier, dtype=bool) for measured in of_sensor])
    words = [word for measured in of_sensor for word in measured.reason]
    return _Row(
        np.concatenate([np.asarray(measured.stamps_s, dtype=float) for measured in of_sensor]),
        np.concatenate([np.asarray(measured.rotation_deg, dtype=float) for measured in of_sensor]),
        np.concatenate([np.asarray(measured.translation_mm, dtype=float) for measured in of_sensor]),
        inlier,
        ["" if used else word or NO_REASON for used, word in zip(inlier, words, strict=True)],
    )


def _draw(axes: Axes, row: _Row, values: Array, begin: float, symbols: dict[str, tuple[str, str]]) -> None:
    time = row.stamps_s - begin
    low, high = _limits(values, row.inlier)
    axes.set_yscale("log")
    axes.set_ylim(low, high)
    plain_decades(axes.yaxis, low, high)
    used = row.inlier
    axes.plot(time[used], values[used], ".", color=BLUE, markersize=4, markeredgewidth=0, alpha=0.7, zorder=2)
    reasons = np.array(row.reason, dtype=object)
    for reason in dict.fromkeys(row.reason):
        if not reason:
            continue
        marker, colour = symbols.get(reason, REST)
        at = reasons == reason
        for stamps, heights, transform in (
            (time[at], np.maximum(values[at], low), axes.transData),
            (time[at & ~np.isfinite(values)], UNKNOWN_AT, axes.get_xaxis_transform()),
        ):
            axes.plot(
                stamps,
                np.broadcast_to(heights, stamps.shape),
                marker,
                color=colour,
                markersize=5,
                markerfacecolor="none",
                transform=transform,
                zorder=3,
            )


def _limits(values: Array, inlier: np.ndarray) -> tuple[float, float]:
    """Of the axis: all that is large, and what is used down to a hundredth of its median."""
    positive = values[np.isfinite(values) & (values > 0.0)]
    if not len(positive):
        return 0.1, 10.0
    used = values[inlier & np.isfinite(values) & (values > 0.0)]
    high = 1.6 * float(positive.max())
    typical = used if len(used) else positive
    low = max(0.6 * float(typical.min()), 0.01 * float(np.median(typical)), 1e-6 * high)
    middle = np.sqrt(low * high)
    return min(low, middle / 4.0), max(high, middle * 4.0)


def _counted(inlier: np.ndarray, values: Array, unit: str) -> str:
    used = values[inlier & np.isfinite(values)]
    median = f" (median {np.median(used):.2g} {unit})" if len(used) else ""
    return f"{inlier.sum()} used{median}, {(~inlier).sum()} removed"


def _handles(symbols: dict[str, tuple[str, str]], reasons: Counter[str], *, has_unknown: bool) -> list[Line2D]:
    from matplotlib.lines import Line2D

    entries = [("used", ".", BLUE)]
    entries += [
        (f"{shortened(reason, LONGEST_REASON)} ({reasons[reason]})", *symbol) for reason, symbol in symbols.items()
    ]
    rest = reasons.total() - sum(reasons[reason] for reason in symbols)
    if rest:
        entries.append((f"{OTHER} ({rest})", *REST))
    if has_unknown:
        entries.append((UNKNOWN, "", BLACK))
    return [
        Line2D(
            [], [], ls="", marker=marker, color=colour, markerfacecolor=colour if marker == "." else "none", label=label
        )
        for label, marker, colour in entries
    ]
