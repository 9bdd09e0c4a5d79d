"""Rotations and translations as OpenCV takes them: lists or arrays of 3x3 matrices, rotation vectors, 3-vectors."""

from __future__ import annotations

from operator import attrgetter
from typing import Any

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import CountError, PoseError, UnderdeterminedError
from gtsam_rwhec.geometry.poses import LARGEST_M, ROTATION_TOLERANCE, Array, determinant, orthonormality
from gtsam_rwhec.geometry.real_numbers import real_array

#: Two motions about different axes need at least this many poses; OpenCV asks for as many.
FEWEST_POSES = 3
#: Turning of the axes below this share of the largest possible turning is rounding error.
PARALLEL = 1e-13
#: Second row times third row, entries (1, 2), (2, 0), (0, 1), then (2, 1), (0, 2), (1, 0): their cross product.
_NEXT, _AFTER = [4, 5, 3, 5, 3, 4], [8, 6, 7, 7, 8, 6]
_DTYPE, _SHAPE = attrgetter("dtype"), attrgetter("shape")
#: Shapes of a 3-vector.
_VECTORS = ((3,), (3, 1), (1, 3))


def checked_poses(R: Any, t: Any, names: tuple[str, str]) -> tuple[Array, Array]:
    """Rotations (N, 3, 3) and translations (N, 3) of the two arguments with these names.

    A rotation is (3, 3), or a rotation vector (3,), (3, 1) or (1, 3) in radians; a list may hold both. A translation is
    (3,), (3, 1) or (1, 3). Raises PoseError for other shapes, entries that are not finite and matrices that are not
    rotations, CountError for different numbers of rotations and translations.
    """
    rotations, translations = _rotations(R, names[0]), _translations(t, names[1])
    if len(rotations) != len(translations):
        raise CountError(
            f"{names[0]} has {len(rotations)} rotations and {names[1]} {len(translations)} translations; "
            "give one of each for every pose"
        )
    return rotations, translations


def check_counts(first: int, second: int, names: tuple[str, str]) -> None:
    """Raise CountError for unequal numbers of poses, or fewer than three poses."""
    if first != second:
        raise CountError(f"{names[0]} has {first} poses and {names[1]} {second}; give both for every station")
    if first < FEWEST_POSES:
        raise CountError(
            f"{first} poses in {names[0]}; at least {FEWEST_POSES} are needed (two motions about different axes)"
        )


def check_axes(R: tuple[Array, Array], where: tuple[str, str]) -> None:
    """Raise UnderdeterminedError for motions R_j' R_i that leave every method's answer free.

    Over all ordered pairs, the sum of I - R_j' R_i is N^2 I - (sum R)'(sum R). No motion turns a vector of its null
    space. The matrix is zero when nothing rotates, and has rank two when all motions rotate about one axis.
    """
    for rotations, name in zip(R, where, strict=True):
        count = len(rotations)
        least, most = least_and_most_turning(np.einsum("nij->ij", rotations), count)
        if most <= PARALLEL * count**2:
            raise UnderdeterminedError(
                f"{name}: no motion rotates, so the rotation and the translation are not determined; add poses that "
                "turn about two different axes"
            )
        if least <= PARALLEL * most:
            raise UnderdeterminedError(
                f"{name}: all motions rotate about one axis, which leaves the translation along it free; add poses "
                "that turn about another axis"
            )


def least_and_most_turning(total: Array, count: int) -> tuple[float, float]:
    """The determinant of N^2 I - S'S over the sum of its 2 x 2 minors, and its trace.

    A small quotient is the smallest eigenvalue. Motions about one axis turn two directions alike, so two eigenvalues
    are never small if the third is large. The sums use plain numbers: a call of NumPy takes longer than the sums.
    """
    (a, b, c), (d, e, f), (g, h, i) = (total.T @ total).tolist()
    square = float(count) ** 2
    a, e, i = square - a, square - e, square - i
    b, c, d, f, g, h = -b, -c, -d, -f, -g, -h
    first, second, third = e * i - f * h, f * g - d * i, d * h - e * g
    minors = first + (a * i - c * g) + (a * e - b * d)
    determinant = a * first + b * second + c * third
    return (determinant / minors if minors > 0.0 else 0.0), a + e + i


def _rotations(values: Any, where: str) -> Array:
    array = _as_array(values, where, "rotations")
    if array is None:  # matrices and vectors in one list
        return np.concatenate([_rotations([value], f"{where}[{index}]") for index, value in enumerate(values)])
    if array.ndim == 3 and array.shape[1:] == (3, 3):
        if not are_rotations(array):
            _check_finite(array, where)
            _check_rotations(array, where)
        return array
    if array.shape[1:] in _VECTORS:
        _check_finite(array, where)
        vectors = array.reshape(-1, 3)
        return se3.expmap(np.concatenate([vectors, np.zeros_like(vectors)], axis=1))[:, :3, :3]
    raise PoseError(
        f"{where}: shape {array.shape} is not a list of rotations; give matrices (3, 3) or rotation vectors (3,), "
        "(3, 1), (1, 3), one for every pose"
    )


def _translations(values: Any, where: str) -> Array:
    array = _as_array(values, where, "translations")
    if array is None:
        return np.concatenate([_translations([value], f"{where}[{index}]") for index, value in enumerate(values)])
    if array.shape[1:] not in _VECTORS:
        raise PoseError(
            f"{where}: shape {array.shape} is not a list of translations; give (3,), (3, 1) or (1, 3) for every pose"
        )
    _check_finite(array, where)
    return array.reshape(-1, 3)


def _as_array(values: Any, where: str, what: str) -> Array | None:
    """An array of doubles; None where the entries have different shapes."""
    array = _joined(values) if isinstance(values, (list, tuple)) else None
    if array is not None:
        return array
    try:
        array = real_array(values)
    except ValueError as error:
        if isinstance(values, (list, tuple)) and len(set(map(_shape, values))) > 1:
            return None
        raise PoseError(f"{where}: cannot be read as numbers ({error}); give arrays of numbers") from error
    if array.size == 0:
        raise CountError(f"{where}: no {what}; at least {FEWEST_POSES} are needed")
    return array


def _shape(value: Any) -> tuple[int, ...] | None:
    """The shape of an array; None for lists of different lengths."""
    try:
        shape: tuple[int, ...] = np.shape(value)
        return shape
    except ValueError:
        return None


def _joined(values: list[Any] | tuple[Any, ...]) -> Array | None:
    """Contiguous arrays of doubles of one shape as one array; None for other values.

    It is several times faster than ``numpy.asarray``, which takes longer than some of the methods.
    """
    first = values[0] if values else None
    if not isinstance(first, np.ndarray) or not first.size:
        return None
    try:
        if set(map(_DTYPE, values)) != {np.dtype(np.float64)} or set(map(_SHAPE, values)) != {first.shape}:
            return None
        return np.frombuffer(b"".join(values)).reshape(len(values), *first.shape)
    except (AttributeError, TypeError, BufferError):  # not arrays, or not contiguous
        return None


def _check_finite(array: Array, where: str) -> None:
    if np.abs(array).max() <= LARGEST_M:  # NaN is not
        return
    bad = np.flatnonzero(~(np.abs(array.reshape(len(array), -1)) <= LARGEST_M).all(axis=1))
    raise PoseError(
        f"{where}: pose {bad[0]} has an entry that is NaN, infinite or too large; leave the pose out:\n{array[bad[0]]}"
    )


def are_rotations(R: Array) -> bool:
    """Whether all matrices (N, 3, 3) are rotations to about 4e-4; a quick test before ``_check_rotations``.

    With |R|^2 = 3 and det R = 1 all singular values are 1: the mean of their squares equals their product's root.
    """
    rows = np.ascontiguousarray(R.reshape(-1, 9).T)
    squares = np.einsum("kn,kn->n", rows, rows)
    cross = rows[_NEXT] * rows[_AFTER]
    determinants = np.einsum("kn,kn->n", rows[:3], cross[:3] - cross[3:])
    worst = np.abs(np.concatenate([squares - 3.0, determinants - 1.0])).max()
    return bool(worst < 1e-7)


def _check_rotations(R: Array, where: str) -> None:
    columns = R.transpose(2, 1, 0).reshape(9, -1)
    deviation, handed = orthonormality(columns), determinant(columns)
    if deviation.max() > ROTATION_TOLERANCE:
        index = int(deviation.argmax())
        raise PoseError(
            f"{where}: the rotation of pose {index} is off by {deviation[index]:.3g} (largest entry of R'R - I; the "
            f"limit is {ROTATION_TOLERANCE:g}); check the matrix:\n{R[index]}"
        )
    if handed.min() < 0.0:
        index = int(handed.argmin())
        raise PoseError(
            f"{where}: the rotation of pose {index} is left-handed (determinant {handed[index]:.6f}): an axis is "
            "mirrored; check the axis convention"
        )
