"""Targets and the places of their corners: tags, boards of tags, checkerboards and grids of circles.

``bias_px`` is the standard deviation of what all its corners share as our detector finds them, pixels: the largest mean
error along an axis in rendered images (`benchmarks/rendered_boards.py`).

All targets have the same frame: the origin is the middle of the tag or of the board's pattern, x points to the right
and y up as printed, z out of the paper. OpenCV orders a tag's corners: top left, top right, bottom right, bottom left.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import numpy as np

from gtsam_rwhec.errors import TargetError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import to_rotations

#: Each family has this number of tags.
FAMILIES: dict[str, int] = {
    "tag16h5": 30, "tag25h9": 35, "tag36h10": 2320, "tag36h11": 587,
    **{f"aruco_{n}x{n}_{count}": count for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "aruco_original": 1024, "aruco_mip_36h12": 250,
}  # fmt: skip
#: Lengths of targets must be below this (m), since longer lengths are probably millimetres.
LARGEST_M = 10.0


def square(side_m: float) -> Array:
    """Corners (4, 3) of a square about the origin, in the order top left, top right, bottom right, bottom left."""
    return 0.5 * side_m * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


def grid(columns: int, rows: int, step_m: float) -> Array:
    """Points (columns rows, 3) of a grid about the origin, left to right, from the top."""
    x, y = np.meshgrid(np.arange(columns) - 0.5 * (columns - 1), 0.5 * (rows - 1) - np.arange(rows))
    return step_m * np.stack([x.ravel(), y.ravel(), np.zeros(columns * rows)], axis=1)


def check(name: str, family: str | None, ids: tuple[int, ...], lengths: dict[str, float]) -> None:
    """Raise `TargetError` if there is no such family, if ids are not in it, or if a length is not valid."""
    if family is not None:
        if family not in FAMILIES:
            raise TargetError(f"there is no family {family!r}; there are {', '.join(FAMILIES)}", name)
        if min(ids) < 0 or max(ids) >= FAMILIES[family]:
            raise TargetError(f"ids {min(ids)} to {max(ids)} are not in {family}: 0 to {FAMILIES[family] - 1}", name)
    for word, length in lengths.items():
        if not 0.0 < length < LARGEST_M:
            raise TargetError(f"{word} = {length!r}; give metres, above 0 and below {LARGEST_M:g}", name)


def check_different(name: str, ids: tuple[int, ...]) -> None:
    """Raise `TargetError` if an id is there twice."""
    twice = sorted({i for i in ids if ids.count(i) > 1})
    if twice:
        raise TargetError(f"id {twice[0]} is there {ids.count(twice[0])} times; each tag needs its own", name)


def check_grid(name: str, columns: int, rows: int, least: int) -> None:
    """Raise `TargetError` if a grid has too few or too many columns or rows."""
    if not (least <= columns <= 100 and least <= rows <= 100):
        raise TargetError(f"{columns} columns and {rows} rows; each must be {least} to 100", name)


#: A quaternion's norm may differ from 1 by this much: apriltag_ros's own files have four digits.
UNIT = 0.01


@dataclass(frozen=True)
class TagGrid:
    """OpenCV's GridBoard: columns x rows tags with gaps of gap_m, and nothing in the gaps.

    Ids count from first_id at the top left, to the right, then down, unless they are listed in this order. Corners are
    the tags' corners in that order.
    """

    bias_px: ClassVar[float] = 0.004
    name: str
    family: str  #: A key of `FAMILIES`
    #: Numbers of tags
    columns: int
    rows: int
    #: Side of a tag's black square, and the white gap between two tags, metres
    tag_m: float
    gap_m: float
    first_id: int = 0
    ids: tuple[int, ...] = ()  #: Of all tags, left to right, from the top; if it is empty, they count from `first_id`

    def __post_init__(self) -> None:
        check_grid(self.name, self.columns, self.rows, 1)
        count = self.columns * self.rows
        if not self.ids:
            object.__setattr__(self, "ids", tuple(range(self.first_id, self.first_id + count)))
        elif self.first_id:
            raise TargetError("both first_id and ids; give one of them", self.name)
        if len(self.ids) != count:
            words = f"{self.columns} x {self.rows} tags need {count} ids, and ids has {len(self.ids)}"
            raise TargetError(f"{words}; list all, left to right, from the top", self.name)
        check(self.name, self.family, self.ids, {"tag_m": self.tag_m, "gap_m": self.gap_m})
        check_different(self.name, self.ids)

    @property
    def length_m(self) -> float:
        """The length that a scale multiplies."""
        return self.tag_m

    def corners(self) -> Array:
        """(4 columns rows, 3), metres."""
        middles = grid(self.columns, self.rows, self.tag_m + self.gap_m)
        return (middles[:, None] + square(self.tag_m)).reshape(-1, 3)


@dataclass(frozen=True)
class BundleTag:
    """A tag of a bundle: its id, its side, and where it is in the bundle's frame."""

    id: int
    size_m: float  #: Side of the black square, metres
    t_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  #: The tag's middle in the bundle's frame, metres
    #: The unit quaternion w, x, y, z that turns the tag's axes (x right, y up, z out of the paper) into the bundle's
    wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def corners(self) -> Array:
        """(4, 3), metres, in the bundle's frame."""
        R = to_rotations(np.array([*self.wxyz[1:], self.wxyz[0]]))
        return np.asarray(square(self.size_m) @ R.T + np.array(self.t_m))


@dataclass(frozen=True)
class Bundle:
    """apriltag_ros's bundle: tags at known places, in one plane or in several (the faces of a box).

    Its frame is the one in which the tags' places are given: the origin need not be in the middle. Corners are the
    tags' corners in the order of the tags.
    """

    bias_px: ClassVar[float] = 0.01
    name: str
    family: str  #: A key of `FAMILIES`
    tags: tuple[BundleTag, ...]

    def __post_init__(self) -> None:
        if not self.tags:
            raise TargetError("a bundle without tags; give its layout", self.name)
        for tag in self.tags:
            check(self.name, self.family, (tag.id,), {f"size of tag {tag.id}": tag.size_m})
            if not all(abs(value) < LARGEST_M for value in tag.t_m):
                raise TargetError(f"tag {tag.id} is at {tag.t_m}; give metres, below {LARGEST_M:g}", self.name)
            norm = float(np.linalg.norm(tag.wxyz))
            if not abs(norm - 1.0) <= UNIT:
                words = f"the quaternion of tag {tag.id} has norm {norm:.4g}"
                raise TargetError(f"{words}; give qw, qx, qy, qz of norm 1", self.name)
        check_different(self.name, self.ids)

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the tags."""
        return tuple(tag.id for tag in self.tags)

    @property
    def length_m(self) -> float:
        """The length that a scale multiplies: the first tag's side; all other lengths scale with it."""
        return self.tags[0].size_m

    def corners(self) -> Array:
        """(4 tags, 3), metres."""
        return np.concatenate([tag.corners() for tag in self.tags])


#: Corners of a printed circle grid that can have the larger dot.
CORNERS = ("lower_left", "lower_right", "upper_left", "upper_right")


@dataclass(frozen=True)
class Tag:
    """A single tag."""

    bias_px: ClassVar[float] = 0.01
    name: str
    family: str  #: A key of `FAMILIES`
    id: int
    size_m: float  #: Side of the black square, metres

    def __post_init__(self) -> None:
        check(self.name, self.family, (self.id,), {"size_m": self.size_m})

    @property
    def ids(self) -> tuple[int, ...]:
        """The id, as a tuple."""
        return (self.id,)

    @property
    def length_m(self) -> float:
        """The length that a scale multiplies."""
        return self.size_m

    def corners(self) -> Array:
        """(4, 3), metres."""
        return square(self.size_m)


@dataclass(frozen=True)
class Charuco:
    """A ChArUco board of columns x rows squares, with markers in the white squares, numbered from first_id.

    Its corners are the inner corners of the chessboard in OpenCV's order: left to right, from the top.
    """

    bias_px: ClassVar[float] = 0.002
    name: str
    family: str  #: A key of `FAMILIES`
    #: Numbers of squares
    columns: int
    rows: int
    #: Sides of a square and of a marker, metres
    square_m: float
    marker_m: float
    first_id: int = 0  #: The markers' ids are first_id, first_id + 1 and so on

    def __post_init__(self) -> None:
        check_grid(self.name, self.columns, self.rows, 2)
        check(self.name, self.family, self.ids, {"square_m": self.square_m, "marker_m": self.marker_m})
        if not self.marker_m < self.square_m:
            raise TargetError(f"marker_m = {self.marker_m:g} must be less than square_m = {self.square_m:g}", self.name)

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the markers."""
        return tuple(range(self.first_id, self.first_id + self.columns * self.rows // 2))

    @property
    def length_m(self) -> float:
        """The length that a scale multiplies."""
        return self.square_m

    def corners(self) -> Array:
        """((columns - 1) (rows - 1), 3), metres."""
        return grid(self.columns - 1, self.rows - 1, self.square_m)


@dataclass(frozen=True)
class AprilGrid:
    """Kalibr's AprilGrid: columns x rows tags with a double black border, spacing = gap / tag_m.

    Ids count from first_id at the bottom left, to the right, then up. Corners are the tags' corners in that order.
    """

    bias_px: ClassVar[float] = 0.002
    name: str
    family: str  #: A key of `FAMILIES`
    #: Numbers of tags
    columns: int
    rows: int
    tag_m: float  #: Side of a tag's black square, metres
    spacing: float  #: Gap between tags over tag_m
    first_id: int = 0

    def __post_init__(self) -> None:
        check_grid(self.name, self.columns, self.rows, 1)
        check(self.name, self.family, self.ids, {"tag_m": self.tag_m})
        if not 0.0 < self.spacing <= 10.0:
            raise TargetError(
                f"spacing = {self.spacing!r}; give gap / tag size, above 0 and at most 10 (Kalibr's default is 0.3)",
                self.name,
            )

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the tags."""
        return tuple(range(self.first_id, self.first_id + self.columns * self.rows))

    @property
    def length_m(self) -> float:
        """The length that a scale multiplies."""
        return self.tag_m

    def corners(self) -> Array:
        """(4 columns rows, 3), metres; rows of tags from the bottom."""
        middles = grid(self.columns, self.rows, self.tag_m * (1.0 + self.spacing))
        from_below = middles.reshape(self.rows, self.columns, 3)[::-1].reshape(-1, 1, 3)
        return (from_below + square(self.tag_m)).reshape(-1, 3)


@dataclass(frozen=True)
class Checkerboard:
    """A checkerboard of columns x rows inner corners, numbered left to right, from the top.

    If columns and rows are both even or both odd, the board looks the same turned by half a turn (or by quarters, see
    `ways`): only the motion shows its orientation in each image.
    """

    bias_px: ClassVar[float] = 0.002
    name: str
    #: Numbers of inner corners
    columns: int
    rows: int
    square_m: float  #: Side of a square, metres
    family: ClassVar[str] = "checkerboard"
    ids: ClassVar[tuple[int, ...]] = ()

    def __post_init__(self) -> None:
        check_grid(self.name, self.columns, self.rows, 3)
        check(self.name, None, (), {"square_m": self.square_m})

    @property
    def ways(self) -> int:
        """In how many orientations the board looks the same: 2 (half turns), 4 (quarter turns), or 1.

        With columns and rows both even, the four outermost squares have one colour; both odd, opposite ones have.
        """
        if (self.columns + self.rows) % 2 == 1:
            return 1
        return 4 if self.columns == self.rows and self.columns % 2 == 0 else 2

    @property
    def length_m(self) -> float:
        """The length that a scale multiplies."""
        return self.square_m

    def corners(self) -> Array:
        """(columns rows, 3), metres."""
        return grid(self.columns, self.rows, self.square_m)


@dataclass(frozen=True)
class CircleGrid:
    """A grid of columns x rows circles, numbered left to right, from the top.

    An asymmetric grid is OpenCV's and Kalibr's: row i, circle j is at (2 j + i % 2, i) spacings from the first, so that
    the first row begins at the left edge and every other row is shifted to the right by one spacing. The first circle
    is the upper left one as printed. Neighbours in a row are two spacings apart, diagonal ones sqrt(2).

    A grid may look the same after a turn (see `ways`): then only the motion shows its orientation.
    """

    bias_px: ClassVar[float] = 0.008
    name: str
    #: Numbers of circles: in a row, and rows. OpenCV's patternSize (4, 11) is 4 columns and 11 rows.
    columns: int
    rows: int
    #: Between the centres of neighbours, metres. In an asymmetric grid it is the distance between two rows, which is
    #: half the distance between neighbours in a row (OpenCV's square size, Kalibr's spacingMeters).
    spacing_m: float
    #: Whether one circle, at a corner, is larger; or which corner, one of `CORNERS`. True is "lower_left".
    larger_dot: bool | str = False
    asymmetric: bool = False  #: Whether every other row is shifted. Such a grid has no larger dot.
    family: ClassVar[str] = "circle_grid"
    ids: ClassVar[tuple[int, ...]] = ()

    def __post_init__(self) -> None:
        check_grid(self.name, self.columns, self.rows, 3)
        check(self.name, None, (), {"spacing_m": self.spacing_m})
        if not isinstance(self.larger_dot, bool) and self.larger_dot not in CORNERS:
            raise TargetError(f"larger_dot = {self.larger_dot!r}; give true, false or {', '.join(CORNERS)}", self.name)
        if self.asymmetric and self.larger_dot:
            raise TargetError(
                "an asymmetric grid has no larger dot: leave out larger_dot, or asymmetric if no row is shifted",
                self.name,
            )

    @property
    def corner(self) -> str:
        """The larger dot's corner as printed; empty if there is none."""
        if isinstance(self.larger_dot, bool):
            return CORNERS[0] if self.larger_dot else ""
        return self.larger_dot

    @property
    def ways(self) -> int:
        """In how many orientations the grid looks the same: 2 (half turns), 4 (quarter turns), or 1.

        A half turn of an asymmetric grid moves the first row to the last one. With an odd number of rows both begin at
        the left edge, but the turned rows begin one spacing off it: the grid looks the same in one orientation only.
        With an even number the turned rows fit. A quarter turn never fits: it moves circles to places between circles.
        """
        if self.larger_dot or (self.asymmetric and self.rows % 2 == 1):
            return 1
        return 4 if self.columns == self.rows and not self.asymmetric else 2

    def steps(self) -> Array:
        """(rows, columns, 2): each circle's place from the first one, right and down, in spacings."""
        places: Array = np.stack(np.meshgrid(np.arange(self.columns), np.arange(self.rows)), axis=-1).astype(float)
        if self.asymmetric:
            places[..., 0] = 2.0 * places[..., 0] + places[..., 1] % 2.0
        return places

    @property
    def length_m(self) -> float:
        """The length that a scale multiplies."""
        return self.spacing_m

    def corners(self) -> Array:
        """(columns rows, 3), metres: the circles' centres. The origin is the middle of their bounding box."""
        steps = self.steps().reshape(-1, 2)
        x, y = (steps - 0.5 * steps.max(axis=0)).T
        return self.spacing_m * np.stack([x, -y, np.zeros(len(steps))], axis=1)


Target: TypeAlias = Tag | Charuco | AprilGrid | TagGrid | Bundle | Checkerboard | CircleGrid


def is_same_print(first: str, second: str) -> bool:
    """Whether tags with the same id look the same in two families, given by drivers' names.

    ArUco's larger dictionaries begin with the tags of its smaller dictionaries: their sizes do not matter.
    """
    return print_of(first) == print_of(second)


def print_of(family: str) -> str:
    """The print of a family, as one word: in two families with the same word, tags with the same id look the same."""
    return re.sub(r"^(\dx\d)_\d+$", r"\1", _bare(family))


def family_named(word: str) -> str | None:
    """The family of `FAMILIES` that a driver calls by this name, or None."""
    bare = _bare(word)
    return next((family for family in (f"tag{bare}", f"aruco_{bare}") if family in FAMILIES), None)


def _bare(word: str) -> str:
    """A driver's name of a family without prefixes: 36h11 for tag36h11, tagStandard36h11 and DICT_APRILTAG_36h11."""
    return re.sub(r"^(dict_)?(apriltag_|aruco_)?(tag)?(standard)?", "", word.strip().lower())
