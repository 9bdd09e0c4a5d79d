"""A scene as traces of plotly: few, with many pieces each, in groups that buttons and the legend show and hide."""

from __future__ import annotations

import html
from collections.abc import Iterator, Sequence
from functools import cache
from itertools import combinations, cycle
from typing import Any

import numpy as np

from gtsam_rwhec.files.terminal_text import printable
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.figures import AXIS_COLOURS, AXIS_NAMES, GREY, INK, ORANGE, PURPLE, SKY, VIEW_COLOURS, shortened
from gtsam_rwhec.report.scene_model import Line, Scene, labels_of

#: With more names than this, they are seen on request only.
MOST_NAMES = 16
#: Boards' paper and dark parts: both are told from a white page and from a dark one.
PAPER, DARK = "#CFD4DA", "#20242A"
#: The path goes from the first colour to the last one.
EARLY, LATE = "#3B76C4", "#E69F00"
#: Decimals of frames' places (metres), and significant digits of what is drawn around them.
EXACT, DIGITS = 10, 5
#: Names stand on different sides of their frames, one after the other, as neighbours are often near.
TEXTS = ("bottom center", "top right", "bottom right", "top left", "bottom left")
#: A sentence has at most this many characters beside the pointer; the list below the scene has all of it.
LONGEST = 120
#: Flat colours, whatever the light.
FLAT = {"ambient": 1.0, "diffuse": 0.0, "specular": 0.0, "fresnel": 0.0}
Trace = dict[str, Any]


def traces_of(scene: Scene, lines: Sequence[Line]) -> tuple[Trace, ...]:
    """The traces; ``meta`` has the group of each."""
    of_scene = (_boards, _clouds, _views, _path, _ellipsoids, _axes, _origins)
    traces = [trace for made in of_scene for trace in made(scene)]
    return (*traces, *_lines(scene, lines), *_names(scene, lines))


def _boards(scene: Scene) -> Iterator[Trace]:
    paper = [board.paper for board in scene.boards if len(board.paper)]
    dark = [part for board in scene.boards for part in board.dark]
    for name, polygons, colour in (("boards", paper, PAPER), ("boards, dark", dark, DARK)):
        if polygons:
            yield _mesh("boards", name, *_fans(polygons), scene, colour=colour, lighting=FLAT, showlegend=False)
    if paper and not scene.has_many:
        closed = [np.vstack([polygon, polygon[:1]]) for polygon in paper]
        yield _strokes("boards", "boards, edges", closed, scene, colour=GREY, width=2, showlegend=False)


def _clouds(scene: Scene) -> Iterator[Trace]:
    size = 1.5 if len(scene.path) else 1.2
    for (name, points), colour in zip(scene.clouds, cycle(VIEW_COLOURS), strict=False):
        marker = {"size": size, "color": colour, "opacity": 0.8}
        yield _trace(
            "scatter3d", "clouds", _safe(shortened(name)), points, DIGITS, mode="markers", marker=marker,
            hoverinfo="name",
        )  # fmt: skip


def _views(scene: Scene) -> Iterator[Trace]:
    if not scene.views:
        return
    pieces = [edge for view in scene.views for edge in view.edges]
    yield _strokes("views", "views", pieces, scene, colour=SKY, width=2)
    fans = [(np.vstack([v.apex, v.rim]), _around(len(v.rim))) for v in scene.views]
    yield _mesh(
        "views", "views, filled", *_joined(fans), scene, colour=SKY, opacity=0.10, lighting=FLAT, showlegend=False
    )


def _path(scene: Scene) -> Iterator[Trace]:
    if not len(scene.path):
        return
    has_time = bool(np.isfinite(scene.path[:, 6]).all())
    when = scene.path[:, 6] if has_time else np.arange(len(scene.path), dtype=float)
    said = [
        f"{_safe(scene.moving)} {f'at {row[6]:.2f} s' if has_time else f'pose {i + 1}'}<br>"
        f"{row[0]:.3f}, {row[1]:.3f}, {row[2]:.3f} m<br>{row[3]:.1f}, {row[4]:.1f}, {row[5]:.1f}°"
        for i, row in enumerate(scene.path)
    ]
    colours = {"color": np.round(when, 3).tolist(), "colorscale": [[0.0, EARLY], [1.0, LATE]], "showscale": False}
    yield _points(
        "path", "path", scene.path[:, :3], _decimals(scene), said,
        mode="lines+markers" if has_time else "markers", marker={"size": 2.5, **colours},
        line={"width": 1.5, "color": GREY},
    )  # fmt: skip


def _ellipsoids(scene: Scene) -> Iterator[Trace]:
    shapes = scene.ellipsoids
    if not shapes:
        return
    unit, faces = _sphere()
    meshes = []
    for frame in scene.frames:
        if frame.name in shapes:
            variances, axes = np.linalg.eigh(shapes[frame.name])
            half = np.sqrt(np.maximum(variances, 0.0))
            meshes.append((frame.T[:3, 3] + unit * half @ axes.T, faces))
    larger = f" ×{scene.times:,.0f}" if scene.times > 1.0 else ""
    yield _mesh("ellipsoids", f"95 %{larger}", *_joined(meshes), scene, colour=ORANGE, opacity=0.45)


def _axes(scene: Scene) -> Iterator[Trace]:
    for k, (name, colour) in enumerate(zip(AXIS_NAMES, AXIS_COLOURS, strict=True) if scene.frames else ()):
        yield _strokes("axes", name, scene.axes(k), scene, colour=colour, width=5)


def _origins(scene: Scene) -> Iterator[Trace]:
    for kind, symbol, size in (("carrier", "square", 5), ("sensor", "circle", 4), ("target", "diamond", 3)):
        frames = [frame for frame in scene.frames if frame.kind == kind]
        if frames:
            at = np.array([frame.T[:3, 3] for frame in frames])
            said = ["<br>".join([f"<b>{_safe(frame.name)}</b>", *map(_safe, frame.words)]) for frame in frames]
            marker = {"size": size, "symbol": symbol, "color": INK}
            yield _points("frames", f"{kind}s", at, EXACT, said, mode="markers", marker=marker, showlegend=False)


def _lines(scene: Scene, lines: Sequence[Line]) -> Iterator[Trace]:
    for is_free, name, dash in ((True, "free", "dash"), (False, "weak", "solid")):
        some = [line for line in lines if line.is_free == is_free]
        if not some:
            continue
        pieces = [piece for line in some for piece in line.pieces]
        said = [
            _safe(shortened(f"{line.label}: {line.words}", LONGEST)) if k == 0 else ""
            for line in some
            for k, piece in enumerate(line.pieces)
            for _ in (*piece, None)
        ]
        yield _strokes(
            "directions", name, pieces, scene,
            colour=PURPLE, width=6 if is_free else 4, dash=dash, text=said, hoverinfo="text",
        )  # fmt: skip


def _names(scene: Scene, lines: Sequence[Line]) -> Iterator[Trace]:
    """Names of frames, and labels of directions at the first frame that has them."""
    few = len(scene.frames) <= MOST_NAMES
    if scene.frames:
        yield _texts("names", [(frame.name, frame.T[:3, 3]) for frame in scene.frames], INK, is_visible=few)
    labels = labels_of(lines)
    if labels:
        yield _texts("directions", list(labels.items()), PURPLE, is_visible=True)


def _texts(group: str, words: Sequence[tuple[str, Array]], colour: str, *, is_visible: bool) -> Trace:
    said, at = zip(*words, strict=True)
    return _trace(
        "scatter3d", group, group, np.array(at), EXACT, mode="text", text=[_plain(name) for name in said],
        textposition=[TEXTS[i % len(TEXTS)] for i in range(len(said))], textfont={"color": colour, "size": 12},
        hoverinfo="skip", showlegend=False, visible=is_visible,
    )  # fmt: skip


def _points(group: str, name: str, at: Array, decimals: int, said: list[str], **more: Any) -> Trace:
    """Places (n, 3) with words beside the pointer."""
    return _trace("scatter3d", group, name, at, decimals, text=said, hovertemplate="%{text}<extra></extra>", **more)


def _strokes(
    group: str, name: str, pieces: Sequence[Array], scene: Scene, *, colour: str, width: float, dash: str = "solid",
    **more: Any,
) -> Trace:  # fmt: skip
    """Lines (n, 3) with gaps between them, as one trace."""
    gap = np.full((1, 3), np.nan)
    points = np.concatenate([part for piece in pieces for part in (piece, gap)])
    line = {"color": colour, "width": width, "dash": dash}
    more = {"hoverinfo": "skip", "line": line, **more}
    return _trace("scatter3d", group, name, points, _decimals(scene), mode="lines", **more)


def _mesh(group: str, name: str, points: Array, faces: Array, scene: Scene, *, colour: str, **more: Any) -> Trace:
    corners = dict(zip("ijk", faces.T.tolist(), strict=True))
    more = {**corners, "color": colour, "hoverinfo": "skip", "showlegend": True, **more}
    return _trace("mesh3d", group, name, points, _decimals(scene), **more)


def _trace(kind: str, group: str, name: str, points: Array, decimals: int, **more: Any) -> Trace:
    """A trace of points (n, 3), whose nan are None in JSON."""
    rounded = (np.round(points, decimals) + 0.0).T.tolist()
    columns = ([None if value != value else value for value in column] for column in rounded)
    return {"type": kind, "meta": group, "name": name, **dict(zip("xyz", columns, strict=True)), **more}


def _decimals(scene: Scene) -> int:
    """As many digits as can be seen."""
    return DIGITS - int(np.floor(np.log10(scene.extent)))


def _fans(polygons: Sequence[Array]) -> tuple[Array, Array]:
    """Convex polygons as triangles: points (n, 3) and faces (m, 3)."""
    return _joined(
        [(p, np.array([[0, i, i + 1] for i in range(1, len(p) - 1)], dtype=int).reshape(-1, 3)) for p in polygons]
    )


def _around(rim: int) -> Array:
    """Triangles from point 0 to each edge of the closed rim that follows it."""
    first = np.arange(rim)
    return np.column_stack([np.zeros(rim, dtype=int), first + 1, (first + 1) % rim + 1])


def _joined(meshes: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(points) for points, _ in meshes)])
    faces = [triangles + start for (_, triangles), start in zip(meshes, starts, strict=False)]
    return np.concatenate([points for points, _ in meshes]), np.concatenate(faces)


@cache
def _sphere() -> tuple[Array, Array]:
    """The unit sphere: an icosahedron with each of its triangles cut into four, 42 points and 80 triangles."""
    g = 0.5 * (1.0 + np.sqrt(5.0))
    points = [np.roll([0.0, a, b * g], turn) for turn in range(3) for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
    corners = np.array(points) / np.sqrt(1.0 + g * g)
    apart = np.linalg.norm(corners[:, None] - corners[None], axis=2)
    joined = np.isclose(apart, apart[apart > 0.0].min())
    faces = [(a, b, c) for a, b, c in combinations(range(12), 3) if joined[a, b] and joined[b, c] and joined[a, c]]
    edges = {edge: 12 + i for i, edge in enumerate(sorted({e for face in faces for e in combinations(face, 2)}))}
    middles = np.array([corners[a] + corners[b] for a, b in edges])
    cut = []
    for a, b, c in faces:
        ab, ac, bc = edges[a, b], edges[a, c], edges[b, c]
        cut += [(a, ab, ac), (b, ab, bc), (c, ac, bc), (ab, ac, bc)]
    return np.vstack([corners, middles / np.linalg.norm(middles, axis=1, keepdims=True)]), np.array(cut)


def _safe(text: str) -> str:
    """A text for plotly's legend and hover, which read some HTML."""
    return html.escape(printable(text), quote=False)


def _plain(text: str) -> str:
    """A text inside the scene, where no sign can be escaped."""
    return shortened(printable(text)).replace("<", "‹").replace(">", "›").replace("&", "+")


#: The first view looks down by this angle.
ELEVATION = np.radians(28.0)
#: plotly's field of view over the height, and the least width of a screen over its height: half of each, as tangents.
HIGH, WIDE = np.tan(np.radians(22.5)), 1.05 * np.tan(np.radians(22.5))
#: Sensors within this share of the scene have a button of their own that shows them from near.
SMALL = 0.25
#: The eye is so much nearer than where it would see the corners of the box: few scenes fill them.
NEARER = 0.97
#: Groups with a button, in order: what the button is called, and its width as a share of a narrow screen.
BUTTONS = (
    ("views", "Views", 0.17),
    ("path", "Path", 0.145),
    ("ellipsoids", "Ellipsoids", 0.225),
    ("boards", "Boards", 0.19),
    ("clouds", "Clouds", 0.19),
    ("names", "Names", 0.19),
)
#: A pressed button of plotly is nearly white on any page, so that all have dark words.
BUTTON = {"bgcolor": "#C3CAD2", "bordercolor": "#8A929B", "font": {"size": 11, "color": "#14181D"}}
MENU = {"type": "buttons", "direction": "right", "xanchor": "left", "yanchor": "top", **BUTTON}


#: The legend lies below the scene.
LEGEND = {
    "orientation": "h", "x": 0.0, "y": 0.0, "yanchor": "bottom", "font": {"size": 11}, "itemsizing": "constant",
    "entrywidth": 64, "entrywidthmode": "pixels", "bgcolor": "rgba(0,0,0,0)",
}  # fmt: skip


def layout_of(scene: Scene, traces: Sequence[Trace]) -> dict[str, Any]:
    """The layout."""
    ranges = [[float(low), float(high)] for low, high in zip(scene.low, scene.high, strict=True)]
    fixed = {"autorange": False, "tickfont": {"size": 10}, "nticks": 5}
    axes = {
        f"{name}axis": {"range": limits, "title": {"text": f"{name} (m)", "font": {"size": 11}}, **fixed}
        for name, limits in zip("xyz", ranges, strict=True)
    }
    return {
        "scene": {
            **axes,
            "aspectmode": "data",
            "domain": {"x": [0.0, 1.0], "y": [0.09, 0.83]},
            "camera": camera(scene, first_view(scene)),
            "dragmode": "orbit",
        },
        "legend": LEGEND,
        "margin": {"l": 6, "r": 6, "t": 6, "b": 6},
        "showlegend": True,
        "updatemenus": [*_shown(traces), _turned(scene)],
    }


def first_view(scene: Scene) -> Array:
    """The direction (3,) from the scene to the eye: slanting from above, so that the scene is wide rather than deep."""
    spread = _spread(scene)
    _, axes = np.linalg.eigh(spread[:2, :2])
    flat = axes[:, 0] * (1.0 if axes[0, 0] >= 0.0 else -1.0)  # the eye is on the side of x
    turned = np.cos(0.45) * flat + np.sin(0.45) * np.array([-flat[1], flat[0]])
    return np.array([*(np.cos(ELEVATION) * turned), np.sin(ELEVATION)])


def camera(scene: Scene, towards_eye: Array, up: Sequence[float] = (0.0, 0.0, 1.0)) -> dict[str, Any]:
    """A view as plotly has it: places in a box whose volume is 1."""
    sides = scene.high - scene.low
    half = 0.5 * sides / np.prod(sides) ** (1.0 / 3.0)
    corners = np.array(np.meshgrid(*([-1.0, 1.0],) * 3)).reshape(3, -1).T * half
    right = np.cross(up, towards_eye)
    right /= np.linalg.norm(right)
    above = np.cross(towards_eye, right)
    needed = np.maximum(np.abs(corners @ above) / HIGH, np.abs(corners @ right) / WIDE) + corners @ towards_eye
    eye = NEARER * float(needed.max()) * towards_eye
    return {"eye": _xyz(eye), "up": _xyz(up), "center": _xyz((0.0, 0.0, 0.0))}


def near_sensors(scene: Scene) -> dict[str, Any] | None:
    """A view of the sensors alone, where they are small in the whole scene; None where they are not."""
    places = np.array([frame.T[:3, 3] for frame in scene.frames if frame.kind == "sensor"]).reshape(-1, 3)
    if len(places) < 2 or len({frame.kind for frame in scene.frames}) < 3:
        return None
    size = float(np.ptp(places, axis=0).max())
    if size > SMALL * scene.extent:
        return None
    unit = float(np.prod(scene.high - scene.low)) ** (1.0 / 3.0)
    centre = (0.5 * (places.min(axis=0) + places.max(axis=0)) - 0.5 * (scene.low + scene.high)) / unit
    eye = centre + 2.2 * max(size, SMALL * 0.2 * scene.extent) / unit * first_view(scene)
    return {"eye": _xyz(eye), "up": _xyz((0.0, 0.0, 1.0)), "center": _xyz(centre)}


def _spread(scene: Scene) -> Array:
    places = np.concatenate(
        [
            scene.path[:, :3],
            *(f.T[None, :3, 3] for f in scene.frames),
            *(v.rim for v in scene.views),
            *(points[:: max(1, len(points) // 9)] for _, points in scene.clouds),
        ]
    )
    return np.asarray(np.cov(places.T)) if len(places) > 1 else np.eye(3)


def _shown(traces: Sequence[Trace]) -> list[dict[str, Any]]:
    """A button for each group that is there: pressed, the group is seen."""
    menus: list[dict[str, Any]] = []
    x = 0.0
    for group, label, width in BUTTONS:
        members = [i for i, trace in enumerate(traces) if trace["meta"] == group]
        if not members:
            continue
        is_seen = traces[members[0]].get("visible", True)
        show, hide = ([{"visible": visible}, members] for visible in (True, False))
        button = {"method": "restyle", "label": label, "args": show, "args2": hide}
        menus.append(_menu([button], x, 1.0, 0 if is_seen else -1, is_marked=True))
        x += width
    return menus


def _turned(scene: Scene) -> dict[str, Any]:
    """Buttons that turn the scene."""
    slant = first_view(scene)
    side = np.array([*(slant[:2] / np.linalg.norm(slant[:2])), 0.0])
    front = np.array([-side[1], side[0], 0.0])
    above = camera(scene, np.array([0.0, 0.0, 1.0]), [*(-side[:2]), 0.0])
    views = {"Slant": camera(scene, slant), "Above": above, "Front": camera(scene, side), "Side": camera(scene, front)}
    near = near_sensors(scene)
    if near is not None:
        views["Sensors"] = near
    buttons = [
        {"method": "relayout", "label": label, "args": [{"scene.camera": view}]} for label, view in views.items()
    ]
    return _menu(buttons, 0.0, 0.91, 0, is_marked=False)


def _menu(buttons: list[dict[str, Any]], x: float, y: float, active: int, *, is_marked: bool) -> dict[str, Any]:
    return {**MENU, "buttons": buttons, "x": x, "y": y, "active": active, "showactive": is_marked}


def _xyz(values: Sequence[float] | Array) -> dict[str, float]:
    return {name: round(float(value), 4) + 0.0 for name, value in zip("xyz", values, strict=True)}
