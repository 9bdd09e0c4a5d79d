"""The rig in space: the carriers' path, a typical pose, cameras' views, boards, and from where they were seen."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Literal

import gtsam
import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.calibration.calibration_record import Calibration
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import (
    AprilGrid,
    Bundle,
    Charuco,
    Checkerboard,
    CircleGrid,
    Tag,
    TagGrid,
    Target,
    grid,
    square,
)
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.fitting.reprojection_record import BoardShape
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.file_record import Count, FileRecord, Rows
from gtsam_rwhec.results.image_errors import warp_of
from gtsam_rwhec.results.linear_model import MeasuredRows

#: The path is thinned to this many poses.
MOST_POSES = 400
#: An edge of an image has this many points.
EDGE = 4
#: Words in the names of carriers, in order: from carriers that stand still for people to carriers that move.
STANDING = frozenset({"world", "map", "earth", "room", "floor", "ground", "odom", "mocap", "vicon", "optitrack"})
PARTLY = frozenset({"base", "table", "cell", "stand", "origin"})
MOVING = frozenset({"hand", "tool", "tool0", "ee", "eef", "tcp", "flange", "gripper", "wrist", "body"})
MOVING |= {"vehicle", "car", "rig", "drone"}
_PARTS = re.compile(r"[^a-z0-9]+")


class SensorScene(FileRecord):
    """A sensor in space, and where it saw its targets. Angles are between its z axis and the targets' origins."""

    rim: Rows  #: Unit vectors to the image's border, clockwise from the top left; empty: not known
    measurements: Count  #: Measurements in the answer
    behind: Count  #: Measurements whose target is not in front, z <= 0
    distance_m: tuple[float, float, float] | None  #: Nearest, median, farthest; m
    off_axis_deg: tuple[float, float] | None  #: Median and largest, as measured; degrees
    off_axis_by_poses_deg: tuple[float, float] | None  #: The same by the calibrated poses; degrees


class TargetScene(FileRecord):
    """A target in space, and from where it was seen."""

    board: DrawnBoard | None  #: As drawn; null where its shape is not known
    measurements: Count  #: Measurements in the answer
    tilt_deg: float  #: Angle between its z axis and that of its carrier; degrees
    #: Angle between its z axis and the direction to the sensor, by the poses: median, largest; degrees
    oblique_deg: tuple[float, float] | None


class SceneEvidence(FileRecord):
    """What is needed to draw the rig."""

    standing: Literal["targets", "sensors"]  #: Whose carrier is drawn as standing still
    why: str  #: Why this one
    poses: Rows  #: Pose of the other carrier in it: x, y, z (m), qw, qx, qy, qz; in order of time
    of: Count  #: Of so many poses these are a choice, evenly spread
    seconds: tuple[float, ...] | None  #: Time of each pose after the first; null without stamps
    typical: Count  #: Which of the poses is nearest to all others
    sensors: dict[str, SensorScene]
    targets: dict[str, TargetScene]


def scene_of(
    calibration: Calibration,
    rows: Mapping[Pair, MeasuredRows],
    carriers: tuple[str | None, str | None],
    cameras: Mapping[str, Camera],
    targets: Mapping[str, Target | Array],
) -> SceneEvidence | None:
    """What is needed to draw a rig; None where it has no poses, or nothing was measured.

    ``carriers`` are the names of those of the sensors and of the targets. ``cameras`` are stated intrinsics; those that
    were estimated come first. ``targets`` has as stated what a target is, or its corners (n, 3) in metres.
    """
    used = {
        pair: one
        for pair, one in rows.items()
        if one.used.any() and pair.target in calibration.X and pair.sensor in calibration.Y
    }
    if not used:
        return None
    standing, why = standing_carrier(*carriers)
    path, seconds, count = _path(used, standing)
    refined = calibration.refined
    if refined is not None:
        cameras = {**cameras, **{name: one.camera for name, one in refined.intrinsics.items()}}
    shapes = {} if refined is None or refined.reprojection is None else refined.reprojection.boards
    seen = {pair: _seen(pair, one, calibration) for pair, one in used.items()}
    many = len(targets) > WITH_MODULES
    boards = {
        name: drawn_points(what, _scale(calibration, name))
        if isinstance(what, np.ndarray)
        else drawn_board(what, _scale(calibration, name), shapes.get(name), is_one_of_many=many)
        for name, what in targets.items()
    }
    return SceneEvidence(
        standing=standing,
        why=why,
        poses=tuple(map(_row_of, path)),
        of=count,
        seconds=None if seconds is None else tuple(seconds.tolist()),
        typical=_medoid(path),
        sensors={
            name: _sensor(cameras.get(name), [one for pair, one in seen.items() if pair.sensor == name])
            for name in calibration.Y
        },
        targets={
            name: _target(pose, boards.get(name), [one for pair, one in seen.items() if pair.target == name])
            for name, pose in calibration.X.items()
        },
    )


def standing_carrier(sensors: str | None, targets: str | None) -> tuple[Literal["targets", "sensors"], str]:
    """Which carrier people think of as standing still, by the names, and why."""
    ranks = _rank(sensors), _rank(targets)
    if ranks[0] > ranks[1]:
        return "sensors", "by the names of the carriers"
    if ranks[1] > ranks[0]:
        return "targets", "by the names of the carriers"
    return "targets", "the names of the carriers do not tell which of them stands still"


def _rank(name: str | None) -> int:
    words = set(_PARTS.split((name or "").lower()))
    if words & STANDING:
        return 3
    if words & MOVING:
        return 0
    return 2 if words & PARTLY else 1


def _path(used: Mapping[Pair, MeasuredRows], standing: str) -> tuple[Array, Array | None, int]:
    """Poses (n, 4, 4) of the moving carrier, their seconds, and how many there were: equal ones count once."""
    A = np.concatenate([one.A[one.used] for one in used.values()])
    stamps = [one.stamps_ns[one.used] for one in used.values() if one.stamps_ns is not None]
    seconds = None
    if len(stamps) == len(used):
        when, first = np.unique(np.concatenate(stamps), return_index=True)
        seconds = 1e-9 * (when - when[0])
    else:
        _, first = np.unique(A.reshape(len(A), 16), axis=0, return_index=True)
        first = np.sort(first)
    count = len(first)
    if count > MOST_POSES:
        chosen = np.linspace(0, count - 1, MOST_POSES).round().astype(int)
        first, seconds = first[chosen], None if seconds is None else seconds[chosen]
    A = A[first]
    return se3.inverse(A) if standing == "targets" else A, seconds, count


def _medoid(poses: Array) -> int:
    """The pose with the smallest sum of distances to all others: metres over their spread, and radians."""
    t, R = poses[:, :3, 3], poses[:, :3, :3].reshape(-1, 9)
    spread = float(np.sqrt(t.var(axis=0).sum())) or 1.0
    cosine = np.clip(0.5 * (R @ R.T - 1.0), -1.0, 1.0)
    apart = np.linalg.norm(t[:, None] - t[None], axis=2) / spread + np.arccos(cosine)
    return int(np.argmin(apart.sum(axis=0)))


#: The measurements of a pair that count: B with true lengths, and what the poses predict, (n, 4, 4).
_Seen = tuple[Array, Array]


def _seen(pair: Pair, one: MeasuredRows, calibration: Calibration) -> _Seen:
    B = one.B[one.used].copy()
    B[:, :3, 3] /= _scale(calibration, pair.target)
    X, Y = calibration.X[pair.target].matrix(), calibration.Y[pair.sensor].matrix()
    return B, se3.inverse(Y[None]) @ one.A[one.used] @ X


def _scale(calibration: Calibration, target: str) -> float:
    scale = calibration.scale
    return scale.get(target, 1.0) if isinstance(scale, dict) else scale


def _sensor(camera: Camera | None, seen: list[_Seen]) -> SensorScene:
    rim = () if camera is None else tuple((x, y, z) for x, y, z in rim_of(camera).tolist())
    if not seen:
        return SensorScene(
            rim=rim, measurements=0, behind=0, distance_m=None, off_axis_deg=None, off_axis_by_poses_deg=None
        )
    t, by_poses = (np.concatenate(each)[:, :3, 3] for each in zip(*seen, strict=True))
    distance = np.linalg.norm(t, axis=1)
    return SensorScene(
        rim=rim,
        measurements=len(t),
        behind=int((t[:, 2] <= 0.0).sum()),
        distance_m=(float(distance.min()), float(np.median(distance)), float(distance.max())),
        off_axis_deg=_median_and_most(_angle(t)),
        off_axis_by_poses_deg=_median_and_most(_angle(by_poses)),
    )


def _target(pose: gtsam.Pose3, board: DrawnBoard | None, seen: list[_Seen]) -> TargetScene:
    z = pose.rotation().matrix()[:, 2]
    towards = [se3.inverse(predicted)[:, :3, 3] for _, predicted in seen]
    return TargetScene(
        board=board,
        measurements=sum(len(B) for B, _ in seen),
        tilt_deg=float(_angle(z[None])[0]),
        oblique_deg=_median_and_most(_angle(np.concatenate(towards))) if towards else None,
    )


def rim_of(camera: Camera) -> Array:
    """Unit vectors (4 EDGE, 3) to the border of a camera's image, from its top left corner clockwise.

    Where no ray leads to a point of the border, the vector is that of the last point on the way to it that has one.
    """
    w, h = float(camera.width), float(camera.height)
    corners = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h], [0.0, 0.0]]) - 0.5
    share = np.arange(EDGE)[:, None] / EDGE
    border = np.concatenate([(1.0 - share) * a + share * b for a, b in pairwise(corners)])
    centre = camera.K[:2, 2]
    x = camera.undistort(border)
    low, high = np.zeros(len(border)), np.ones(len(border))
    lost = np.asarray(~np.isfinite(x).all(axis=1))
    for _ in range(20 if lost.any() else 0):
        middle = 0.5 * (low + high)
        tried = camera.undistort(centre + middle[:, None] * (border - centre))
        is_seen = np.isfinite(tried).all(axis=1)
        low, high = np.where(is_seen, middle, low), np.where(is_seen, high, middle)
        x = np.where((lost & is_seen)[:, None], tried, x)
    rays = np.column_stack([np.nan_to_num(x), np.ones(len(x))])
    unit: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return unit


def _angle(vectors: Array) -> Array:
    """Angles (n,) between vectors (n, 3) and z, degrees."""
    angles: Array = np.degrees(np.arctan2(np.linalg.norm(vectors[:, :2], axis=1), vectors[:, 2]))
    return angles


def _median_and_most(values: Array) -> tuple[float, float]:
    return float(np.median(values)), float(values.max())


def _row_of(T: Array) -> tuple[float, ...]:
    q: Any = gtsam.Rot3(T[:3, :3]).toQuaternion()  # Eigen's quaternion, which gtsam's stubs do not type
    return (*T[:3, 3].tolist(), q.w(), q.x(), q.y(), q.z())


#: The modules of tags are drawn where a board has at most this many tags, and a rig at most this many targets.
WITH_MODULES = 12
#: A board is drawn with at most this many dark parts; of more, they are spread evenly over it.
MOST_PARTS = 500
#: A circle is drawn with this many corners, and with this share of the spacing as radius: files do not state it.
CIRCLE, RADIUS = 8, 0.25
#: The paper is behind its dark parts by this share of its size, for browsers that could not tell which is in front.
BEHIND = 0.004


class DrawnBoard(FileRecord):
    """A target as it is drawn."""

    words: str  #: What it is, and its size as found
    paper: Rows  #: The corners of the paper in the target's frame, m; empty where it is not known
    dark: tuple[Rows, ...]  #: The dark parts, each a convex polygon, m


def drawn_board(
    target: Target, scale: float = 1.0, shape: BoardShape | None = None, *, is_one_of_many: bool = False
) -> DrawnBoard:
    """A target as it is drawn; of one of many the modules of its tags are left out.

    ``scale`` is its stated size over the true one, ``shape`` its warp, where it was estimated.
    """
    has_modules = not is_one_of_many and len(target.ids) <= WITH_MODULES
    paper, dark = _parts(target, has_modules)
    if len(dark) > MOST_PARTS:
        dark = [dark[i] for i in np.linspace(0, len(dark) - 1, MOST_PARTS).round().astype(int).tolist()]
    reach = float(np.linalg.norm(target.corners(), axis=1).max())
    # A bundle's tags are in no common plane.
    warp = warp_of(None if isinstance(target, Bundle) else shape)
    bent = [_bent(polygon / scale, reach / scale, warp) for polygon in dark]
    if len(paper):
        low = min((float(polygon[:, 2].min()) for polygon in bent), default=0.0)
        paper = paper / scale + [0.0, 0.0, low - BEHIND * reach]
    length = target.length_m / scale
    return DrawnBoard(
        words=f"{_kind(target)}, {_length_word(target)} {1e3 * length:.2f} mm", paper=_rows(paper), dark=_all(bent)
    )


def drawn_points(points: Array, scale: float = 1.0) -> DrawnBoard:
    """A board of which only the corners (n, 3) are known: four are a tag, more are drawn as dots."""
    points = points / scale
    if len(points) == 4:
        return DrawnBoard(words="a target with four corners", paper=(), dark=_all(_ring(points, 8)))
    size = float(np.ptp(points, axis=0).max())
    dots = [point + 0.5 * RADIUS * size / np.sqrt(len(points)) * _circle() for point in points]
    return DrawnBoard(words=f"a target with {len(points)} corners", paper=(), dark=_all(dots[:MOST_PARTS]))


def _parts(target: Target, has_modules: bool) -> tuple[Array, list[Array]]:
    """The paper (4, 3) or (0, 3), and the dark polygons, as stated."""
    with extra_named():  # a scene without tags is drawn without OpenCV
        from gtsam_rwhec.detect.tags import modules
    if isinstance(target, Tag):
        paper = square(target.size_m * (1.0 + 2.0 / modules(target.family)))
        return paper, _tag(target, target.corners(), 0, has_modules)
    if isinstance(target, Bundle | TagGrid | AprilGrid):
        corners = target.corners().reshape(-1, 4, 3)
        dark = [part for i, tag in enumerate(corners) for part in _tag(target, tag, i, has_modules)]
        return np.zeros((0, 3)) if isinstance(target, Bundle) else _around(target.corners(), 0.15), dark
    if isinstance(target, CircleGrid):
        centres, radius = target.corners(), RADIUS * target.spacing_m * (1.5 if target.asymmetric else 1.0)
        return _around(centres, target.spacing_m / np.ptp(centres, axis=0).max()), [
            centre + radius * _circle() for centre in centres
        ]
    is_charuco = isinstance(target, Charuco)
    columns, rows = (target.columns, target.rows) if is_charuco else (target.columns + 1, target.rows + 1)
    middles = grid(columns, rows, target.square_m)
    is_dark = np.add(*np.divmod(np.arange(columns * rows), columns)) % 2 == 0
    paper = 0.5 * target.square_m * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) * [columns, rows, 1]
    parts = [middle + square(target.square_m) for middle in middles[is_dark]]
    if isinstance(target, Charuco):
        markers = [middle + square(target.marker_m) for middle in middles[~is_dark]]
        parts += [part for marker in markers for part in _ring(marker, modules(target.family))]
    return paper, parts


def _tag(target: Tag | Bundle | TagGrid | AprilGrid, corners: Array, index: int, has_modules: bool) -> list[Array]:
    """The dark parts of a tag whose corners (4, 3) are top left, top right, bottom right, bottom left as printed."""
    with extra_named():
        import cv2

        from gtsam_rwhec.detect.tags import dictionary, modules
    if not has_modules:
        return [corners] if len(target.ids) > 1 else _ring(corners, modules(target.family))
    across = modules(target.family)
    picture = cv2.aruco.generateImageMarker(dictionary(target.family), target.ids[index], across)
    # Runs of dark modules: where a row begins and ends to be dark.
    edges = np.diff(np.pad((picture == 0).astype(int), ((0, 0), (1, 1))), axis=1)
    row, first = np.nonzero(edges == 1)
    _, end = np.nonzero(edges == -1)
    runs = np.stack([first, row, end, row + 1], axis=1) / across
    return [_part_of(corners, *run) for run in runs.tolist()]


def _part_of(corners: Array, left: float, top: float, right: float, bottom: float) -> Array:
    """The corners (4, 3) of a part of a square with these corners; shares from its top left corner."""
    x, y = corners[1] - corners[0], corners[3] - corners[0]
    shares = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    part: Array = corners[0] + shares @ np.stack([x, y])
    return part


def _ring(corners: Array, across: int) -> list[Array]:
    """The black border of a tag, one module wide."""
    w = 1.0 / across
    parts = ((0.0, 0.0, 1.0, w), (0.0, 1.0 - w, 1.0, 1.0), (0.0, w, w, 1.0 - w), (1.0 - w, w, 1.0, 1.0 - w))
    return [_part_of(corners, *part) for part in parts]


def _around(points: Array, share: float) -> Array:
    """The corners (4, 3) of a sheet around points in its plane, larger by a share of its size on each side."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = share * float((high - low).max())
    (a, b), (c, d) = (low - margin)[:2], (high + margin)[:2]
    return np.array([[a, d, 0.0], [c, d, 0.0], [c, b, 0.0], [a, b, 0.0]])


def _circle() -> Array:
    turn = np.linspace(0.0, 2.0 * np.pi, CIRCLE, endpoint=False)
    return np.stack([np.cos(turn), np.sin(turn), np.zeros(CIRCLE)], axis=1)


def _bent(points: Array, reach: float, warp: Array) -> Array:
    """Points of a flat board (n, 3) on the warped one, by the formula of `corner_residuals.shaped`."""
    x, y = (points[:, :2] / reach).T
    return points + np.outer(np.stack([x * x, y * y, x * y], axis=1) @ warp, [0.0, 0.0, 1.0])


def _kind(target: Target) -> str:
    words = {
        Tag: "tag", Charuco: "ChArUco board", AprilGrid: "AprilGrid", TagGrid: "grid of tags", Bundle: "bundle of tags",
        Checkerboard: "checkerboard", CircleGrid: "grid of circles",
    }  # fmt: skip
    return words[type(target)]


def _length_word(target: Target) -> str:
    if isinstance(target, Charuco | Checkerboard):
        return "square"
    return "spacing" if isinstance(target, CircleGrid) else "side"


def _rows(points: Array) -> Rows:
    return tuple((x, y, z) for x, y, z in (np.round(points, 6) + 0.0).tolist())


def _all(polygons: Sequence[Array]) -> tuple[Rows, ...]:
    return tuple(map(_rows, polygons))
