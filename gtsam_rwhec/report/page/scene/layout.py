"""The layout of a scene for plotly: box, first view, legend, and buttons that show groups and turn the scene."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.page.scene.model import Scene
from gtsam_rwhec.report.page.scene.traces import Trace

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
    ("names", "Names", 0.19),
)
#: A pressed button of plotly is nearly white on any page, so that all have dark words.
BUTTON = {"bgcolor": "#C3CAD2", "bordercolor": "#8A929B", "font": {"size": 11, "color": "#14181D"}}


def layout_of(scene: Scene, traces: Sequence[Trace]) -> dict[str, Any]:
    """The layout."""
    ranges = [[float(low), float(high)] for low, high in zip(scene.low, scene.high, strict=True)]
    axes = {
        f"{name}axis": {
            "range": limits,
            "autorange": False,
            "title": {"text": f"{name} (m)", "font": {"size": 11}},
            "tickfont": {"size": 10},
            "nticks": 5,
        }
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
        "legend": {
            "orientation": "h",
            "x": 0.0,
            "y": 0.0,
            "yanchor": "bottom",
            "font": {"size": 11},
            "itemsizing": "constant",
            "entrywidth": 64,
            "entrywidthmode": "pixels",
            "bgcolor": "rgba(0,0,0,0)",
        },
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
    direction: Array = np.array([*(np.cos(ELEVATION) * turned), np.sin(ELEVATION)])
    return direction


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
        [scene.path[:, :3], *(f.T[None, :3, 3] for f in scene.frames), *(v.rim for v in scene.views)]
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
        button = {
            "method": "restyle",
            "label": label,
            "args": [{"visible": True}, members],
            "args2": [{"visible": False}, members],
        }
        menus.append(_menu([button], x, 1.0, 0 if is_seen else -1, is_marked=True))
        x += width
    return menus


def _turned(scene: Scene) -> dict[str, Any]:
    """Buttons that turn the scene."""
    slant = first_view(scene)
    side = np.array([*(slant[:2] / np.linalg.norm(slant[:2])), 0.0])
    front = np.array([-side[1], side[0], 0.0])
    above = camera(scene, np.array([0.0, 0.0, 1.0]), [*(-side[:2]), 0.0])
    views: tuple[tuple[str, dict[str, Any]], ...] = (
        ("Slant", camera(scene, slant)),
        ("Above", above),
        ("Front", camera(scene, side)),
        ("Side", camera(scene, front)),
    )
    near = near_sensors(scene)
    if near is not None:
        views = (*views, ("Sensors", near))
    buttons = [{"method": "relayout", "label": label, "args": [{"scene.camera": view}]} for label, view in views]
    return _menu(buttons, 0.0, 0.91, 0, is_marked=False)


def _menu(buttons: list[dict[str, Any]], x: float, y: float, active: int, *, is_marked: bool) -> dict[str, Any]:
    return {
        "type": "buttons",
        "direction": "right",
        "buttons": buttons,
        "x": x,
        "y": y,
        "xanchor": "left",
        "yanchor": "top",
        "active": active,
        "showactive": is_marked,
        **BUTTON,
    }


def _xyz(values: Sequence[float] | Array) -> dict[str, float]:
    return {name: round(float(value), 4) + 0.0 for name, value in zip("xyz", values, strict=True)}
