"""What is drawn of a rig, in the axes of the carrier that stands still: frames, boards, views, path, ellipsoids."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import gtsam
import numpy as np
from rwhec_factors.se3 import pose

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.report.figures import round_down
from gtsam_rwhec.report.shown_result import ShownResult
from gtsam_rwhec.results.cloud_evidence import box_of
from gtsam_rwhec.results.scene_evidence import SceneEvidence
from gtsam_rwhec.solver.free_directions import SHARE, FreeDirection

Kind = Literal["carrier", "sensor", "target"]
Side = Literal["sensors", "targets"]
#: Axes of frames have at most and at least this share of the scene, and this share of the distance between neighbours.
AXIS, LEAST_AXIS, OF_NEIGHBOURS = 0.06, 0.01, 0.6
#: The largest ellipsoid has a half axis of this share of the scene.
ELLIPSOID = 0.035
#: An ellipsoid this many times the median one does not set the magnification: it is drawn as a line.
FAR_LARGER = 20.0
#: A carrier whose origin is farther away than this many times the spread of all else is left out of sight.
FAR = 5.0
#: Boards of unknown size are squares of this share of the scene.
PLAIN = 0.03
#: Scenes are at least this wide, metres.
SMALLEST_M = 1e-3
#: With more frames than this, targets are points without ellipsoids.
MANY = 60
LEVEL = 0.95


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame in the scene."""

    name: str
    kind: Kind
    T: Array  #: (4, 4): pose in the scene, metres
    words: tuple[str, ...]  #: What is known of it, line by line
    #: (3, 3): of its position, in the scene's axes, m^2; None where it is not known, or not finite
    covariance: Array | None = None


@dataclass(frozen=True, eq=False)
class View:
    """What a camera sees: its place (3,) and the border of its image (n, 3), from the top left corner clockwise."""

    name: str
    apex: Array
    rim: Array

    @property
    def edges(self) -> tuple[Array, ...]:
        """The border, and the lines from the place to its corners."""
        corners = self.rim[:: len(self.rim) // 4]
        return np.vstack([self.rim, self.rim[:1]]), *(np.stack([self.apex, corner]) for corner in corners)


@dataclass(frozen=True, eq=False)
class PlacedBoard:
    """A board: its paper (n, 3), empty where it is not known, and its dark parts, each (n, 3), metres."""

    paper: Array
    dark: tuple[Array, ...]


@dataclass(frozen=True, eq=False)
class Scene:
    """A rig, or the frames on one of its carriers."""

    world: str  #: The carrier whose axes the scene has
    frames: tuple[Frame, ...]
    views: tuple[View, ...]
    boards: tuple[PlacedBoard, ...]
    #: (n, 7): x, y, z, roll, pitch, yaw (degrees) and seconds of the moving carrier; seconds are nan without stamps
    path: Array
    moving: str  #: Name of the moving carrier; empty where there is none
    #: (3,): corners of the box that holds the whole scene
    low: Array
    high: Array
    times: float  #: Ellipsoids are drawn so many times as large
    radius: float  #: Deviations to the border of an ellipsoid of `LEVEL`
    out_of_sight: tuple[str, ...]  #: Carriers whose origins are too far away
    clouds: tuple[tuple[str, Array], ...] = ()  #: Of each view its name and points (n, 3)

    @property
    def extent(self) -> float:
        """The longest side of the box, metres."""
        return float((self.high - self.low).max())

    @property
    def has_many(self) -> bool:
        """Whether targets are drawn as points."""
        return len(self.frames) > MANY

    def axes(self, k: int) -> list[Array]:
        """The k-th axis of each frame as a line (2, 3)."""
        lengths = self._axes_m
        drawn = (frame for frame in self.frames if not (self.has_many and frame.kind == "target"))
        return [f.T[:3, 3] + np.outer([0.0, lengths[f.kind]], f.T[:3, k]) for f in drawn]

    @property
    def _axes_m(self) -> dict[Kind, float]:
        """Length of the axes of frames of each kind: shorter where frames are near to each other."""
        found: dict[Kind, float] = {"carrier": 1.6 * AXIS * self.extent}
        for kind in ("sensor", "target"):
            places = np.array([frame.T[:3, 3] for frame in self.frames if frame.kind == kind]).reshape(-1, 3)
            apart = np.linalg.norm(places[:, None] - places[None], axis=2) + np.diag(np.full(len(places), np.inf))
            nearest = float(np.median(apart.min(axis=1))) if len(places) > 1 else self.extent
            found[kind] = float(np.clip(OF_NEIGHBOURS * nearest, LEAST_AXIS * self.extent, AXIS * self.extent))
        return found

    @property
    def ellipsoids(self) -> dict[str, Array]:
        """The shape matrix (3, 3) of each ellipsoid that is drawn, as large as it is drawn: a a' of its half axes."""
        factor = (self.times * self.radius) ** 2
        shapes = {
            frame.name: factor * frame.covariance
            for frame in self.frames
            if frame.covariance is not None and not (self.has_many and frame.kind == "target")
        }
        return {name: shape for name, shape in shapes.items() if np.linalg.norm(shape, 2) ** 0.5 <= 0.5 * self.extent}


def scene_of_rig(shown: ShownResult, evidence: SceneEvidence) -> Scene:
    """Both carriers, the moving one at its typical pose."""
    typical = _pose(evidence.poses[evidence.typical])
    stands = evidence.standing == "targets"
    placed: dict[Side, Array] = {
        "targets": np.eye(4) if stands else typical,
        "sensors": typical if stands else np.eye(4),
    }
    world, moving = (carrier(shown, kind) for kind in (("targets", "sensors") if stands else ("sensors", "targets")))
    rpy = np.degrees([gtsam.Rot3.Quaternion(*row[3:]).rpy() for row in evidence.poses])
    seconds = evidence.seconds or (np.nan,) * len(evidence.poses)
    path = np.column_stack([np.array(evidence.poses)[:, :3], rpy, seconds])
    return _scene(shown, evidence, placed, world, path, moving)


def scene_of_carrier(shown: ShownResult, side: Side) -> Scene:
    """The frames on one carrier, in its axes: all that a result alone tells."""
    return _scene(shown, None, {side: np.eye(4)}, carrier(shown, side), np.zeros((0, 7)), "")


def carrier(shown: ShownResult, kind: str) -> str:
    """The name of the carrier of the sensors, or of the targets."""
    rows = shown.tree.get(kind, [])
    return str(rows[0]["parent"]) if rows else f"the carrier of the {kind}"


def _scene(
    shown: ShownResult,
    evidence: SceneEvidence | None,
    placed: Mapping[Side, Array],
    world: str,
    path: Array,
    moving: str,
) -> Scene:
    assert shown.result is not None
    refined = shown.result.refined
    frames = [frame for kind, T in placed.items() for frame in _frames(shown, kind, T)]
    origins = [Frame(carrier(shown, kind), "carrier", T, _words(T, world)) for kind, T in placed.items()]
    views = () if evidence is None else tuple(_views(frames, evidence))
    extent = np.concatenate([path[:, :3], *(f.T[None, :3, 3] for f in frames), *(v.rim for v in views)])
    near = [f for f in origins if f.name != world or _is_near(f.T[:3, 3], extent)]
    extent = np.concatenate([extent, *(f.T[None, :3, 3] for f in near)])
    size = max(float(np.ptp(extent, axis=0).max()), SMALLEST_M)
    printed = [frame for frame in frames if frame.name not in objects_of(shown)]
    boards = tuple(_boards(printed, evidence, PLAIN * size))
    extent = np.concatenate([extent, *(part for board in boards for part in (board.paper, *board.dark))])
    clouds = _clouds(shown, placed.get("targets"))
    if clouds:
        extent = np.concatenate([extent, box_of([points for _, points in clouds])])
    low, high = extent.min(axis=0), extent.max(axis=0)
    margin = 0.04 * max(float((high - low).max()), SMALLEST_M)
    radius = float(np.sqrt(7.814727903251179 if refined is None else refined.squared_radius(3, LEVEL)))
    return Scene(
        world=world,
        frames=(*near, *frames),
        views=views,
        boards=boards,
        path=path,
        moving=moving,
        low=low - margin,
        high=high + margin,
        times=_magnification(frames, radius, float((high - low).max())),
        radius=radius,
        out_of_sight=tuple(f.name for f in origins if f not in near),
        clouds=clouds,
    )


def scene_of_clouds(scene: Scene) -> Scene:
    """The clouds of a scene alone, from near."""
    low, high = box_of([points for _, points in scene.clouds])
    margin = 0.15 * float((high - low).max())
    within = (f for f in scene.frames if ((low < f.T[:3, 3]) & (f.T[:3, 3] < high)).all())
    frames = tuple(replace(frame, covariance=None) for frame in within)  # an ellipsoid would hide the clouds
    alone = replace(scene, frames=frames, views=(), boards=(), path=np.zeros((0, 7)))
    return replace(alone, low=low - margin, high=high + margin)


def _clouds(shown: ShownResult, placed: Array | None) -> tuple[tuple[str, Array], ...]:
    """Names and points of views, in the scene."""
    if shown.evidence is None or shown.evidence.clouds is None or placed is None:
        return ()
    several = len({one.sensor for one in shown.evidence.clouds.clouds}) > 1
    return tuple(
        (f"{one.sensor}, {one.name}" if several else one.name, np.array(one.points) @ placed[:3, :3].T + placed[:3, 3])
        for one in shown.evidence.clouds.clouds
    )


def objects_of(shown: ShownResult) -> set[str]:
    """Targets that were seen in clouds."""
    return {one["target"] for one in shown.tree.get("log", {}).get("detection", {}).get("objects", ())}


def _frames(shown: ShownResult, side: Side, placed: Array) -> Iterator[Frame]:
    """The frames on a carrier that is placed in the scene."""
    parts = shown.tree.get("refined", {}).get("frames", {})
    kind: Kind = "sensor" if side == "sensors" else "target"
    for row in shown.tree[side]:
        T = pose(row["rotation_matrix"], row["translation_m"])
        name, known = row["child"], parts.get(row["child"])
        words, covariance = list(_words(T, row["parent"])), None
        if known is not None:
            words.append(_deviations(known))
            block = np.array([line[3:] for line in known["covariance"][3:]], dtype=float)
            if np.isfinite(block).all():
                R = (placed @ T)[:3, :3]
                covariance = R @ block @ R.T
        if row.get("contradicted"):
            words.append("its own measurements contradict this pose")
        yield Frame(name, kind, placed @ T, tuple(words), covariance)


def _deviations(known: Mapping[str, list[float | None]]) -> str:
    """Standard deviations of a frame in words."""
    mm, deg = (
        ", ".join("free" if value is None else f"{value:.2g}" for value in known[f"standard_deviations_{unit}"])
        for unit in ("mm", "deg")
    )
    return f"± {mm} mm, ± {deg}° (1 σ, own axes)"


def _words(T: Array, parent: str) -> tuple[str, ...]:
    """A pose in words."""
    x, y, z = T[:3, 3]
    roll, pitch, yaw = np.degrees(gtsam.Rot3(T[:3, :3]).rpy())
    return f"in {parent}: {x:.4f}, {y:.4f}, {z:.4f} m", f"roll {roll:.2f}°, pitch {pitch:.2f}°, yaw {yaw:.2f}°"


def _views(frames: list[Frame], evidence: SceneEvidence) -> Iterator[View]:
    """Cameras' views, as far as the typical distance of what they saw."""
    for frame in frames:
        seen = evidence.sensors.get(frame.name) if frame.kind == "sensor" else None
        if seen is None or not seen.rim or seen.distance_m is None:
            continue
        rim = seen.distance_m[1] * np.array(seen.rim) @ frame.T[:3, :3].T + frame.T[:3, 3]
        yield View(frame.name, frame.T[:3, 3], rim)


def _boards(frames: list[Frame], evidence: SceneEvidence | None, plain: float) -> Iterator[PlacedBoard]:
    """The boards in the scene; one of unknown shape is a plain square."""
    square = plain * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
    for frame in frames:
        if frame.kind != "target":
            continue
        target = None if evidence is None else evidence.targets.get(frame.name)
        board = None if target is None else target.board
        R, t = frame.T[:3, :3], frame.T[:3, 3]
        if board is None:
            yield PlacedBoard(square @ R.T + t, ())
            continue
        paper = np.array(board.paper).reshape(-1, 3) @ R.T + t
        yield PlacedBoard(paper, tuple(np.array(polygon) @ R.T + t for polygon in board.dark))


def _is_near(place: Array, others: Array) -> bool:
    spread = max(float(np.ptp(others, axis=0).max()), SMALLEST_M)
    return bool(np.linalg.norm(place - others.mean(axis=0)) <= FAR * spread)


def _magnification(frames: list[Frame], radius: float, extent: float) -> float:
    """One factor for all ellipsoids, with which the largest can be seen: 1, 2 or 5 times a power of ten."""
    half = [radius * float(np.linalg.norm(f.covariance, 2)) ** 0.5 for f in frames if f.covariance is not None]
    half = [each for each in half if each > 0.0]
    if not half:
        return 1.0
    largest = max(each for each in half if each <= FAR_LARGER * float(np.median(half)))
    return max(round_down(ELLIPSOID * extent / largest), 1.0)


def _pose(row: tuple[float, ...]) -> Array:
    return pose(gtsam.Rot3.Quaternion(*row[3:]).matrix(), row[:3])


#: Sizes as shares of the scene: a line to each side, and its arrowheads and circles.
LENGTH, HEAD = 0.16, 0.022
#: At most this many frames are drawn for each direction, and this many lines in all.
MOST_FRAMES, MOST_LINES = 40, 200


@dataclass(frozen=True, eq=False)
class Line:
    """A direction of a frame."""

    frame: str
    label: str  #: "free 1" or "weak 2"; the list below the scene has the same
    words: str  #: The sentence
    is_free: bool
    pieces: tuple[Array, ...]  #: Lines to be drawn: the direction itself first


def lines_of(shown: ShownResult, scene: Scene) -> tuple[Line, ...]:
    """Free directions, then weak ones, then positions that are too uncertain for an ellipsoid."""
    assert shown.result is not None
    frames = {frame.name: frame for frame in scene.frames}
    lines = [
        line
        for number, direction in enumerate(shown.result.free_directions, start=1)
        for line in _free(direction, f"free {number}", frames, scene.extent)
    ]
    weak = () if shown.evidence is None else tuple(one for one in shown.evidence.weak if one.is_weak)
    for number, one in enumerate(weak, start=1):
        if (frame := frames.get(one.frame)) is None:
            continue
        what, unit, draw = ("along", "mm", _shift) if one.kind == "translation" else ("about", "°", _turn)
        words = f"{one.frame}: ± {one.deviation:.2g} {unit} {what} this line"
        pieces = draw(frame.T[:3, 3], frame.T[:3, :3] @ np.array(one.axis), 0.5 * scene.extent)
        lines.append(Line(one.frame, f"weak {number}", words, False, pieces))
    return (*lines, *_too_large(scene))[:MOST_LINES]


def labels_of(lines: Sequence[Line]) -> dict[str, Array]:
    """Where the label of each direction stands: at the first frame that has it."""
    return {line.label: line.pieces[0][1] for line in reversed(lines) if line.label != line.frame}


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
            yield Line(name, label, words, True, _turn(at, axis, extent))
        else:
            along = v / np.linalg.norm(v)
            yield Line(name, label, words, True, _shift(t, along, extent))


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
        yield Line(frame.name, frame.name, words, False, pieces)


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
