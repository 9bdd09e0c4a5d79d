"""A scene as a still picture for paper: the first view without perspective, what is farther drawn first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.page.figures import INK, SvgFigure, svg_figure
from gtsam_rwhec.report.page.scene.directions import Line
from gtsam_rwhec.report.page.scene.layout import first_view
from gtsam_rwhec.report.page.scene.model import MANY, PlacedBoard, Scene
from gtsam_rwhec.report.page.scene.traces import DARK, EARLY, LATE, MOST_NAMES, PAPER
from gtsam_rwhec.report.plots.drawing import AXIS_COLOURS, AXIS_NAMES, GREY, ORANGE, PURPLE, SKY, shortened

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN, HEIGHT_IN = 7.0, 5.6


def still_of(scene: Scene, lines: Sequence[Line]) -> SvgFigure:
    """The picture."""
    return svg_figure(lambda figure: _draw(figure, scene, lines), HEIGHT_IN, WIDTH_IN)


def projection(scene: Scene) -> Array:
    """(2, 3): right and up of the picture in the scene's axes."""
    eye = first_view(scene)
    right = np.cross([0.0, 0.0, 1.0], eye)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(eye, right)])


def _draw(figure: Figure, scene: Scene, lines: Sequence[Line]) -> None:
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.colors import LinearSegmentedColormap

    axes = figure.subplots()
    axes.set_axis_off()
    axes.set_aspect("equal")
    P, eye = projection(scene), first_view(scene)
    parts = [part for board in sorted(scene.boards, key=lambda one: _depth(one, eye)) for part in _parts(board, eye)]
    if parts:
        polygons, colours, widths = zip(*((p @ P.T, colour, width) for p, colour, width in parts), strict=True)
        axes.add_collection(PolyCollection(polygons, facecolors=colours, edgecolors=GREY, linewidths=widths, zorder=1))
    for view in scene.views:
        step = len(view.rim) // 4
        rim = np.vstack([view.rim, view.rim[:1]])
        edges = [rim, *(np.array([view.apex, corner]) for corner in view.rim[::step])]
        axes.add_collection(LineCollection([edge @ P.T for edge in edges], colors=SKY, linewidths=0.9, zorder=2))
    if len(scene.path):
        shades = LinearSegmentedColormap.from_list("path", [EARLY, LATE])
        x, y = P @ scene.path[:, :3].T
        axes.scatter(x, y, c=np.arange(len(scene.path)), cmap=shades, s=5, zorder=2)
    _ellipsoids(axes, scene, P)
    lengths = scene.axes_m
    for k, colour in enumerate(AXIS_COLOURS):
        strokes = [
            np.array([f.T[:3, 3], f.T[:3, 3] + lengths[f.kind] * f.T[:3, k]]) @ P.T
            for f in scene.frames
            if not (len(scene.frames) > MANY and f.kind == "target")
        ]
        axes.add_collection(LineCollection(strokes, colors=colour, linewidths=1.6, zorder=4))
    places = np.array([frame.T[:3, 3] for frame in scene.frames]) @ P.T
    axes.plot(*places.T, "o", color=INK, markersize=2.5, zorder=5)
    for line in lines:
        first, *heads = (piece @ P.T for piece in line.pieces)
        axes.plot(*first.T, color=PURPLE, lw=1.6, ls="--" if line.is_free else "-", zorder=6)
        axes.add_collection(LineCollection(heads, colors=PURPLE, linewidths=1.4, zorder=6))
    said = {line.label: line.pieces[0][1] @ P.T for line in reversed(lines) if line.label != line.frame}
    named = {f.name: at for f, at in zip(scene.frames, places, strict=True)} if len(scene.frames) <= MOST_NAMES else {}
    for words, colour in ((named, INK), (said, PURPLE)):
        for name, at in words.items():
            axes.annotate(shortened(name), at, (8, 9), textcoords="offset points", size=8.5, color=colour, zorder=7)
    corners = np.array(np.meshgrid(*zip(scene.low, scene.high, strict=True))).reshape(3, -1).T @ P.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    _legend(figure, scene, lines)


def _depth(board: PlacedBoard, eye: Array) -> float:
    """How near a board is to the eye."""
    return float(np.concatenate([board.paper, *board.dark]).mean(axis=0) @ eye)


def _parts(board: PlacedBoard, eye: Array) -> Iterator[tuple[Array, str, float]]:
    """What is seen of a board, with its colour and the width of its edge: from behind, the paper alone."""
    dark = np.concatenate(board.dark) if board.dark else np.zeros((0, 3))
    if len(board.paper):
        yield board.paper, PAPER, 0.6
        normal = np.cross(board.paper[1] - board.paper[0], board.paper[2] - board.paper[0])
        if len(dark) and ((dark.mean(axis=0) - board.paper.mean(axis=0)) @ normal) * (normal @ eye) < 0.0:
            return
    yield from ((part, DARK, 0.0) for part in board.dark)


def _ellipsoids(axes: Axes, scene: Scene, P: Array) -> None:
    """The outlines of the ellipsoids: their shadows along the view."""
    from matplotlib.patches import Polygon

    turn = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    shapes = scene.ellipsoids
    for frame in scene.frames:
        if frame.name in shapes:
            variances, vectors = np.linalg.eigh(P @ shapes[frame.name] @ P.T)
            outline = P @ frame.T[:3, 3] + circle * np.sqrt(np.maximum(variances, 0.0)) @ vectors.T
            axes.add_patch(Polygon(outline, facecolor=ORANGE, edgecolor=ORANGE, alpha=0.45, lw=0.8, zorder=3))


def _legend(figure: Figure, scene: Scene, lines: Sequence[Line]) -> None:
    from matplotlib.artist import Artist
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Artist] = [
        Line2D([], [], color=colour, lw=2, label=f"{name} axes")
        for name, colour in zip(AXIS_NAMES, AXIS_COLOURS, strict=True)
    ]
    if scene.views:
        handles.append(Line2D([], [], color=SKY, lw=1.2, label="cameras' views"))
    if len(scene.path):
        handles.append(
            Line2D([], [], color=LATE, marker="o", ls="", markersize=3, label=f"path of {shortened(scene.moving, 20)}")
        )
    if scene.ellipsoids:
        larger = f" x {scene.times:,.0f}" if scene.times > 1.0 else ""
        handles.append(Patch(facecolor=ORANGE, alpha=0.45, label=f"95 % ellipsoids{larger}"))
    for is_free, words in ((True, "free directions"), (False, "weak directions")):
        if any(line.is_free == is_free for line in lines):
            handles.append(Line2D([], [], color=PURPLE, lw=1.6, ls="--" if is_free else "-", label=words))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8.5)
