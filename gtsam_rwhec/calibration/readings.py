"""Readings: the ways in which a user's poses may have been misread, and how each is read right.

Each reading changes A, B or their roles as its cure would. Some mistakes are one mistake to the data. A quaternion in
the wrong order is the inverse rotation between two constant ones; a mirrored A is a mirrored B with other constants;
names exchanged are both poses inverted. Where the residuals cannot tell two readings apart, both are named.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from rwhec_factors.se3 import inverse, pose

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import of_rows, to_rotations
from gtsam_rwhec.problem.pairs import Pair

Rows = tuple[Array, Array]


class Mistake(StrEnum):
    """What was likely misread."""

    #: Quaternions of A, of B or of both were read in the wrong order.
    QUATERNION_ORDER = "quaternion_order"
    #: A, B or both are the inverse of what was meant; for A: the base's and the hand's pose are exchanged.
    INVERTED = "inverted"
    #: Rotations of A or of B are transposed: rows for columns, or quaternions of the other convention (JPL).
    TRANSPOSED = "transposed"
    #: Targets were named as sensors, and sensors as targets.
    ROLES_EXCHANGED = "roles_exchanged"
    #: A or B is from a left-handed frame.
    HANDEDNESS = "handedness"
    #: A or B is in another unit than metres.
    UNIT = "unit"
    #: Lengths in B are wrong by a factor, though they were said to be true.
    SCALE = "scale"
    #: Rows of A and B are shifted against each other.
    ROWS_SHIFTED = "rows_shifted"
    #: Angles in radians were read as degrees, or the reverse.
    ANGLE_UNIT = "angle_unit"


@dataclass(frozen=True)
class Reading:
    """One way to read A and B otherwise; ``changed`` takes A and B (N, 4, 4) and returns them as they were meant.

    ``likely`` and ``cure`` are parts of a sentence: what was misread, and what to do.
    """

    mistake: Mistake
    likely: str
    cure: str
    changed: Callable[[Array, Array], Rows]
    exchanges_roles: bool = False
    shift: int = 0
    of_small_angles: bool = False

    def pair(self, pair: Pair) -> Pair:
        """The pair as it was meant."""
        return Pair(pair.sensor, pair.target) if self.exchanges_roles else pair


def _unchanged(T: Array) -> Array:
    return T


def _inverted(T: Array) -> Array:
    return inverse(T)


def _transposed(T: Array) -> Array:
    return pose(T[:, :3, :3].transpose(0, 2, 1), T[:, :3, 3])


def mirrored(T: Array) -> Array:
    """Poses in a frame of the other handedness: mirrored at the origin, R stays and t changes its sign.

    Mirroring at a plane is the same up to constant rotations of both frames.
    """
    return pose(T[:, :3, :3], -T[:, :3, 3])


def _reordered(columns: list[int]) -> Callable[[Array], Array]:
    def reordered(T: Array) -> Array:
        xyzw = of_rows(T[:, :3, :3].transpose(2, 1, 0).reshape(9, -1)).T
        return pose(to_rotations(xyzw[:, columns]), T[:, :3, 3])

    return reordered


#: Rows x, y, z, w were read as w first: what was taken for w is x, and so on. In xyzw, the right ones.
_XYZW_READ_AS_WXYZ = _reordered([3, 0, 1, 2])
#: Rows w, x, y, z were read as x first.
_WXYZ_READ_AS_XYZW = _reordered([1, 2, 3, 0])

_SIDES = (("A",), ("B",), ("A", "B"))


def _of_sides(sides: tuple[str, ...], change: Callable[[Array], Array]) -> Callable[[Array, Array], Rows]:
    of_A, of_B = (change if side in sides else _unchanged for side in "AB")
    return lambda A, B: (of_A(A), of_B(B))


def _quaternions() -> list[Reading]:
    found = []
    for given, read, change in (("xyzw", "wxyz", _XYZW_READ_AS_WXYZ), ("wxyz", "xyzw", _WXYZ_READ_AS_XYZW)):
        for sides in _SIDES:
            found.append(
                Reading(
                    Mistake.QUATERNION_ORDER,
                    f"the quaternions of {' and '.join(sides)} are {given}, and were read as {read}",
                    f"read {' and '.join(sides)} with order={given!r} (CSV files have w first)",
                    _of_sides(sides, change),
                )
            )
    return found


A_INVERTED = Reading(
    Mistake.INVERTED,
    "A is inverted (the poses of the base and the hand are exchanged)",
    "give A = T_sensorcarrier_targetcarrier: the inverse of each pose in A",
    _of_sides(("A",), _inverted),
)
_INVERTED = [
    A_INVERTED,
    Reading(
        Mistake.INVERTED,
        "B is inverted",
        "give B = T_sensor_target, the target's pose in the sensor's frame: the inverse of each pose in B",
        _of_sides(("B",), _inverted),
    ),
]
_BOTH_INVERTED = Reading(
    Mistake.INVERTED,
    "A and B are both inverted",
    "give the inverse of each pose in A and in B",
    _of_sides(("A", "B"), _inverted),
)
#: The poses as they are; with a free scale it tells a wrong unit.
AS_READ = Reading(Mistake.UNIT, "", "", lambda A, B: (A, B))
_ROLES = Reading(
    Mistake.ROLES_EXCHANGED,
    "targets and sensors are exchanged",
    "name the targets as targets and the sensors as sensors: problem.add(target, sensor, A, B)",
    lambda A, B: (A, B),
    exchanges_roles=True,
)
_TRANSPOSED = [
    Reading(
        Mistake.TRANSPOSED,
        f"the rotations of {side} are transposed (rows for columns, or quaternions of the JPL convention)",
        f"transpose the rotation matrices of {side}, and keep its translations",
        _of_sides((side,), _transposed),
    )
    for side in "AB"
]
HANDEDNESS = Reading(
    Mistake.HANDEDNESS,
    "one of A and B is from a left-handed frame",
    "mirror the poses of the one that is left-handed: M T M with M = diag(1, -1, 1, 1)",
    _of_sides(("A",), mirrored),
)


def shifted(shift: int) -> Reading:
    """Rows of B that are ``shift`` behind those of A; positive: A's row i belongs to B's row i + shift."""
    n, rows = abs(shift), "row" if abs(shift) == 1 else "rows"
    first, second = ("B", "A") if shift > 0 else ("A", "B")
    return Reading(
        Mistake.ROWS_SHIFTED,
        f"the rows of {first} come {n} {rows} later than those of {second}, or the clocks differ by as much",
        f"leave out the first {n} {rows} of {first} and the last {n} of {second}, in each pair; or give stamps and "
        "estimate the time offsets",
        lambda A, B: (A, B),
        shift=shift,
    )


#: The simple mistakes, the more common first.
SINGLE: tuple[Reading, ...] = (*_quaternions(), *_INVERTED, _ROLES, _BOTH_INVERTED, *_TRANSPOSED, HANDEDNESS)


def _joined(first: Reading, second: Reading) -> Reading:
    def changed(A: Array, B: Array) -> Rows:
        return second.changed(*first.changed(A, B))

    return Reading(
        first.mistake,
        f"{first.likely}, and {second.likely}",
        f"{first.cure}; {second.cure}",
        changed,
        exchanges_roles=second.exchanges_roles,
    )


#: Two mistakes at once: the order of quaternions and a direction.
DOUBLE: tuple[Reading, ...] = tuple(
    _joined(first, second) for first in _quaternions() for second in (*_INVERTED, _ROLES)
)
