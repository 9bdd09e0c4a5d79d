"""Poses as users give them, brought to one shape and checked.

Poses may be arrays (N, 4, 4), sequences of ``gtsam.Pose3``, or arrays (N, 7) of a quaternion of named order and a
translation. Checks run on blocks, so that memory beyond the input does not grow with N.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray
from rwhec_factors import se3

from gtsam_rwhec.errors import PoseError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.quaternions import to_rotations
from gtsam_rwhec.geometry.real_numbers import real_array

#: Arrays hold real numbers, in double precision unless a docstring says otherwise.
Array = NDArray[np.floating[Any]]
QuaternionOrder = Literal["wxyz", "xyzw"]
PoseLike = ArrayLike | gtsam.Pose3
PosesLike = ArrayLike | Sequence[gtsam.Pose3]

#: A rotation whose R'R differs by more than this from I (largest entry) is refused; a closer one is projected.
ROTATION_TOLERANCE = 1e-3
#: Larger translations (m) are refused: their squares would drown all others.
LARGEST_M = 1e15
#: Differences of R'R from I below this are rounding error, and the rotation stays as it is.
ROTATION_ROUNDING = 1e-13


def as_transforms(poses: PosesLike, order: QuaternionOrder | None, where: str) -> Array:
    """Poses as an (N, 4, 4) array; the input itself where it has this form already. Matrices' values are not checked.

    Poses may be an (N, 4, 4) array, N gtsam.Pose3, or (N, 7) rows of a quaternion of ``order`` and a translation in
    metres; ``where`` names the argument and the pair. A PoseError says what else is given.
    """
    if isinstance(poses, gtsam.Pose3):
        return poses.matrix()[None]
    if isinstance(poses, (list, tuple)) and poses and isinstance(poses[0], gtsam.Pose3):
        for index, pose in enumerate(poses):
            if not isinstance(pose, gtsam.Pose3):
                raise PoseError(
                    f"{where}: entry {index} is a {type(pose).__name__} in a list of gtsam.Pose3; "
                    "give one kind of pose in a list"
                )
        return np.array([pose.matrix() for pose in poses])
    try:
        array = real_array(poses)
    except ValueError as error:
        raise PoseError(
            f"{where}: cannot be read as numbers ({error}); give (N,4,4), (N,7) or a list of gtsam.Pose3"
        ) from error
    if array.shape == (4, 4):
        return array[None]
    if array.ndim == 3 and array.shape[1:] == (4, 4):
        if order is not None:
            raise PoseError(
                f"{where}: order={brief(order)} names a quaternion's order, but the poses are 4x4 matrices; "
                "leave order out"
            )
        return array
    if array.ndim == 2 and array.shape[1] == 7:
        return _from_quaternion_rows(array, order, where)
    if array.size == 0:
        return np.empty((0, 4, 4))
    raise PoseError(f"{where}: shape {array.shape} is not a pose's; give (N, 4, 4), (N, 7) or a list of gtsam.Pose3")


def _from_quaternion_rows(rows: Array, order: QuaternionOrder | None, where: str) -> Array:
    if order not in ("wxyz", "xyzw"):
        raise PoseError(
            f"{where}: rows of 7 need the order of the quaternion; give order='wxyz' or order='xyzw', "
            f"not {brief(order)}"
        )
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if bad.size:
        raise PoseError(
            f"{where}: measurement {bad[0]} has an entry that is NaN or infinite: {rows[bad[0]]}; "
            "leave the measurement out"
        )
    norm = np.linalg.norm(rows[:, :4], axis=1)
    off = np.flatnonzero(np.abs(norm - 1.0) > 1e-2)
    if off.size:
        i = off[0]
        raise PoseError(
            f"{where}: the quaternion of measurement {i} has norm {norm[i]:.6g}, not 1 "
            f"({rows[i, :4]}); normalise it, or check the columns and order={order!r}"
        )
    return se3.pose(to_rotations(rows[:, [1, 2, 3, 0] if order == "wxyz" else [0, 1, 2, 3]]), rows[:, 4:])


class CheckedRows(NamedTuple):
    """The rows (12, b) of a block, how many rotations were projected, and how far R'R may be from I after that."""

    rows: Array
    projected: int
    deviation: float


def checked_rows(block: Array, first: int, where: str, out: Array | None = None) -> CheckedRows:
    """Check transforms (b, 4, 4), and write them as the rows (12, b) from which moments are computed: vec(R), then t.

    For messages, ``first`` is the index of the first transform, and ``where`` names the argument and the pair. The rows
    are written to ``out`` where it is given. A PoseError names an entry that is NaN, infinite or too large, a last row
    that is not 0 0 0 1, or a block that is not a right-handed rotation.
    """
    rows = np.empty((12, len(block))) if out is None else out
    for column in range(4):
        rows[3 * column : 3 * column + 3] = block[:, :3, column].T
    far = max(rows[9:].max(), -rows[9:].min())
    if not far <= LARGEST_M or not np.isfinite(rows[:9].sum()):
        bad = np.flatnonzero(~(np.abs(rows) <= LARGEST_M).all(axis=0))
        index = int(bad[0]) if bad.size else 0
        raise PoseError(
            f"{where}: measurement {first + index} has an entry that is NaN, infinite or too large; "
            f"leave the measurement out:\n{block[index]}"
        )
    # The last row is almost always exact. Asking entry by entry takes half the time of one pass over a strided block.
    exact = not (block[:, 3, 0].any() or block[:, 3, 1].any() or block[:, 3, 2].any() or (block[:, 3, 3] != 1.0).any())
    last = 0.0 if exact else np.abs(block[:, 3, :] - (0.0, 0.0, 0.0, 1.0)).max(axis=1)
    if not np.max(last) <= 1e-9:  # NaN is refused too
        index = int(np.argmax(last))
        raise PoseError(
            f"{where}: the last row of measurement {first + index} is {block[index, 3]}, not 0 0 0 1; "
            "are the matrices transposed?"
        )
    gram = _gram_less_identity(rows)
    worst = max(float(gram.max()), -float(gram.min()))
    if not worst <= ROTATION_TOLERANCE:  # NaN is refused too
        deviation = np.abs(gram).max(axis=0)
        index = int(deviation.argmax())
        raise PoseError(
            f"{where}: the rotation of measurement {first + index} is off by {deviation[index]:.3g} "
            f"(largest entry of R'R - I; up to {ROTATION_TOLERANCE:g} is projected); check the layout "
            f"of the matrices, or give quaternions:\n{block[index, :3, :3]}"
        )
    handed = determinant(rows)
    if handed.min() < 0.0:
        index = int(handed.argmin())
        raise PoseError(
            f"{where}: the rotation of measurement {first + index} is left-handed (determinant "
            f"{handed[index]:.6f}): a mirrored axis; check the axis convention"
        )
    projected = 0
    if worst > ROTATION_ROUNDING:
        projected = int((np.abs(gram).max(axis=0) > ROTATION_ROUNDING).sum())
        for _ in range(3):  # quadratic: 1e-3 becomes 1e-6, 1e-12, rounding
            rows[:9] = polar_step(rows)
        worst = float(orthonormality(rows).max())
    return CheckedRows(rows, projected, worst)


def orthonormality(rows: Array) -> Array:
    """Largest entry of |R'R - I| (b,) of ``rows`` (12 or 9, b)."""
    deviation: Array = np.abs(_gram_less_identity(rows)).max(axis=0)
    return deviation


def _gram_less_identity(rows: Array) -> Array:
    """The six different entries of R'R - I, (6, b), of ``rows`` (12 or 9, b); the first three are of the diagonal."""
    c = rows[:9].reshape(3, 3, -1)
    gram = np.empty((6, c.shape[2]))
    terms = np.empty_like(c[0])
    for entry, (i, j) in zip(gram, ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)), strict=True):
        np.multiply(c[i], c[j], out=terms)
        np.add(terms[0], terms[1], out=entry)
        entry += terms[2]
    gram[:3] -= 1.0
    return gram


def determinant(rows: Array) -> Array:
    """Determinants (b,) of ``rows`` (12 or 9, b)."""
    (a0, a1, a2), (b0, b1, b2), (c0, c1, c2) = rows[:9].reshape(3, 3, -1)
    result: Array = a0 * (b1 * c2 - b2 * c1) + a1 * (b2 * c0 - b0 * c2) + a2 * (b0 * c1 - b1 * c0)
    return result


def polar_step(rows: Array) -> Array:
    """One Newton-Schulz step R (3 I - R'R) / 2 towards the nearest rotation (Higham 2008, eq. 8.20), (9, b)."""
    c = rows[:9].reshape(3, 3, -1)  # c[j] is column j of R
    gram = np.einsum("jib,kib->jkb", c, c)
    step: Array = 1.5 * c - 0.5 * np.einsum("jib,jkb->kib", c, gram)
    return step.reshape(9, -1)


def one_transform(pose: PoseLike, where: str) -> Array:
    """One pose as a checked (4, 4) array; a PoseError when it is not a valid pose."""
    transforms = as_transforms([pose] if isinstance(pose, gtsam.Pose3) else pose, None, where)
    if len(transforms) != 1:
        raise PoseError(f"{where}: {len(transforms)} poses where one is expected; give one")
    rows = checked_rows(transforms, 0, where).rows
    transform: Array = rows_to_transforms(rows)[0]
    return transform


def rows_to_transforms(rows: Array) -> Array:
    """Poses (b, 4, 4) of the rows (12, b) of ``checked_rows``."""
    columns = rows.reshape(4, 3, -1)
    return se3.pose(columns[:3].transpose(2, 1, 0), columns[3].T)


def to_pose3(R: Array, t: Array) -> Any:
    """A ``gtsam.Pose3`` of a rotation (3, 3) and a translation (3,)."""
    return gtsam.Pose3(gtsam.Rot3(R), t)
