"""The kinds of targets that `rendered_boards` renders: how each is drawn, what must be seen, OpenCV's own detector."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import rendered_prints as prints
from rendered_prints import Array, Print
from rendered_scenes import Gray

from gtsam_rwhec.cameras.targets import (
    AprilGrid,
    Bundle,
    BundleTag,
    Charuco,
    Checkerboard,
    CircleGrid,
    Tag,
    TagGrid,
    Target,
)


@dataclass(frozen=True)
class Thing:
    """Something else that is printed: its print by pixels a unit and margin, the unit, and half its sides, metres."""

    draw: Callable[[int, float], Print]
    unit_m: float
    half_m: tuple[float, float]


@dataclass(frozen=True)
class Kind:
    """A kind of target."""

    target: Target
    draw: Callable[..., Print]  #: Of the target, the picture's pixels a unit, and the margin in units: its print
    unit_m: float  #: The unit of the drawing, metres
    #: element_m, least_px: What must be large enough (a square, a tag, a circle's cell), its least shorter seen side
    element_m: float
    least_px: float
    margins: tuple[float, float]  #: The range of the white margin, in units
    half_m: tuple[float, float]  #: Half the sides of what must be seen, metres
    peer: Callable[[Gray], object]  #: OpenCV's own detector, for its time
    ways: int = 1  #: In how many ways the target looks the same
    #: What is drawn in the target's place: then nothing may be read. Half the sides are its own.
    drawn: Target | None = None
    beside: tuple[Thing, ...] = ()  #: One or two of these are in each image too, the target over them

    def outline(self) -> Array:
        """(n, 3) along the edges of what must be seen, metres."""
        return outline_of(self.half_m)

    def elements(self) -> Array:
        """(rows, columns, 3) of the corners of elements that fill what must be seen."""
        x, y = (np.linspace(-half, half, max(round(2 * half / self.element_m), 1) + 1) for half in self.half_m)
        flat = np.stack(np.meshgrid(x, y), axis=-1)
        return np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=-1)


def outline_of(half_m: tuple[float, float], steps: int = 12) -> Array:
    """(n, 3) along the edges of a rectangle about the origin, metres."""
    share = np.linspace(-1.0, 1.0, steps, endpoint=False)
    one = np.ones(steps)
    sides = [(share, -one), (one, share), (-share, one), (-one, -share)]
    flat = np.concatenate([np.column_stack(side) for side in sides]) * half_m
    return np.column_stack([flat, np.zeros(len(flat))])


def of_checkerboard(columns: int, rows: int) -> Kind:
    board = Checkerboard("board", columns, rows, 0.03)

    def classic(gray: Gray) -> object:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
        return cv2.findChessboardCorners(gray, (columns, rows), flags=flags)

    half = (0.015 * (columns + 1), 0.015 * (rows + 1))
    return Kind(board, prints.checkerboard, 0.03, 0.03, 12.0, (0.0, 1.0), half, classic, board.ways)


def half_of(board: Checkerboard) -> tuple[float, float]:
    return 0.5 * board.square_m * (board.columns + 1), 0.5 * board.square_m * (board.rows + 1)


def in_place_of(kind: Kind, columns: int, rows: int) -> Kind:
    """A board of another size, where the rig file has this one."""
    other = Checkerboard("other", columns, rows, 0.03)
    return replace(kind, drawn=other, half_m=half_of(other), ways=1)


def things(*boards: Checkerboard) -> tuple[Thing, ...]:
    """Checkerboards, floor tiles, a ChArUco board and a keyboard."""
    charuco = Charuco("other", "aruco_4x4_100", 7, 5, 0.04, 0.03)
    tiles = Checkerboard("tiles", 24, 18, 0.015)
    keys = np.pad(np.tile(np.pad(np.ones((3, 3)), ((0, 1), (0, 1))), (5, 15)), ((1, 0), (1, 0)))
    return (
        *(Thing(partial(prints.checkerboard, board), board.square_m, half_of(board)) for board in (*boards, tiles)),
        Thing(partial(prints.charuco, charuco), 0.005, (0.14, 0.1)),
        Thing(partial(prints.drawn, keys, 0.005), 0.005, (0.0025 * keys.shape[1], 0.0025 * keys.shape[0])),
    )


def of_charuco(columns: int, rows: int) -> Kind:
    board = Charuco("board", "aruco_4x4_100", columns, rows, 0.04, 0.03)
    ids = np.arange(columns * rows // 2, dtype=np.int32)
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    detector = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard((columns, rows), 0.04, 0.03, words, ids))
    unit = board.square_m / prints.charuco_unit(board)[0]
    half = (0.02 * columns, 0.02 * rows)
    return Kind(board, prints.charuco, unit, board.square_m, 24.0, (0.0, 8.0), half, detector.detectBoard)


def _apriltags() -> Callable[[Gray], object]:
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    return cv2.aruco.ArucoDetector(words).detectMarkers


def of_aprilgrid(columns: int, rows: int) -> Kind:
    grid = AprilGrid("grid", "tag36h11", columns, rows, 0.04, 0.3)
    half = (0.02 * (1.3 * columns + 0.3), 0.02 * (1.3 * rows + 0.3))
    return Kind(grid, prints.aprilgrid, 0.004, 0.04, 24.0, (0.0, 5.0), half, _apriltags())


def of_tag() -> Kind:
    tag = Tag("tag", "tag36h11", 7, 0.08)
    return Kind(tag, prints.single_tag, 0.01, 0.08, 24.0, (1.0, 3.0), (0.04, 0.04), _apriltags())


def of_tag_grid(columns: int, rows: int) -> Kind:
    grid = TagGrid("grid", "tag36h11", columns, rows, 0.04, 0.01)
    half = (0.025 * columns - 0.005, 0.025 * rows - 0.005)
    return Kind(grid, prints.tag_grid, 0.005, 0.04, 24.0, (1.0, 4.0), half, _apriltags())


def of_flat_bundle() -> Kind:
    places = ((-0.05, 0.05), (0.05, 0.05), (-0.05, -0.05), (0.05, -0.05), (0.0, 0.0))
    bundle = Bundle("bundle", "tag36h11", tuple(BundleTag(i, 0.04, (x, y, 0.0)) for i, (x, y) in enumerate(places)))
    return Kind(bundle, prints.flat_bundle, 0.005, 0.04, 24.0, (1.0, 4.0), (0.07, 0.07), _apriltags())


def of_circles(
    columns: int, rows: int, *, larger_dot: bool = False, asymmetric: bool = False, light: bool = False
) -> Kind:
    grid = CircleGrid("grid", columns, rows, 0.03, larger_dot, asymmetric)
    flag = cv2.CALIB_CB_ASYMMETRIC_GRID if asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID

    def peer(gray: Gray) -> object:
        return cv2.findCirclesGrid(gray, (columns, rows), flags=flag)

    half = (0.015 * (2 * columns if asymmetric else columns), 0.015 * rows)
    draw = partial(prints.circle_grid, light=light)
    return Kind(grid, draw, 0.03, 0.03, 12.0, (0.0, 0.5), half, peer, grid.ways)


#: By name, what makes a kind: OpenCV's detectors are made in the process that uses them.
KINDS: dict[str, Callable[[], Kind]] = {
    "checkerboard_3x4": lambda: of_checkerboard(3, 4),
    "checkerboard_7x10": lambda: of_checkerboard(7, 10),
    "checkerboard_6x6": lambda: of_checkerboard(6, 6),
    "checkerboard_5x8": lambda: of_checkerboard(5, 8),
    "checkerboard_5x8_beside": lambda: replace(
        of_checkerboard(5, 8),
        beside=things(Checkerboard("a", 5, 7, 0.03), Checkerboard("b", 6, 8, 0.02), Checkerboard("c", 8, 6, 0.03)),
    ),
    "checkerboard_5x8_twice": lambda: replace(
        of_checkerboard(5, 8), beside=things(Checkerboard("again", 5, 8, 0.03))[:1]
    ),
    "checkerboard_5x8_is_6x8": lambda: in_place_of(of_checkerboard(5, 8), 6, 8),
    "checkerboard_5x8_is_5x9": lambda: in_place_of(of_checkerboard(5, 8), 5, 9),
    "checkerboard_5x8_is_5x7": lambda: in_place_of(of_checkerboard(5, 8), 5, 7),
    "checkerboard_3x4_is_4x4": lambda: in_place_of(of_checkerboard(3, 4), 4, 4),
    "charuco": lambda: of_charuco(7, 5),
    "aprilgrid": lambda: of_aprilgrid(6, 6),
    "tag": of_tag,
    "tag_grid": lambda: of_tag_grid(5, 7),
    "bundle": of_flat_bundle,
    "circles": lambda: of_circles(9, 7),
    "circles_larger_dot": lambda: of_circles(10, 10, larger_dot=True),
    "circles_light": lambda: of_circles(9, 7, light=True),
    "circles_asymmetric": lambda: of_circles(4, 11, asymmetric=True),
    "circles_asymmetric_light": lambda: of_circles(5, 8, asymmetric=True, light=True),
}
