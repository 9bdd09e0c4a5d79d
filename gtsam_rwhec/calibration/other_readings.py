"""Readings: the ways in which a user's poses may have been misread, and how each is read right.

Each reading changes A, B or their roles as its cure would. Some mistakes look alike in the data. Quaternions in the
wrong order look like C1 R^-1 C2, with constant C1 and C2; a mirrored A like a mirrored B, with other constants;
exchanged names like A and B inverted. Where the residuals cannot tell two readings apart, both are named.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from rwhec_factors.se3 import expmap, inverse, pose, so3_logmap

from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import of_rows, to_rotations
from gtsam_rwhec.problem.measurements import Pair

Rows = tuple[Array, Array]
Change = Callable[[Array], Array]


#: How to have rows shifted.
REPAIR = "CalibrateOptions(repair=True) or --repair"


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
    #: From some row on, B belongs to the A of another row.
    ROWS_SLIPPED = "rows_slipped"
    #: Angles in radians were read as degrees, or the reverse.
    ANGLE_UNIT = "angle_unit"
    #: Rotations of A or of B are Euler angles of another order or about other axes, or rotation vectors.
    EULER_AXES = "euler_axes"

    @property
    def may_be_sizes_or_clocks(self) -> bool:
        """Whether sizes that are estimated, or clocks, may look like it: directions do not tell it."""
        return self in (Mistake.UNIT, Mistake.SCALE, Mistake.ROWS_SHIFTED)

    @property
    def is_of_rotations(self) -> bool:
        """Whether angles of another convention look like it."""
        return self in (Mistake.QUATERNION_ORDER, Mistake.TRANSPOSED, Mistake.HANDEDNESS, Mistake.EULER_AXES)


@dataclass(frozen=True)
class OtherReading:
    """One way to read A and B otherwise; ``changed`` takes A and B (N, 4, 4) and returns them as they were meant.

    ``likely`` and ``cure`` are parts of a sentence: what was misread, and what to do. ``of_B``: whether B was misread;
    ``inverts_A``: whether A, alone, is the inverse of what was meant.
    """

    mistake: Mistake
    likely: str
    cure: str
    changed: Callable[[Array, Array], Rows]
    of_B: bool = False
    inverts_A: bool = False
    exchanges_roles: bool = False
    shift: int = 0
    of_small_angles: bool = False

    def pair(self, pair: Pair) -> Pair:
        """The pair as it was meant."""
        return Pair(pair.sensor, pair.target) if self.exchanges_roles else pair


def _transposed(T: Array) -> Array:
    return pose(T[:, :3, :3].transpose(0, 2, 1), T[:, :3, 3])


def mirrored(T: Array) -> Array:
    """Poses in a frame of the other handedness: mirrored at the origin, R stays and t changes its sign.

    Mirroring at a plane is the same up to constant rotations of both frames.
    """
    return pose(T[:, :3, :3], -T[:, :3, 3])


def _reordered(columns: list[int]) -> Change:
    def reordered(T: Array) -> Array:
        xyzw = of_rows(T[:, :3, :3].transpose(2, 1, 0).reshape(9, -1)).T
        return pose(to_rotations(xyzw[:, columns]), T[:, :3, 3])

    return reordered


def of_sides(sides: str, change: Change) -> Callable[[Array, Array], Rows]:
    """The change of "A", of "B" or of "A and B"."""
    return lambda A, B: (change(A) if "A" in sides else A, change(B) if "B" in sides else B)


#: In xyzw, the right columns of rows x, y, z, w that were read as w first (what was taken for w is x, and so on), and
#: of rows w, x, y, z that were read as x first.
_REORDERED = (("xyzw", "wxyz", [3, 0, 1, 2]), ("wxyz", "xyzw", [1, 2, 3, 0]))
_QUATERNIONS = [
    OtherReading(
        Mistake.QUATERNION_ORDER,
        f"the quaternions of {sides} are {given}, and were read as {read}",
        f"read {sides} with order={given!r} (CSV files have w first)",
        of_sides(sides, _reordered(columns)),
        of_B="B" in sides,
    )
    for given, read, columns in _REORDERED
    for sides in ("A", "B", "A and B")
]
A_INVERTED, _B_INVERTED, _BOTH_INVERTED = (
    OtherReading(Mistake.INVERTED, likely, cure, of_sides(sides, inverse), of_B="B" in sides, inverts_A=sides == "A")
    for sides, likely, cure in (
        (
            "A",
            "A is inverted (the poses of the base and the hand are exchanged)",
            "give A = T_sensorcarrier_targetcarrier: the inverse of each pose in A",
        ),
        (
            "B",
            "B is inverted",
            "give B = T_sensor_target, the target's pose in the sensor's frame: the inverse of each pose in B",
        ),
        ("A and B", "A and B are both inverted", "give the inverse of each pose in A and in B"),
    )
)
#: The poses as they are; with a free scale it tells a wrong unit.
AS_READ = OtherReading(Mistake.UNIT, "", "", lambda A, B: (A, B))
_ROLES = OtherReading(
    Mistake.ROLES_EXCHANGED,
    "targets and sensors are exchanged",
    "name the targets as targets and the sensors as sensors: problem.add(target, sensor, A, B)",
    lambda A, B: (A, B),
    exchanges_roles=True,
)
_TRANSPOSED = [
    OtherReading(
        Mistake.TRANSPOSED,
        f"the rotations of {side} are transposed (rows for columns, or quaternions of the JPL convention)",
        f"transpose the rotation matrices of {side}, and keep its translations",
        of_sides(side, _transposed),
        of_B=side == "B",
    )
    for side in "AB"
]
HANDEDNESS = OtherReading(
    Mistake.HANDEDNESS,
    "one of A and B is from a left-handed frame",
    "mirror the poses of the one that is left-handed: M T M with M = diag(1, -1, 1, 1)",
    of_sides("A", mirrored),
)


def shifted(shift: int) -> OtherReading:
    """Rows of B that are ``shift`` behind those of A; positive: A's row i belongs to B's row i + shift."""
    n, rows = abs(shift), "row" if abs(shift) == 1 else "rows"
    first, second = ("B", "A") if shift > 0 else ("A", "B")
    return OtherReading(
        Mistake.ROWS_SHIFTED,
        f"the rows of {first} come {n} {rows} later than those of {second}, or the clocks differ by as much",
        f"leave out the first {n} {rows} of {first} and the last {n} of {second}, in each pair, or let the rows be "
        f"shifted: {REPAIR}; or give stamps and estimate the time offsets",
        lambda A, B: (A, B),
        shift=shift,
    )


#: The simple mistakes, the more common first.
SINGLE: tuple[OtherReading, ...] = (
    *_QUATERNIONS, A_INVERTED, _B_INVERTED, _ROLES, _BOTH_INVERTED, *_TRANSPOSED, HANDEDNESS,
)  # fmt: skip


def _joined(first: OtherReading, second: OtherReading) -> OtherReading:
    return replace(
        second,
        mistake=first.mistake,
        likely=f"{first.likely}, and {second.likely}",
        cure=f"{first.cure}; {second.cure}",
        changed=lambda A, B: second.changed(*first.changed(A, B)),
        of_B=first.of_B or second.of_B,
    )


#: Two mistakes at once: the order of quaternions and a direction.
DOUBLE = tuple(_joined(first, second) for first in _QUATERNIONS for second in (A_INVERTED, _B_INVERTED, _ROLES))


#: Rotations of less than half a turn in degrees that were taken for radians, about one axis: 180 / 57.3 degrees.
SMALL_RAD = np.pi / np.degrees(1.0)
#: Three Euler angles may each be as large.
SMALL_EULER_RAD = 1.8 * SMALL_RAD
#: With fewer measurements, a pair's 18 unknowns of S P a = Q a are not well determined.
FEWEST_AXES = 8


def _rotations(omega: Array) -> Array:
    """Rotations (N, 3, 3) of rotation vectors (N, 3)."""
    R: Array = expmap(np.concatenate([omega, np.zeros_like(omega)], axis=1))[:, :3, :3]
    return R


def stretched(T: Array) -> Array:
    """Poses whose rotation vectors were in radians, and were divided by 57.3 as degrees are."""
    return pose(_rotations(np.degrees(so3_logmap(T[:, :3, :3]))), T[:, :3, 3])


def stretched_euler(order: tuple[int, ...]) -> Change:
    """The same for Euler angles about three axes (0, 1, 2 for x, y, z), each about the axes as turned before."""
    i, j, k = order
    sign = 1.0 if order in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else -1.0

    def change(T: Array) -> Array:
        R = T[:, :3, :3]
        # R = R_i(a) R_j(b) R_k(c): the entry (i, k) is the sine of b, and its row and column have a and c.
        b = np.arcsin(np.clip(sign * R[:, i, k], -1.0, 1.0))
        a = np.arctan2(-sign * R[:, j, k], R[:, k, k])
        c = np.arctan2(-sign * R[:, i, j], R[:, i, i])
        axes = np.eye(3)
        turns = [_rotations(np.degrees(angle)[:, None] * axes[axis]) for angle, axis in ((a, i), (b, j), (c, k))]
        return pose(turns[0] @ turns[1] @ turns[2], T[:, :3, 3])

    return change


def unwound(T: Array, other: Array) -> Array:
    """Poses whose rotation vectors were in degrees, and were taken for radians; ``other`` are the right ones beside.

    For A it is B, and for B it is A. Poses that cannot be unwound stay as they are.
    """
    if len(T) < FEWEST_AXES:
        return T
    omega = so3_logmap(T[:, :3, :3])
    angle = np.linalg.norm(omega, axis=1)
    axis = omega / np.maximum(angle, 1e-12)[:, None]
    S = other[:, :3, :3]
    # S P a = Q a, with S the other side's rotation. Where T is A, P is R_X' and Q is R_Y'; where T is B, P is R_X and Q
    # is R_Y: 18 unknowns up to a factor.
    of_P = np.einsum("nrp,nq->nrpq", S, axis).reshape(-1, 9)
    of_Q = np.einsum("rp,nq->nrpq", np.eye(3), axis).reshape(-1, 9)
    null = np.linalg.svd(np.concatenate([of_P, -of_Q], axis=1), full_matrices=False)[2][-1].reshape(2, 3, 3)
    left, _, right = np.linalg.svd(null * np.sign(np.linalg.det(null[0])))
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    P, Q = left @ right
    expected = np.einsum("ni,ni->n", so3_logmap(Q.T @ S @ P), axis)
    # The true angle is (angle + whole turns) degrees.
    turns = np.round((np.degrees(expected) - angle) / (2.0 * np.pi))
    return pose(_rotations(np.radians(angle + 2.0 * np.pi * turns)[:, None] * axis), T[:, :3, 3])


def readings_of_angles(A: Array, B: Array) -> Iterator[OtherReading]:
    """The readings that angles in the wrong unit leave to try, for poses (N, 4, 4) of all pairs."""
    for side, T in (("A", A), ("B", B)):
        largest = float(np.linalg.norm(so3_logmap(T[:, :3, :3]), axis=1).max())
        small: list[tuple[str, Change]] = []
        if largest <= SMALL_RAD * (1.0 + 1e-6):
            small.append((f"do not convert the rotation vectors of {side}: they are in radians", stretched))
        if largest <= SMALL_EULER_RAD:
            for order in itertools.permutations(range(3)):
                letters = "".join("XYZ"[axis] for axis in order)
                cure = f"do not convert the Euler angles of {side}: they are in radians (intrinsic {letters})"
                small.append((cure, stretched_euler(order)))
        likely = f"the angles of {side} are in radians, and were read as degrees"
        for cure, change in small:
            yield OtherReading(
                Mistake.ANGLE_UNIT, likely, cure, of_sides(side, change), of_B=side == "B", of_small_angles=True
            )
        if not small:
            yield OtherReading(
                Mistake.ANGLE_UNIT,
                f"the rotation vectors of {side} are in degrees, and were read as radians",
                f"convert the rotation vectors of {side} to radians",
                (lambda A, B: (unwound(A, B), B)) if side == "A" else (lambda A, B: (A, unwound(B, A))),
                of_B=side == "B",
            )


#: The number of each unit in a metre.
UNITS = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 1.0 / 0.0254, "feet": 1.0 / 0.3048}
#: A scale within this share of a unit's number is that unit.
UNIT_SHARE = 0.03
#: A scale this close to 1 is no misreading: a size may be wrong by as much, which ``sizes`` tests.
NO_MISREADING = 0.1
#: Median lengths above this (m) are of another unit: few carriers move so far, and few sensors see so far.
LONG_M = 30.0


@dataclass(frozen=True)
class WrongUnit:
    """Which lengths are in another unit, or wrong by a factor, in words; ``of_B`` divides B's lengths as given."""

    mistake: Mistake
    likely: str
    cure: str
    of_B: float


def wrong_unit(scale: float, median_A: float, median_B: float, *, from_corners: bool = False) -> WrongUnit | None:
    """What an estimated scale (lengths in B over those in A) says; None where it is about 1, or not positive.

    ``median_A`` and ``median_B`` are median lengths of the translations as given: the long ones are of another unit.
    ``from_corners``: B is made of corners, so that its unit is that of board_points.
    """
    if not scale > 0.0 or abs(scale - 1.0) < NO_MISREADING:
        return None
    longer, shorter, median = ("B", "A", median_B) if scale > 1.0 else ("A", "B", median_A)
    ratio = max(scale, 1.0 / scale)
    unit, number = min(UNITS.items(), key=lambda item: abs(ratio / item[1] - 1.0))
    if abs(ratio / number - 1.0) > UNIT_SHARE:
        return WrongUnit(
            Mistake.SCALE,
            f"lengths in B are {rounded(scale, 4)} times the true ones, and were said to be true (scale='known')",
            "measure the targets again and state their true sizes, or let the scale be estimated (scale='shared')",
            scale,
        )
    likely = f"lengths in {longer} are {rounded(ratio, 4)} times those in {shorter}: "
    if not (median > LONG_M or number < 1000.0):
        cure = f"give metres: multiply the translations of {shorter} by {rounded(number, 4)}"
        of_B = 1.0 / number if shorter == "B" else 1.0
        return WrongUnit(Mistake.UNIT, f"{likely}those of {shorter} are too small", cure, of_B)
    likely += f"board_points are in {unit}" if from_corners and longer == "B" else f"{longer} is in {unit}"
    cure = f"give metres: divide the translations of {longer} by {rounded(number, 4)}"
    if from_corners and longer == "B":
        cure = f"give board_points in metres: divide them by {rounded(number, 4)}"
    return WrongUnit(Mistake.UNIT, likely, cure, number if longer == "B" else 1.0)
