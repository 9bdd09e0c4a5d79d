"""Poses as files give them, before they are transforms: names, places, and numbers whose kind is known or stated."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.logs.records import LARGEST_M, Array, transforms

#: What a pose's numbers are: 16 of a matrix, row by row; a position and a quaternion (x, y, z, w or in an order that
#: the file does not say); a position and three angles, or OpenCV's rotation vector.
Kind = Literal["matrix", "quaternion", "quaternion_of_any_order", "angles", "rotation_vector"]
#: A rotation matrix R may differ from a rotation by this much in R'R.
ROTATION_TOLERANCE = 1e-3
#: Angles beyond a turn are degrees.
FULL_TURN = 2.0 * np.pi + 1e-6
#: Arms, tables and rooms are smaller, in metres, than this.
WORKSPACE_M = 50.0


@dataclass(frozen=True)
class PoseRow:
    """One pose as its file has it."""

    name: str  #: An image's name or a stamp; empty where the file has neither
    place: str  #: The file, and its line where it has several poses
    kind: Kind
    #: 16 of a matrix; 3 of a position, then 4 or 3 of the rotation. Angles are about x, y and z if `is_named`.
    numbers: tuple[float, ...]
    is_named: bool = False  #: Whether the file names the angles' axes
    unit_m: float | None = None  #: The position's unit in metres; None if the file does not say it


@dataclass(frozen=True)
class PoseStatement:
    """How the numbers of a file of poses are meant, where the file does not say it; None is not stated."""

    #: ``"xyzw"`` or ``"wxyz"``; a file that names no columns has x, y, z, w unless stated
    quaternion: Literal["xyzw", "wxyz"] | None = None
    #: Axes as SciPy has them (``"ZYX"`` about turning axes, ``"xyz"`` about fixed ones), or ``"rotation_vector"``
    euler: str | None = None
    angles: Literal["degrees", "radians"] | None = None
    length: Literal["m", "mm"] | None = None
    #: The order of a line's seven numbers, as ``"qw qx qy qz tx ty tz"``, in tables without names of columns
    columns: str | None = None


@dataclass(frozen=True, eq=False)
class NamedPoses:
    """Poses (N, 4, 4) in metres, with their names and places as in `PoseRow`."""

    names: tuple[str, ...]
    places: tuple[str, ...]
    T: Array


def poses_of(rows: Sequence[PoseRow], stated: PoseStatement) -> NamedPoses:
    """The transforms of rows.

    Raises
    ------
    LogError
        A row is no pose, angles without a stated convention or unit, or positions that look like millimetres. The
        message has the place, and what to write.
    """
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    for kind, made in (
        ("matrix", _of_matrices), ("quaternion", _of_quaternions), ("quaternion_of_any_order", _of_quaternions),
        ("angles", _of_angles), ("rotation_vector", _of_rotation_vectors),
    ):  # fmt: skip
        at = [i for i, row in enumerate(rows) if row.kind == kind]
        if at:
            T[at] = made([rows[i] for i in at], stated)
    units = np.array([row.unit_m or (1e-3 if stated.length == "mm" else 1.0) for row in rows])
    T[:, :3, 3] *= units[:, None]
    if stated.length is None and any(row.unit_m is None for row in rows):
        _check_workspace(T, rows)
    return NamedPoses(tuple(row.name for row in rows), tuple(row.place for row in rows), T)


def _of_matrices(rows: list[PoseRow], _: PoseStatement) -> Array:
    T = np.array([row.numbers for row in rows]).reshape(-1, 4, 4)
    with np.errstate(over="ignore", invalid="ignore"):
        R = T[:, :3, :3]
        off = np.abs(R.swapaxes(1, 2) @ R - np.eye(3)).max(axis=(1, 2))
        good = (off <= ROTATION_TOLERANCE) & (np.linalg.det(np.nan_to_num(R)) > 0.0) & np.isfinite(T).all(axis=(1, 2))
        good &= (np.abs(T[:, 3] - [0.0, 0.0, 0.0, 1.0]) < ROTATION_TOLERANCE).all(axis=1)
        good &= (np.abs(T[:, :3, 3]) <= LARGEST_M).all(axis=1)
    if not good.all():
        i = int(np.argmin(good))
        shape = " It has the position in the last row: transpose it." if (T[i, :3, 3] == 0.0).all() else ""
        raise LogError(
            f"{rows[i].place}: {T[i].tolist()} is no transform: its first three columns must be a rotation, and its "
            f"last row 0 0 0 1.{shape}"
        )
    T[:, :3, :3] = Rotation.from_matrix(R).as_matrix()  # R'R = 1 to the last digit
    T[:, 3] = [0.0, 0.0, 0.0, 1.0]
    return T


def _of_quaternions(rows: list[PoseRow], stated: PoseStatement) -> Array:
    numbers = np.array([row.numbers for row in rows])
    order = [3, 4, 5, 6]
    if rows[0].kind == "quaternion_of_any_order" and stated.quaternion == "wxyz":
        order = [4, 5, 6, 3]
    T, faults = transforms(numbers[:, :3], numbers[:, order])
    for i, fault in faults.items():
        cure = ""
        if "norm" in fault and rows[i].kind == "quaternion_of_any_order" and stated.euler is None:
            cure = (
                " If the numbers after the position are three angles, write euler: AXES (such as ZYX) and "
                "angles: degrees or radians where the rig file has the frames."
            )
        raise LogError(f"{rows[i].place}: {fault}.{cure}")
    return T


def _of_angles(rows: list[PoseRow], stated: PoseStatement) -> Array:
    if stated.euler is None:
        raise LogError(
            f"{rows[0].place}: three angles, and their convention is not stated. Write it where the rig file has the "
            "frames, {frames: [...], euler: ZYX, angles: degrees}: the axes in the order of the turns, capitals for "
            "turning axes and small letters for fixed ones, or rotation_vector"
        )
    if stated.angles is None:
        raise LogError(f"{rows[0].place}: angles without a unit. Write angles: degrees or angles: radians beside euler")
    numbers = np.array([row.numbers for row in rows])
    angles = numbers[:, 3:]
    if not np.isfinite(numbers).all():
        i = int(np.argmin(np.isfinite(numbers).all(axis=1)))
        raise LogError(f"{rows[i].place}: {list(rows[i].numbers)} is not finite")
    if stated.angles == "degrees":
        angles = np.radians(angles)
    elif (np.abs(angles) > FULL_TURN).any():
        i = int(np.argmax((np.abs(angles) > FULL_TURN).any(axis=1)))
        raise LogError(
            f"{rows[i].place}: angles {angles[i].tolist()} are more than a turn in radians. Are they degrees? "
            "Write angles: degrees"
        )
    if stated.euler == "rotation_vector":
        turned = Rotation.from_rotvec(angles)
    else:
        if rows[0].is_named:  # about x, y and z: in the order of the turns
            angles = angles[:, ["xyz".index(axis) for axis in stated.euler.lower()]]
        turned = Rotation.from_euler(stated.euler, angles)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = turned.as_matrix(), numbers[:, :3]
    return T


def _of_rotation_vectors(rows: list[PoseRow], stated: PoseStatement) -> Array:
    return _of_angles(rows, replace(stated, euler="rotation_vector", angles=stated.angles or "radians"))


def _check_workspace(T: Array, rows: Sequence[PoseRow]) -> None:
    """Refuse positions that are spread, or away from the origin, as millimetres are."""
    t = T[:, :3, 3]
    with np.errstate(over="ignore"):
        extent, away = float(np.ptp(t, axis=0).max()), float(np.abs(np.median(t, axis=0)).max())
    if len(rows) > 1 and max(extent, away) > WORKSPACE_M:
        far = int(np.argmax(np.abs(t - np.median(t, axis=0)).max(axis=1)))
        how = f"spread over {extent:.4g} m" if extent > WORKSPACE_M else f"{away:.4g} m from their origin"
        raise LogError(
            f"{rows[far].place}: position {t[far].tolist()}; the poses are {how} if these are "
            "metres. Are they millimetres? Write length: mm where the rig file has the frames, or length: m if it is "
            "true"
        )


def stem_of(name: str) -> str:
    """A name without folders and without the ending of an image."""
    bare = re.split(r"[/\\]", name.strip().strip("\"'"))[-1]
    return re.sub(r"\.(png|jpe?g|webp|bmp|tiff?|ya?ml|json|xml|csv|tum|txt)$", "", bare, flags=re.IGNORECASE)
