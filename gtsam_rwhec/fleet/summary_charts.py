"""Charts of a fleet's summary: how certain the poses are, and what a log cost."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.fleet.rows import RobotRow
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.figures import GREEN, ORANGE, VERMILLION, plain_decades, svg_figure
from gtsam_rwhec.report.report_blocks import Chart

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Blue that is seen on dark as well as on light.
BLUE = "#2C8CC9"
#: More signs than this become pixels.
MANY = 600
SIGNS = {
    Verdict.USE: (GREEN, "o", "use"),
    Verdict.CARE: (ORANGE, "^", "with care"),
    Verdict.DO_NOT_USE: (VERMILLION, "x", "do not use"),
}


def uncertainty_chart(rows: Sequence[RobotRow]) -> Chart | None:
    """Rotation over position, one sign a calibration; None without covariances that are finite."""
    found: dict[Verdict, list[tuple[float, float]]] = {}
    free = 0
    for row in rows:
        if row.verdict is None or row.covariance is None or not len(row.covariance):
            continue
        largest = np.sqrt(np.diagonal(row.covariance).reshape(-1, 2, 3).max(axis=(0, 2)))
        if np.isfinite(largest).all() and largest.min() > 0.0:
            found.setdefault(row.verdict, []).append((1e3 * float(largest[1]), math.degrees(float(largest[0]))))
        else:
            free += 1
    if not found:
        return None
    count = sum(map(len, found.values()))

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for verdict, points in found.items():
            colour, sign, label = SIGNS[verdict]
            axes.plot(
                *np.array(points).T, sign, color=colour, markersize=4, alpha=0.8, label=f"{label} ({len(points)})",
                rasterized=count > MANY,
            )  # fmt: skip
        axes.set_xscale("log")
        axes.set_yscale("log")
        together = np.concatenate([np.array(points) for points in found.values()])
        for axis, values in zip((axes.xaxis, axes.yaxis), together.T, strict=True):
            plain_decades(axis, float(values.min()), float(values.max()))
        axes.set_xlabel("position (mm)")
        axes.set_ylabel("rotation (degrees)")
        axes.legend(loc="best")

    without = f" {free} with a free direction are not in it." if free else ""
    return Chart(
        "uncertainty",
        "How certain the poses are",
        f"The largest standard deviation of any frame, of {count} calibrations. Those far to the right or above "
        f"the others had too little motion, or worse measurements.{without}",
        svg_figure(draw),
    )


def cost_chart(rows: Sequence[RobotRow]) -> Chart | None:
    """Histograms of seconds and bytes a log; None where nothing is known."""
    counted = [row for row in rows if row.logs + len(row.failed_logs) and row.cpu_s > 0.0]
    if not counted:
        return None
    logs = np.array([row.logs + len(row.failed_logs) for row in counted], float)
    cpu_s = np.array([row.cpu_s for row in counted]) / logs
    megabytes = 1e-6 * np.array([row.bytes_read for row in counted]) / logs

    def draw(figure: Figure) -> None:
        for axes, values, label in zip(
            figure.subplots(1, 2, sharey=True), (cpu_s, megabytes), ("CPU seconds a log", "MB read a log"), strict=True
        ):
            axes.hist(values, bins=_edges(values), color=BLUE)
            axes.set_xlabel(label)
        figure.axes[0].set_ylabel("calibrations")

    return Chart(
        "cost",
        "What a log costs",
        f"A log takes {np.median(cpu_s):.3g} CPU seconds (median; at most {cpu_s.max():.3g}) and "
        f"{np.median(megabytes):.3g} MB from its store (at most {megabytes.max():.3g}).",
        svg_figure(draw),
    )


def _edges(values: Array) -> Array:
    """At most 30 bins; some width where all values are one."""
    least, most = float(values.min()), float(values.max())
    if most - least <= 1e-9 * max(abs(most), 1.0):
        least, most = 0.5 * least, 1.5 * most + 1e-9
    return np.linspace(least, most, min(30, max(5, int(math.sqrt(len(values)) * 2))) + 1)
