"""Section 2: the rig in space, and in numbers where its frames are and from where they were seen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.files.terminal_text import counted
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.figures import (
    AXIS_COLOURS,
    AXIS_NAMES,
    GREY,
    INK,
    ORANGE,
    PURPLE,
    SKY,
    VIEW_COLOURS,
    shortened,
    svg_figure,
)
from gtsam_rwhec.report.report_blocks import Block, Drawing, Listing, Paragraph, Section, Table, Words, worded
from gtsam_rwhec.report.scene_model import (
    MANY,
    Line,
    PlacedBoard,
    Scene,
    carrier,
    labels_of,
    lines_of,
    objects_of,
    scene_of_carrier,
    scene_of_clouds,
    scene_of_rig,
)
from gtsam_rwhec.report.scene_plotly import DARK, EARLY, LATE, MOST_NAMES, PAPER, first_view, layout_of, traces_of
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.results.scene_evidence import SceneEvidence

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TITLE = "The rig in 3D"
WITHOUT_PATH = (
    "Not shown: how the two carriers stand to each other, boards, views and path, for the result has no evidence.json "
    "beside it with measurements. Each carrier is drawn alone."
)
#: One point of so many of a view is drawn beside the whole rig.
FEWER = 5
#: A target is said to be farther off the axis by the poses than as measured above this, degrees.
OFF_DEG = 5.0


def scene_section(shown: ShownResult) -> Section:
    """The drawing, the directions in it as a list, and what it shows in numbers."""
    if shown.result is None:
        return Section("scene", TITLE, missing="the calibration has no answer, and so no poses to draw.")
    evidence = None if shown.evidence is None else shown.evidence.scene
    blocks: list[Block] = []
    if evidence is not None:
        scene = scene_of_rig(shown, evidence)
        lines = lines_of(shown, scene)
        coarse = replace(scene, clouds=tuple((name, points[::FEWER]) for name, points in scene.clouds))
        blocks += [_drawing("rig", "The rig", coarse, lines, _about_rig(evidence, scene, lines)), *_list_of(lines)]
        if scene.clouds:
            assert shown.evidence is not None
            assert shown.evidence.clouds is not None
            near, of = scene_of_clouds(scene), shown.evidence.clouds.of
            says = f"The clouds of {len(scene.clouds)} of {of} views, each in its colour, where the calibrated poses "
            says += "put them: where these are right, they lie on one surface."
            blocks.append(_drawing("clouds", "The clouds in one frame", near, (), says))
        blocks += [*_facts(shown, evidence), *_turned_away(shown, evidence), *_heights(shown)]
        return Section("scene", TITLE, tuple(blocks))
    for kind in ("targets", "sensors"):
        if not shown.tree[kind]:
            continue
        scene = scene_of_carrier(shown, kind)
        lines = lines_of(shown, scene)
        says = (
            f"{counted(len(shown.tree[kind]), kind[:-1])} on {scene.world}, in its axes. {_of_ellipsoids(scene, lines)}"
        )
        blocks += [_drawing(kind, f"The {kind}", scene, lines, says), *_list_of(lines)]
    return Section("scene", TITLE, (*blocks, Paragraph(WITHOUT_PATH, "absent"), *_heights(shown)))


def _drawing(name: str, title: str, scene: Scene, lines: tuple[Line, ...], says: str) -> Drawing:
    traces = traces_of(scene, lines)
    still = svg_figure(lambda figure: _draw(figure, scene, lines), HEIGHT_IN, WIDTH_IN)
    return Drawing(f"scene-{name}", title, says, traces, layout_of(scene, traces), still)


def _about_rig(evidence: SceneEvidence, scene: Scene, lines: tuple[Line, ...]) -> str:
    """What is drawn, and how."""
    poses = f"its path in {evidence.of} poses"
    if evidence.of > len(evidence.poses):
        poses += f", of which {len(evidence.poses)} are drawn"
    stands = f"{scene.world} stands still here" + ("" if evidence.why.startswith("by") else f" ({evidence.why})")
    says = f"{stands}; {scene.moving} is at the typical one of its poses, with {poses}. "
    if scene.views:
        says += "Cameras' views reach as far as the typical distance of what they saw. "
    if scene.clouds:
        says += "The points are clouds of the sensors, each view in its colour. "
    if scene.boards and any(one.board is None for one in evidence.targets.values()):
        says += "Squares stand for targets whose shape the result's inputs do not state. "
    return says + _of_ellipsoids(scene, lines)


def _of_ellipsoids(scene: Scene, lines: tuple[Line, ...]) -> str:
    says = []
    if scene.ellipsoids:
        larger = f"all drawn {scene.times:,.0f} times as large" if scene.times > 1.0 else "drawn to scale"
        says.append(f"Ellipsoids hold the true position with 95 % probability, {larger}.")
    else:
        known = any(frame.covariance is not None for frame in scene.frames)
        has_deviations = any(words.startswith("±") for frame in scene.frames for words in frame.words)
        if known:
            says.append("No ellipsoid fits into the scene.")
        elif has_deviations:
            says.append("No position is known in all directions, and so there are no ellipsoids.")
        else:
            says.append("There are no covariances, and so no ellipsoids.")
    if any(line.is_free for line in lines):
        says.append("Dashed lines: directions that the measurements leave free.")
    if any(not line.is_free for line in lines):
        says.append("Solid purple lines: directions known far less well than the others.")
    if scene.has_many:
        says.append(f"Of more than {MANY} frames, targets are drawn without axes and ellipsoids.")
    if scene.out_of_sight:
        says.append(f"The origin of {', '.join(scene.out_of_sight)} is too far away to be in sight.")
    return " ".join(says)


def _list_of(lines: tuple[Line, ...]) -> list[Block]:
    """Each direction once, with its label in the drawing."""
    said = {line.label: f"{line.label}: {line.words}" for line in lines}
    return [Listing(tuple(said.values()))] if said else []


def _facts(shown: ShownResult, evidence: SceneEvidence) -> Iterator[Block]:
    """Where sensors saw their targets, in numbers."""
    rows: list[tuple[Words, ...]] = []
    for name, seen in evidence.sensors.items():
        if seen.distance_m is not None:
            at = ("scene", "sensors", name)
            rows.append(
                (
                    name,
                    shown.evident(*at, "measurements", spec=".0f"),
                    *shown.evidents(*at, "distance_m", spec=".2f"),
                    *shown.evidents(*at, "off_axis_deg", spec=".1f"),
                    *shown.evidents(*at, "off_axis_by_poses_deg", spec=".1f"),
                    shown.evident(*at, "behind", spec=".0f"),
                )
            )
    if rows:
        yield Table(
            "Where each sensor saw its targets",
            ("sensor", "seen", "nearest m", "median m", "farthest m", "off axis, median°", "largest°",
             "by the poses, median°", "largest°", "behind"),
            tuple(rows),
            "Off axis: the angle between the sensor's z axis, which is a camera's optical axis, and the target's "
            "origin, as measured, and as the calibrated poses have it. Behind: targets measured at z below 0.",
        )  # fmt: skip


def _turned_away(shown: ShownResult, evidence: SceneEvidence) -> Iterator[Block]:
    """Sensors for which the poses have targets elsewhere than the measurements."""
    said: list[Words] = []
    for name, seen in evidence.sensors.items():
        if seen.off_axis_deg is None or seen.off_axis_by_poses_deg is None:
            continue
        if seen.off_axis_by_poses_deg[1] > seen.off_axis_deg[1] + OFF_DEG:
            by_poses, measured = (
                shown.evident("scene", "sensors", name, field, 1, spec=".0f")
                for field in ("off_axis_by_poses_deg", "off_axis_deg")
            )
            words = (
                "By the poses, targets that {name} saw are up to {by_poses}° off its z axis; as measured, at most "
                "{measured}°."
            )
            said.append(worded(words, name=name, by_poses=by_poses, measured=measured))
    if said:
        yield Listing(tuple(said))


def _heights(shown: ShownResult) -> list[Block]:
    """Height and tilt of each target on its carrier."""
    rows = shown.tree["targets"]
    if not rows:
        return []
    where = carrier(shown, "targets")
    evidence = None if shown.evidence is None else shown.evidence.scene
    found: list[tuple[Words, ...]] = []
    for i, row in enumerate(rows):
        name = row["child"]
        cells: list[Words] = [name, *shown.numbers("targets", i, "translation_m", spec=".3f")[:2]]
        cells.append(shown.number("targets", i, "translation_m", 2, times=1e3, spec=".1f"))
        seen = None if evidence is None else evidence.targets.get(name)
        if evidence is not None:
            at = ("scene", "targets", name)
            cells.append("-" if seen is None else shown.evident(*at, "tilt_deg", spec=".1f"))
            has_view = seen is not None and seen.oblique_deg is not None
            cells += shown.evidents(*at, "oblique_deg", spec=".0f") if has_view else ("-", "-")
            unknown = "an object" if name in objects_of(shown) else "not known"
            cells.append(unknown if seen is None or seen.board is None else seen.board.words)
        found.append(tuple(cells))
    more = () if evidence is None else ("tilt°", "seen from, median°", "largest°", "what it is")
    legend = f"Above: along the z axis of {where}."
    if evidence is not None:
        legend += (
            f" Tilt: the angle between the target's z axis and that of {where}. Seen "
            "from: the angle between the target's z axis and the direction to the sensor, by the poses; near "
            "180° for detectors whose z axis goes into the paper."
        )
    title = f"Where the targets are on {where}"
    return [Table(title, ("target", "x m", "y m", "above mm", *more), tuple(found), legend)]


WIDTH_IN, HEIGHT_IN = 7.0, 5.6


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
    boards = sorted(scene.boards, key=lambda one: float(np.concatenate([one.paper, *one.dark]).mean(axis=0) @ eye))
    parts = [part for board in boards for part in _parts(board, eye)]  # the nearest last
    if parts:
        polygons, colours, widths = zip(*((p @ P.T, colour, width) for p, colour, width in parts), strict=True)
        axes.add_collection(PolyCollection(polygons, facecolors=colours, edgecolors=GREY, linewidths=widths, zorder=1))
    for view in scene.views:
        axes.add_collection(LineCollection([edge @ P.T for edge in view.edges], colors=SKY, linewidths=0.9, zorder=2))
    size = 1.5 if len(scene.path) else 3.0
    for (_, points), colour in zip(scene.clouds, cycle(VIEW_COLOURS), strict=False):
        within = ((points > scene.low) & (points < scene.high)).all(axis=1)
        axes.plot(*(points[within] @ P.T).T, ".", color=colour, markersize=size, markeredgewidth=0, rasterized=True)
    if len(scene.path):
        shades = LinearSegmentedColormap.from_list("path", [EARLY, LATE])
        x, y = P @ scene.path[:, :3].T
        axes.scatter(x, y, c=np.arange(len(scene.path)), cmap=shades, s=5, zorder=2)
    _ellipsoids(axes, scene, P)
    for k, colour in enumerate(AXIS_COLOURS):
        strokes = [stroke @ P.T for stroke in scene.axes(k)]
        axes.add_collection(LineCollection(strokes, colors=colour, linewidths=1.6, zorder=4))
    places = np.array([frame.T[:3, 3] for frame in scene.frames]).reshape(-1, 3) @ P.T
    axes.plot(*places.T, "o", color=INK, markersize=2.5, zorder=5)
    for line in lines:
        first, *heads = (piece @ P.T for piece in line.pieces)
        axes.plot(*first.T, color=PURPLE, lw=1.6, ls="--" if line.is_free else "-", zorder=6)
        axes.add_collection(LineCollection(heads, colors=PURPLE, linewidths=1.4, zorder=6))
    said = {label: at @ P.T for label, at in labels_of(lines).items()}
    named = {f.name: at for f, at in zip(scene.frames, places, strict=True)} if len(scene.frames) <= MOST_NAMES else {}
    for words, colour in ((named, INK), (said, PURPLE)):
        for name, at in words.items():
            axes.annotate(
                shortened(name), tuple(at), (8, 9), textcoords="offset points", size=8.5, color=colour, zorder=7
            )
    corners = np.array(np.meshgrid(*zip(scene.low, scene.high, strict=True))).reshape(3, -1).T @ P.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    _legend(figure, scene, lines)


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
    for (name, _), colour in zip(scene.clouds, cycle(VIEW_COLOURS), strict=False):
        handles.append(Line2D([], [], color=colour, marker="o", ls="", markersize=3, label=shortened(name, 20)))
    if scene.ellipsoids:
        larger = f" x {scene.times:,.0f}" if scene.times > 1.0 else ""
        handles.append(Patch(facecolor=ORANGE, alpha=0.45, label=f"95 % ellipsoids{larger}"))
    for is_free, words in ((True, "free directions"), (False, "weak directions")):
        if any(line.is_free == is_free for line in lines):
            handles.append(Line2D([], [], color=PURPLE, lw=1.6, ls="--" if is_free else "-", label=words))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8.5)
