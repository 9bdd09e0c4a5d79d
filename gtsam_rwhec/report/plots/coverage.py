"""A picture of each camera's image: where targets were seen, and the reprojection errors of their corners."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.plots.drawing import BLUE, picture, round_down, say, shortened
from gtsam_rwhec.report.plots.plotted import PlottedCorners

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PathCollection
    from matplotlib.colors import Colormap

#: An image's longer side has this many cells for its coverage.
COVERAGE_CELLS = 16
#: An image's longer side has this many cells for mean errors.
MEAN_CELLS = 10
#: A mean error is drawn only for a cell with at least this many corners.
LEAST_CORNERS = 5
#: The longest arrow has this length, as a share of a cell.
ARROW_SHARE = 0.9


def plot_coverage(corners: Mapping[str, PlottedCorners], cameras: Mapping[str, Camera], path: str | Path) -> None:
    """Draw each camera's image with the corners seen, coloured by reprojection error, and mean errors as arrows.

    Parameters
    ----------
    corners : dict of str to PlottedCorners
        By sensor.
    cameras : dict of str to Camera
        By sensor, for the sizes of the images. Without a camera the size is taken from the corners.
    path
        The PNG file. An existing file is replaced.

    Raises
    ------
    FileFormatError
        The file cannot be written.
    """
    columns = min(max(len(corners), 1), 2 if len(corners) <= 4 else 3)
    rows = -(-len(corners) // columns) or 1
    corners = {sensor: _finite(seen) for sensor, seen in corners.items()}
    sizes = {sensor: _size(seen, cameras.get(sensor)) for sensor, seen in corners.items()}
    tallest = max((height / width for width, height in sizes.values()), default=0.75)
    width_in = 12.0 if columns > 1 else 8.0
    row_in = ((width_in - 1.2) / columns - 0.7) * min(tallest, 1.5) + 1.0
    from matplotlib.lines import Line2D

    with picture(path, width_in, rows * row_in + 0.5, "compressed") as figure:
        if not corners:
            say(figure.subplots(), "no corners")
            return
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        every = np.concatenate([np.linalg.norm(seen.errors_px, axis=1) for seen in corners.values()])
        # The 2 % of the corners with the largest errors share the last colour.
        largest = float(np.quantile(every, 0.98)) if len(every) else 0.0
        largest = largest or 1.0
        points = None
        for axes, (sensor, seen) in zip(panels, corners.items(), strict=False):
            points = _draw(axes, sensor, seen, sizes[sensor], largest)
        for axes in panels[len(corners) :]:
            axes.set_visible(False)
        assert points is not None
        bar = figure.colorbar(
            points, ax=panels.tolist(), extend="max", extendfrac=0.03, aspect=40, shrink=0.8, pad=0.015
        )
        bar.set_label("reprojection error of a corner, with A as measured (px)")
        words = f"mean error of {LEAST_CORNERS} or more neighbouring corners, enlarged as the title says"
        arrow = Line2D([], [], marker=">", markersize=5, lw=1.2, color=BLUE, label=words)
        figure.legend(handles=[arrow], loc="outside lower left")


def _finite(seen: PlottedCorners) -> PlottedCorners:
    pixels, errors = np.asarray(seen.pixels, dtype=float), np.asarray(seen.errors_px, dtype=float)
    good = np.isfinite(pixels).all(axis=1) & np.isfinite(errors).all(axis=1)
    return PlottedCorners(pixels[good], errors[good])


def _size(seen: PlottedCorners, camera: Camera | None) -> tuple[float, float]:
    if camera is not None:
        return float(camera.width), float(camera.height)
    if not len(seen.pixels):
        return 4.0, 3.0
    width, height = np.maximum(np.ceil(seen.pixels.max(axis=0)) + 1.0, 1.0)
    return float(width), float(height)


def _draw(axes: Axes, sensor: str, seen: PlottedCorners, size: tuple[float, float], largest: float) -> PathCollection:
    errors = np.linalg.norm(seen.errors_px, axis=1)
    order = np.argsort(errors, kind="stable")  # the largest errors on top
    points = axes.scatter(
        seen.pixels[order, 0], seen.pixels[order, 1],
        c=errors[order], s=6, lw=0, cmap=_colours(), vmin=0.0, vmax=largest, zorder=2,
    )  # fmt: skip
    image_axes(axes, size)
    axes.set(xlabel="u (px)", ylabel="v (px)")
    if not len(errors):
        axes.set_title(f"{shortened(sensor)}: no corners")
        return points
    note = _draw_means(axes, seen, size)
    rms = np.sqrt(np.mean(errors**2))
    covered = _share(seen.pixels, size)
    axes.set_title(
        f"{shortened(sensor)}: {len(errors)} corners in {covered:.0%} of the image\n"
        f"rms length of all errors, outliers too: {rms:.2g} px{note}"
    )
    return points


def image_axes(axes: Axes, size: tuple[float, float]) -> None:
    """Make axes those of an image of a (width, height): its pixels from the upper left, with a frame around it."""
    width, height = size
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.set_aspect("equal")
    axes.spines[:].set_visible(True)
    axes.grid(visible=False)


def _colours() -> Colormap:
    """From pale orange to black: on white the largest errors are seen best. The palest colours are left out."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    return ListedColormap(colormaps["magma_r"](np.linspace(0.15, 1.0, 256)))


def _share(pixels: Array, size: tuple[float, float]) -> float:
    """The share of the image's cells that contain corners."""
    cells, count = cells_of(pixels, size, COVERAGE_CELLS)
    return len(np.unique(cells)) / count


def _draw_means(axes: Axes, seen: PlottedCorners, size: tuple[float, float]) -> str:
    """Draw mean errors of cells as arrows; return their scale for the title. Wrong intrinsics do not average out."""
    cells, _ = cells_of(seen.pixels, size, MEAN_CELLS)
    means = []
    for cell in np.unique(cells):
        at = cells == cell
        if at.sum() >= LEAST_CORNERS:
            means.append((*seen.pixels[at].mean(axis=0), *seen.errors_px[at].mean(axis=0)))
    if not means:
        return ""
    u, v, du, dv = np.array(means).T
    longest = float(np.hypot(du, dv).max())
    if longest == 0.0:
        return ""
    times = round_down(ARROW_SHARE * max(size) / MEAN_CELLS / longest)
    axes.quiver(
        u, v, times * du, times * dv,
        angles="xy", scale_units="xy", scale=1.0, color=BLUE, width=0.004, minlength=0.5, zorder=3,
    )  # fmt: skip
    return f"; arrows {times:,g}x"


def cells_of(pixels: Array, size: tuple[float, float], along: int) -> tuple[np.ndarray, int]:
    """Index (N,) of each pixel's cell, and the number of cells; cells are nearly square."""
    side = max(size) / along
    columns, rows = (max(int(np.ceil(length / side - 1e-9)), 1) for length in size)
    u, v = (np.clip(((pixels[:, k] + 0.5) / side).astype(int), 0, (columns, rows)[k] - 1) for k in range(2))
    return v * columns + u, columns * rows
