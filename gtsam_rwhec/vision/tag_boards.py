"""Boards of tags without a pattern between them: grids of tags (OpenCV's GridBoard) and bundles (apriltag_ros's)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.errors import TargetError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.vision.target_checks import LARGEST_M, check, check_different, check_grid, grid, square

#: A quaternion's norm is 1 within this; apriltag_ros's own files have four digits.
UNIT = 0.01


@dataclass(frozen=True)
class TagGrid:
    """OpenCV's GridBoard: columns x rows tags with gaps of gap_m, and nothing in the gaps.

    Ids count from first_id at the top left, to the right, then down, unless they are listed in this order. Corners are
    the tags' corners in that order.

    Attributes
    ----------
    name : str
    family : str
        A key of `FAMILIES`.
    columns, rows : int
        Numbers of tags.
    tag_m, gap_m : float
        Side of a tag's black square, and the white gap between two tags, metres.
    first_id : int
    ids : tuple of int
        Of all tags, left to right, from the top; if it is empty, they count from `first_id`.
    """

    name: str
    family: str
    columns: int
    rows: int
    tag_m: float
    gap_m: float
    first_id: int = 0
    ids: tuple[int, ...] = ()

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
        corners: Array = (middles[:, None] + square(self.tag_m)).reshape(-1, 3)
        return corners


@dataclass(frozen=True)
class BundleTag:
    """A tag of a bundle: its id, its side, and where it is in the bundle's frame.

    Attributes
    ----------
    id : int
    size_m : float
        Side of the black square, metres.
    t_m : tuple of 3 floats
        The tag's middle in the bundle's frame, metres.
    wxyz : tuple of 4 floats
        The unit quaternion w, x, y, z that turns the tag's axes (x right, y up, z out of the paper) into the bundle's.
    """

    id: int
    size_m: float
    t_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def corners(self) -> Array:
        """(4, 3), metres, in the bundle's frame."""
        q = np.array(self.wxyz) / np.linalg.norm(self.wxyz)
        v = q[1:]
        points = square(self.size_m)
        # p + 2 w (v x p) + 2 v x (v x p)
        cross = np.cross(v, points)
        turned: Array = points + 2.0 * q[0] * cross + 2.0 * np.cross(v, cross) + np.array(self.t_m)
        return turned


@dataclass(frozen=True)
class Bundle:
    """apriltag_ros's bundle: tags at known places, in one plane or in several (the faces of a box).

    Its frame is the one in which the tags' places are given: the origin need not be in the middle. Corners are the
    tags' corners in the order of the tags.

    Attributes
    ----------
    name : str
    family : str
        A key of `FAMILIES`.
    tags : tuple of BundleTag
    """

    name: str
    family: str
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
        """The length that a scale multiplies: of the first tag, and of all others with it."""
        return self.tags[0].size_m

    def corners(self) -> Array:
        """(4 tags, 3), metres."""
        return np.concatenate([tag.corners() for tag in self.tags])
