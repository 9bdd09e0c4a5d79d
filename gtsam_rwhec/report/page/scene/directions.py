"""Free and weak directions as lines in the scene: along what a frame may move, and about what it may turn."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.page.scene.model import Frame, Scene
from gtsam_rwhec.report.page.shown_result import ShownResult
from gtsam_rwhec.solver.free_directions import SHARE, FreeDirection

#: A line has this share of the scene to each side, and its arrowheads and circles this one.
LENGTH, HEAD = 0.16, 0.022
#: Of each direction so many frames are drawn, and of all so many lines.
MOST_FRAMES, MOST_LINES = 40, 200


@dataclass(frozen=True, eq=False)
class Line:
    """A direction of a frame.

    Attributes
    ----------
    frame : str
    label : str
        "free 1" or "weak 2"; the list below the scene has the same.
    words : str
        The sentence.
    is_free : bool
    pieces : tuple of (n, 3) arrays
        Lines to be drawn: the direction itself first.
    moves, about : (3,) arrays or None
        The unit vector in the scene along which it moves, or about which it turns.
    """

    frame: str
    label: str
    words: str
    is_free: bool
    pieces: tuple[Array, ...]
    moves: Array | None = field(default=None)
    about: Array | None = field(default=None)


def free_directions(shown: ShownResult) -> tuple[FreeDirection, ...]:
    """The free directions of the poses that the page shows."""
    assert shown.result is not None
    refined = shown.result.refined
    return shown.result.solution.identifiability.free_directions if refined is None else refined.free_directions


def lines_of(shown: ShownResult, scene: Scene) -> tuple[Line, ...]:
    """Free directions, then weak ones, then positions that are too uncertain for an ellipsoid."""
    frames = {frame.name: frame for frame in scene.frames}
    lines = [
        line
        for number, direction in enumerate(free_directions(shown), start=1)
        for line in _free(direction, f"free {number}", frames, scene.extent)
    ]
    weak = () if shown.evidence is None else shown.evidence.weak
    number = 0
    for one in weak:
        if not one.is_weak:
            continue
        number += 1
        if (frame := frames.get(one.frame)) is None:
            continue
        along = frame.T[:3, :3] @ np.array(one.axis)
        what, unit = ("along", "mm") if one.kind == "translation" else ("about", "°")
        words = f"{one.frame}: ± {one.deviation:.2g} {unit} {what} this line"
        draw = _shift if one.kind == "translation" else _turn
        yield_at = {"moves" if one.kind == "translation" else "about": along}
        pieces = draw(frame.T[:3, 3], along, 0.5 * scene.extent)
        lines.append(Line(one.frame, f"weak {number}", words, False, pieces, **yield_at))
    return (*lines, *_too_large(scene))[:MOST_LINES]


def _free(direction: FreeDirection, label: str, frames: dict[str, Frame], extent: float) -> Iterator[Line]:
    words = str(direction)
    for name, twist in list(direction.frames.items())[:MOST_FRAMES]:
        if (frame := frames.get(name)) is None:
            continue
        R, t = frame.T[:3, :3], frame.T[:3, 3]
        omega, v = R @ np.array(twist[:3]), R @ np.array(twist[3:])
        turn, shift = float(np.linalg.norm(omega)), float(np.linalg.norm(v)) / direction.length_m
        if turn > SHARE * max(turn, shift):
            axis = omega / turn
            foot = np.cross(omega, v) / turn**2
            # An axis far off turns the frame as a shift does; it is drawn at the frame then.
            at = t + foot if np.linalg.norm(foot) <= 0.5 * extent else t
            yield Line(name, label, words, True, _turn(at, axis, extent), about=axis)
        else:
            along = v / np.linalg.norm(v)
            yield Line(name, label, words, True, _shift(t, along, extent), moves=along)


def _too_large(scene: Scene) -> Iterator[Line]:
    """The longest axis of ellipsoids that would be larger than the scene."""
    drawn = scene.ellipsoids
    for frame in scene.frames:
        if frame.covariance is None or frame.name in drawn or not frame.covariance.any():
            continue
        variances, vectors = np.linalg.eigh(frame.covariance)
        half = scene.radius * float(np.sqrt(variances[-1]))
        if scene.times * half <= 0.5 * scene.extent:
            continue  # one of many, without an ellipsoid
        words = f"{frame.name}: 95 % within ± {1e3 * half:.3g} mm along this line"
        pieces = _shift(frame.T[:3, 3], vectors[:, -1], scene.extent)
        yield Line(frame.name, frame.name, words, False, pieces, moves=vectors[:, -1])


def _shift(at: Array, along: Array, extent: float) -> tuple[Array, ...]:
    """A line with arrowheads at both ends."""
    reach, head = LENGTH * extent * along, HEAD * extent
    side = _across(along)
    heads = (
        np.array([end - sign * head * along + 0.5 * head * side, end, end - sign * head * along - 0.5 * head * side])
        for end, sign in ((at + reach, 1.0), (at - reach, -1.0))
    )
    return (np.array([at - reach, at + reach]), *heads)


def _turn(at: Array, axis: Array, extent: float) -> tuple[Array, ...]:
    """An axis with a circle about its upper end, and an arrowhead on the circle."""
    reach, radius = 0.7 * LENGTH * extent * axis, 1.5 * HEAD * extent
    first = _across(axis)
    second = np.cross(axis, first)
    angles = np.linspace(0.0, np.radians(300.0), 19)[:, None]
    circle = at + reach + radius * (np.cos(angles) * first + np.sin(angles) * second)
    forward = np.cross(axis, circle[-1] - at - reach) / radius
    outward = (circle[-1] - at - reach) / radius
    head = 0.5 * HEAD * extent
    arrow = circle[-1] + head * np.array([-forward + 0.5 * outward, np.zeros(3), -forward - 0.5 * outward])
    return np.array([at - reach, at + reach]), circle, arrow


def _across(along: Array) -> Array:
    """A unit vector across a direction."""
    side = np.cross(along, np.eye(3)[int(np.abs(along).argmin())])
    unit: Array = side / np.linalg.norm(side)
    return unit
