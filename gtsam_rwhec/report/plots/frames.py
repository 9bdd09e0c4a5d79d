"""A picture of the frames on their carriers, from above and from the side, with the covariances of their positions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.geometry.pose_covariances import checked
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.plots.drawing import (
    AXIS_COLOURS,
    AXIS_NAMES,
    BLACK,
    GREY,
    ORANGE,
    PURPLE,
    picture,
    round_down,
    say,
    shortened,
)
from gtsam_rwhec.rig.rig_frames import RigFrames

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: This is the 0.95 quantile of chi-square with 3 degrees of freedom.
CHI2_95 = 7.814727903251179
#: A frame's axes have this length, as a share of the scene.
AXIS_SHARE = 0.1
#: The largest ellipsoid's semi-axis has this length, as a share of the scene.
ELLIPSE_SHARE = 0.07
#: The room around the scene is this share of it.
MARGIN_SHARE = 0.1
#: The carrier's origin is left out when its distance is more than this many times the spread of the frames.
FAR_ORIGIN = 5.0
#: Frames with a smaller spread (m) are drawn as if they were in one place.
SMALLEST_M = 1e-6
#: The names have this size, in points.
NAME_SIZE = 8.5
#: textalloc tries this many places for each name.
PLACES = 500


def plot_frames(frames: RigFrames, covariances: Mapping[str, Array], path: str | Path) -> None:
    """Draw sensors on their carrier and targets on theirs, each from two sides, with 95 % ellipsoids of position.

    Parameters
    ----------
    frames : RigFrames
    covariances : dict of str to (6, 6) array
        Covariance of T_carrier_frame's right perturbation [omega (rad), v (m)], by frame. A frame may lack one. Entries
        may be infinite.
    path
        The PNG file. An existing file is replaced.

    Raises
    ------
    NoiseError
        A covariance has another shape or negative variances.
    FileFormatError
        The file cannot be written.
    """
    rows = (("Sensors", frames.sensor_carrier, frames.sensors), ("Targets", frames.target_carrier, frames.targets))
    scenes = []
    with picture(path, 12.0, 10.0) as figure:
        for (what, carrier, poses), row in zip(rows, figure.subplots(2, 2), strict=True):
            known = {name: T for name, T in poses.items() if name in covariances}
            scene = _Scene(carrier, poses, {name: _of_position(T, covariances[name]) for name, T in known.items()})
            if poses:
                scenes += [(scene, axes, view) for axes, view in zip(row, scene.views, strict=True)]
            else:
                say(row[0], f"no {what.lower()}")
                row[1].set_axis_off()
            row[0].set_title(f"{what} on {carrier}{scene.note}", size=12, pad=24)
        for scene, axes, view in scenes:
            scene.draw(axes, view)
        _legend(figure, [covariance for scene, *_ in scenes for covariance in scene.covariances.values()])
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # The layout is settled: names must not change it.
        for scene, axes, view in scenes:
            scene.draw_names(axes, view)


class _Scene:
    """One carrier and the frames that it carries."""

    def __init__(self, carrier: str, poses: Mapping[str, Array], covariances: Mapping[str, Array]) -> None:
        self.carrier, self.poses, self.covariances = carrier, poses, covariances
        places = np.array([T[:3, 3] for T in poses.values()]).reshape(-1, 3)
        middle = places.mean(axis=0) if len(places) else np.zeros(3)
        spread = float(np.ptp(places, axis=0).max()) if len(places) > 1 else 0.0
        self.has_origin = spread == 0.0 or bool(np.linalg.norm(middle) <= FAR_ORIGIN * spread)
        if self.has_origin:
            places = np.vstack([places, np.zeros(3)])
        sides = np.ptp(places, axis=0)
        # An undetermined scale can draw all frames together into one place.
        self.extent = float(sides.max()) if sides.max() > SMALLEST_M else 0.1
        #: The view from above, and the side view that shows more.
        self.views = ((0, 1), (0, 2) if sides[0] >= sides[1] else (1, 2))
        finite = [covariance for covariance in covariances.values() if _is_finite(covariance)]
        largest = max((np.sqrt(CHI2_95 * np.linalg.norm(covariance, 2)) for covariance in finite), default=0.0)
        self.times = round_down(max(ELLIPSE_SHARE * self.extent / largest, 1.0)) if largest > 0.0 else 1.0

    @property
    def note(self) -> str:
        """How large the ellipsoids are drawn, and whether the origin is in the picture."""
        notes = []
        if any(map(_is_finite, self.covariances.values())):
            size = f"drawn {self.times:,.0f} times as large" if self.times > 1.0 else "to scale"
            notes.append(f"95 % confidence ellipsoids of position, {size}")
        if not self.has_origin:
            notes.append(f"the origin of {self.carrier} is out of sight")
        return "".join(f"; {note}" for note in notes)

    def draw(self, axes: Axes, view: tuple[int, int]) -> None:
        """Draw one view, without names."""
        from matplotlib.patches import Polygon
        from matplotlib.ticker import MultipleLocator

        i, j = view
        length = AXIS_SHARE * self.extent
        if self.has_origin:
            _draw_axes(axes, np.eye(4), view, 0.7 * length, 3.0)
            axes.plot(0.0, 0.0, "s", color=BLACK, markersize=5, zorder=4)
        for name, T in self.poses.items():
            at, covariance = T[[i, j], 3], self.covariances.get(name)
            _draw_axes(axes, T, view, length, 1.6)
            axes.plot(*at, "o", color=BLACK, markersize=3, zorder=5)
            if covariance is None:
                continue
            if _is_finite(covariance):
                outline = at + self.times * _shadow(covariance[np.ix_(view, view)])
                axes.add_patch(Polygon(outline, facecolor=ORANGE, edgecolor=BLACK, alpha=0.45, lw=0.8, zorder=2))
            else:
                outline = at + ELLIPSE_SHARE * self.extent * _circle()
                axes.add_patch(Polygon(outline, fill=False, edgecolor=PURPLE, lw=1.6, ls="--", zorder=2))
        axes.set_aspect("equal", adjustable="datalim")
        # The data limits are padded, because matplotlib removes margins of axes to make the aspect equal.
        axes.update_datalim(axes.dataLim.padded(MARGIN_SHARE * self.extent))
        axes.margins(0.0)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MultipleLocator(round_down(0.35 * self.extent)))
        axes.text(0.0, 1.02, "from above" if view == (0, 1) else "from the side", transform=axes.transAxes, size=10.5)
        axes.set_xlabel(f"{AXIS_NAMES[i]} of {self.carrier} (m)")
        axes.set_ylabel(f"{AXIS_NAMES[j]} of {self.carrier} (m)")

    def draw_names(self, axes: Axes, view: tuple[int, int]) -> None:
        """Write the frames' names beside their origins, clear of each other and of everything drawn."""
        origin = {self.carrier: np.eye(4)} if self.has_origin else {}
        names = [shortened(name) for name in (*origin, *self.poses)]
        points = np.array([T[list(view), 3] for T in (*origin.values(), *self.poses.values())])
        write_names(axes, points, names)


def write_names(axes: Axes, points: Array, names: list[str]) -> None:
    """Write names beside points (N, 2), data coordinates, clear of each other and of the lines and patches drawn.

    The layout and the limits of the axes must be settled (``figure.draw_without_rendering``).
    """
    import textalloc

    axes.autoscale(enable=False)
    lines = [np.asarray(line.get_path().vertices) for line in axes.lines]
    outlines = [np.asarray(patch.get_path().vertices) for patch in axes.patches]
    x, y = np.concatenate([points, *lines, *outlines]).T
    textalloc.allocate(
        axes, points[:, 0], points[:, 1], names, x_scatter=x, y_scatter=y, x_lines=[line[:, 0] for line in lines],
        y_lines=[line[:, 1] for line in lines], textsize=NAME_SIZE, nbr_candidates=PLACES,
        linecolor=GREY, linewidth=0.6, zorder=6,
    )  # fmt: skip


def _draw_axes(axes: Axes, T: Array, view: tuple[int, int], length: float, width: float) -> None:
    """Draw a frame's three axes; the axis nearest to the eye comes last, on top."""
    towards_eye = T[3 - sum(view), :3]
    for k in np.argsort(towards_eye):
        start, step = T[list(view), 3], length * T[list(view), k]
        axes.plot(*np.array([start, start + step]).T, color=AXIS_COLOURS[k], lw=width, solid_capstyle="round", zorder=3)


def _legend(figure: Figure, covariances: list[Array]) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Artist] = [
        Line2D([], [], color=colour, lw=2, label=f"{name} axis")
        for name, colour in zip(AXIS_NAMES, AXIS_COLOURS, strict=True)
    ]
    determined = [_is_finite(covariance) for covariance in covariances]
    if any(determined):
        handles.append(Patch(facecolor=ORANGE, edgecolor=BLACK, alpha=0.45, label="95 % confidence"))
    if not all(determined):
        handles.append(Line2D([], [], color=PURPLE, ls="--", lw=1.6, label="position not determined"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))


def _of_position(T: Array, covariance: Array) -> Array:
    """Covariance (3, 3) of the position along the carrier's axes; infinite if a direction is not determined."""
    block = checked(covariance)[3:, 3:]
    if not np.isfinite(block).all():
        return np.full((3, 3), np.inf)
    turned: Array = T[:3, :3] @ block @ T[:3, :3].T
    return turned


def _is_finite(covariance: Array) -> bool:
    return bool(np.isfinite(covariance).all())


def _shadow(covariance: Array) -> Array:
    """Outline (N, 2) of the ellipsoid's shadow along an axis; `covariance` is the (2, 2) block that is left."""
    variances, axes = np.linalg.eigh(covariance)
    outline: Array = _circle() * np.sqrt(CHI2_95 * np.maximum(variances, 0.0)) @ axes.T
    return outline


def _circle() -> Array:
    """Points (N, 2) of the unit circle."""
    turn = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    return np.column_stack([np.cos(turn), np.sin(turn)])
