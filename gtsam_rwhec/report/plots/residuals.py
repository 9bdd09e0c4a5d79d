"""A picture of the residuals over time, with the removed measurements by reason."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import ByPair
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

#: The most frequent reasons have these markers and colours; the other reasons share `REST`.
SYMBOLS = (("x", VERMILLION), ("^", ORANGE), ("s", GREEN), ("D", PURPLE), ("v", SKY), ("+", BLACK))
REST = ("1", GREY)
#: The legend has this text for `REST`.
OTHER = "other reasons"
#: Measurements whose residual is not known are drawn at this height, as a share of the axes.
UNKNOWN_AT = 0.04
#: The legend has this text for measurements whose residual is not known.
UNKNOWN = "(on the lower edge: residual not known)"
#: This reason is written if a measurement has none.
NO_REASON = "not used"


def plot_residuals(measurements: ByPair[PlottedMeasurement], path: str | Path) -> None:
    """Draw rotation and translation residuals over time, a row for each sensor.

    Parameters
    ----------
    measurements : dict of (target, sensor) to PlottedMeasurement
    path
        The PNG file. An existing file is replaced.

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


def _joined(sensor: str, measurements: ByPair[PlottedMeasurement]) -> PlottedMeasurement:
    """All measurements of a sensor; a reason is empty exactly where a measurement was used."""
    of_sensor = [measured for (_, name), measured in measurements.items() if name == sensor]
    stamps, rotation, translation, inlier = (
        np.concatenate([np.asarray(getattr(measured, field), dtype=kind) for measured in of_sensor])
        for field, kind in (("stamps_s", float), ("rotation_deg", float), ("translation_mm", float), ("inlier", bool))
    )
    words = [word for measured in of_sensor for word in measured.reason]
    reason = ["" if used else word or NO_REASON for used, word in zip(inlier, words, strict=True)]
    return PlottedMeasurement(stamps, rotation, translation, inlier, reason)


def _draw(
    axes: Axes, row: PlottedMeasurement, values: Array, begin: float, symbols: dict[str, tuple[str, str]]
) -> None:
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
                stamps, np.broadcast_to(heights, stamps.shape), marker,
                color=colour, markersize=5, markerfacecolor="none", transform=transform, zorder=3,
            )  # fmt: skip


def _limits(values: Array, inlier: np.ndarray) -> tuple[float, float]:
    """The axis ends at the largest residual, and begins at a hundredth of the median of the used residuals."""
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
