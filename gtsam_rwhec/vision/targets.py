"""Targets and the places of their corners: tags, ChArUco boards, Kalibr's AprilGrids, checkerboards, grids of circles.

Grids and bundles of tags are in `tag_boards`.

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
from gtsam_rwhec.vision.tag_boards import Bundle, TagGrid
from gtsam_rwhec.vision.target_checks import FAMILIES as FAMILIES
from gtsam_rwhec.vision.target_checks import LARGEST_M as LARGEST_M
from gtsam_rwhec.vision.target_checks import check, check_grid, grid, square

#: Where a larger dot can be, as printed.
CORNERS = ("lower_left", "lower_right", "upper_left", "upper_right")


@dataclass(frozen=True)
class Tag:
    """A single tag.

    Attributes
    ----------
    name : str
    family : str
        A key of `FAMILIES`.
    id : int
    size_m : float
        Side of the black square, metres.
    """

    name: str
    family: str
    id: int
    size_m: float

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

    Attributes
    ----------
    name : str
    family : str
        A key of `FAMILIES`.
    columns, rows : int
        Numbers of squares.
    square_m, marker_m : float
        Sides of a square and of a marker, metres.
    first_id : int
        The markers' ids are first_id, first_id + 1 and so on.
    """

    name: str
    family: str
    columns: int
    rows: int
    square_m: float
    marker_m: float
    first_id: int = 0

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

    Attributes
    ----------
    name : str
    family : str
        A key of `FAMILIES`.
    columns, rows : int
        Numbers of tags.
    tag_m : float
        Side of a tag's black square, metres.
    spacing : float
        Gap between tags over tag_m.
    first_id : int
    """

    name: str
    family: str
    columns: int
    rows: int
    tag_m: float
    spacing: float
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
        corners: Array = (from_below + square(self.tag_m)).reshape(-1, 3)
        return corners


@dataclass(frozen=True)
class Checkerboard:
    """A checkerboard of columns x rows inner corners, numbered left to right, from the top.

    If columns and rows are both even or both odd, the board looks the same turned by half a turn (or by quarters, see
    `ways`): which way up it is in each image only the motion tells.

    Attributes
    ----------
    name : str
    columns, rows : int
        Numbers of inner corners.
    square_m : float
        Side of a square, metres.
    """

    name: str
    columns: int
    rows: int
    square_m: float
    family: ClassVar[str] = "checkerboard"
    ids: ClassVar[tuple[int, ...]] = ()

    def __post_init__(self) -> None:
        check_grid(self.name, self.columns, self.rows, 3)
        check(self.name, None, (), {"square_m": self.square_m})

    @property
    def ways(self) -> int:
        """In how many ways the board looks the same: turned by half a turn 2, by quarters 4, else 1.

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

    A grid may look the same turned (see `ways`): which way up it is only the motion tells.

    Attributes
    ----------
    name : str
    columns, rows : int
        Numbers of circles: in a row, and rows. OpenCV's patternSize (4, 11) is 4 columns and 11 rows.
    spacing_m : float
        Between the centres of neighbours, metres. In an asymmetric grid it is the distance between two rows, which is
        half the distance between neighbours in a row (OpenCV's square size, Kalibr's spacingMeters).
    larger_dot : bool or str
        Whether one circle, at a corner, is larger; or which corner, one of `CORNERS`. True is "lower_left".
    asymmetric : bool
        Whether every other row is shifted. Such a grid has no larger dot.
    """

    name: str
    columns: int
    rows: int
    spacing_m: float
    larger_dot: bool | str = False
    asymmetric: bool = False
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
        """In how many ways the grid looks the same: with a larger dot 1, else by half a turn 2, by quarters 4.

        Half a turn of an asymmetric grid brings the first row to the last one. With an odd number of rows both begin
        at the left edge, and then the turned rows begin one spacing off it: the grid looks the same in one way only.
        With an even number they fit. A quarter never does: it takes circles to the places between circles.
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
    """Whether tags with the same id look the same in two families, named by drivers' words.

    ArUco's larger dictionaries begin with the tags of its smaller dictionaries: their sizes do not matter.
    """
    return print_of(first) == print_of(second)


def print_of(family: str) -> str:
    """What tags of a family look like, in one word: two families with one word share the tags of each id."""
    return re.sub(r"^(\dx\d)_\d+$", r"\1", _bare(family))


def family_named(word: str) -> str | None:
    """The family of `FAMILIES` that a driver calls by this name, or None."""
    bare = _bare(word)
    return next((family for family in (f"tag{bare}", f"aruco_{bare}") if family in FAMILIES), None)


def _bare(word: str) -> str:
    """A driver's name of a family without prefixes: 36h11 for tag36h11, tagStandard36h11 and DICT_APRILTAG_36h11."""
    return re.sub(r"^(dict_)?(apriltag_|aruco_)?(tag)?(standard)?", "", word.strip().lower())
