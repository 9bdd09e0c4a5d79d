"""Where the frames are on their carriers, seen from above and from the side, with how well their places are known."""

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
    ORANGE,
    PURPLE,
    picture,
    round_down,
    say,
    shortened,
)
from gtsam_rwhec.report.plots.labels import label_points
from gtsam_rwhec.rig.calibrated_frames import RigFrames

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Quantile 0.95 of chi-square with 3 degrees of freedom.
CHI2_95 = 7.814727903251179
#: Shares of the picture: a frame's axes; the largest ellipse.
AXIS_SHARE, ELLIPSE_SHARE = 0.1, 0.07
#: The carrier's origin is left out when it is this many times further away than the frames are spread.
FAR_ORIGIN = 5.0
#: Frames that are spread over less are drawn as if they were in one place.
SMALLEST_M = 1e-6


def plot_frames(frames: RigFrames, covariances: Mapping[str, Array], path: str | Path) -> None:
    """Draw sensors on their carrier and targets on theirs, each from two sides, with 95 % ellipsoids of position.

    Parameters
    ----------
    frames : RigFrames
    covariances : dict of str to (6, 6) array
        Of T_carrier_frame's right perturbation [omega (rad), v (m)], by frame; a frame may lack one, entries may be
        infinite.
    path
        The PNG; replaced if it is there.

    Raises
    ------
    NoiseError
        A covariance has another shape or negative variances.
    FileFormatError
        The file cannot be written.
    """
    with picture(path, 12.0, 10.0) as figure:
        rows = (("Sensors", frames.sensor_carrier, frames.sensors), ("Targets", frames.target_carrier, frames.targets))
        drawn = []
        halves = figure.subfigures(2, 1, squeeze=False)[:, 0]
        for row, (what, carrier, poses) in zip(halves, rows, strict=True):
            positions = {name: _position_covariance(T, covariances.get(name)) for name, T in poses.items()}
            scene = _Scene(carrier, dict(poses), positions)
            row.suptitle(f"{what} on {carrier}{scene.note}", x=0.01, ha="left")
            if not poses:
                say(row.subplots(), f"no {what.lower()}")
                continue
            for axes, view in zip(row.subplots(1, 2), scene.views, strict=True):
                drawn.append((axes, *scene.draw(axes, view)))
        _legend(figure, {name: covariances[name] for _, _, poses in rows for name in poses if name in covariances})
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # settled; names need not be laid out again
        for axes, points, names, clear_of in drawn:
            label_points(axes, points, [shortened(name) for name in names], clear_of)


class _Scene:
    """One carrier with what it carries."""

    def __init__(self, carrier: str, poses: dict[str, Array], covariances: dict[str, Array | None]) -> None:
        self.carrier, self.poses, self.covariances = carrier, poses, covariances
        places = np.array([T[:3, 3] for T in poses.values()]).reshape(-1, 3)
        middle = places.mean(axis=0) if len(places) else np.zeros(3)
        spread = float(np.ptp(places, axis=0).max()) if len(places) > 1 else 0.0
        self.has_origin = spread == 0.0 or bool(np.linalg.norm(middle) <= FAR_ORIGIN * spread)
        if self.has_origin:
            places = np.vstack([places, np.zeros(3)])
        sides = np.ptp(places, axis=0)
        # A scale that nothing determines can draw all frames together into one place.
        self.extent = float(sides.max()) if sides.max() > SMALLEST_M else 0.1
        #: Above, and the side that shows more.
        self.views = ((0, 1), (0, 2) if sides[0] >= sides[1] else (1, 2))
        largest = max((_semi_axes(c).max() for c in covariances.values() if _is_finite(c)), default=0.0)
        self.times = round_down(max(ELLIPSE_SHARE * self.extent / largest, 1.0)) if largest > 0.0 else 1.0

    @property
    def note(self) -> str:
        """What is to be known of the drawing."""
        notes = []
        if any(_is_finite(c) for c in self.covariances.values()):
            size = f"drawn {self.times:,.0f} times as large" if self.times > 1.0 else "to scale"
            notes.append(f"95 % confidence ellipsoids of position, {size}")
        if not self.has_origin:
            notes.append(f"the origin of {self.carrier} is out of sight")
        return "".join(f"; {note}" for note in notes)

    def draw(self, axes: Axes, view: tuple[int, int]) -> tuple[Array, list[str], Array]:
        """Draw one view; points to be labelled (N, 2), their names, and points (M, 2) to be left clear."""
        from matplotlib.patches import Polygon
        from matplotlib.ticker import MultipleLocator

        i, j = view
        length = AXIS_SHARE * self.extent
        points: list[Array] = []
        names: list[str] = []
        clear_of: list[Array] = []
        if self.has_origin:
            clear_of.append(_draw_axes(axes, np.eye(4), view, 0.7 * length, 3.0))
            axes.plot(0.0, 0.0, "s", color=BLACK, markersize=5, zorder=4)
            points.append(np.zeros(2))
            names.append(self.carrier)
        for name, T in self.poses.items():
            at, covariance = T[[i, j], 3], self.covariances[name]
            clear_of.append(_draw_axes(axes, T, view, length, 1.6))
            axes.plot(*at, "o", color=BLACK, markersize=3, zorder=5)
            points.append(at)
            names.append(name)
            if covariance is None:
                continue
            if _is_finite(covariance):
                outline = at + self.times * _shadow(covariance[np.ix_(view, view)])
                axes.add_patch(Polygon(outline, facecolor=ORANGE, edgecolor=BLACK, alpha=0.45, lw=0.8, zorder=2))
            else:
                outline = at + ELLIPSE_SHARE * self.extent * _circle()
                axes.add_patch(Polygon(outline, fill=False, edgecolor=PURPLE, lw=1.6, ls="--", zorder=2))
            clear_of.append(outline[::2])
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.14)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MultipleLocator(round_down(0.35 * self.extent)))
        axes.set_title("from above" if view == (0, 1) else "from the side")
        axes.set_xlabel(f"{AXIS_NAMES[i]} of {self.carrier} (m)")
        axes.set_ylabel(f"{AXIS_NAMES[j]} of {self.carrier} (m)")
        return np.array(points), names, np.concatenate(clear_of)


def _draw_axes(axes: Axes, T: Array, view: tuple[int, int], length: float, width: float) -> Array:
    """A frame's three axes; points (M, 2) along them. The one that is nearest to the eye comes last, on top."""
    towards_eye = T[3 - sum(view), :3]
    along = []
    for k in np.argsort(towards_eye):
        start, step = T[list(view), 3], length * T[list(view), k]
        axes.plot(*np.array([start, start + step]).T, color=AXIS_COLOURS[k], lw=width, solid_capstyle="round", zorder=3)
        along.append(start + np.linspace(0.1, 1.0, 10)[:, None] * step)
    return np.concatenate(along)


def _legend(figure: Figure, covariances: Mapping[str, Array]) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Artist] = [
        Line2D([], [], color=colour, lw=2, label=f"{name} axis")
        for name, colour in zip(AXIS_NAMES, AXIS_COLOURS, strict=True)
    ]
    determined = [bool(np.isfinite(covariance[3:, 3:]).all()) for covariance in covariances.values()]
    if any(determined):
        handles.append(Patch(facecolor=ORANGE, edgecolor=BLACK, alpha=0.45, label="95 % confidence"))
    if not all(determined):
        handles.append(Line2D([], [], color=PURPLE, ls="--", lw=1.6, label="position not determined"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))


def _position_covariance(T: Array, covariance: Array | None) -> Array | None:
    """(3, 3) of the position along the carrier's axes; infinite where any direction of it is."""
    if covariance is None:
        return None
    block = checked(covariance)[3:, 3:]
    if not np.isfinite(block).all():
        return np.full((3, 3), np.inf)
    turned: Array = T[:3, :3] @ block @ T[:3, :3].T
    return turned


def _is_finite(covariance: Array | None) -> bool:
    return covariance is not None and bool(np.isfinite(covariance).all())


def _semi_axes(covariance: Array | None) -> Array:
    assert covariance is not None
    semi_axes: Array = np.sqrt(CHI2_95 * np.maximum(np.linalg.eigvalsh(covariance), 0.0))
    return semi_axes


def _shadow(covariance: Array) -> Array:
    """(N, 2) outline of the ellipsoid's shadow along an axis, of the (2, 2) block that is left."""
    variances, axes = np.linalg.eigh(covariance)
    outline: Array = _circle() * np.sqrt(CHI2_95 * np.maximum(variances, 0.0)) @ axes.T
    return outline


def _circle() -> Array:
    """(N, 2) points of the unit circle."""
    turn = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    return np.column_stack([np.cos(turn), np.sin(turn)])
