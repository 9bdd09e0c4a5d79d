"""Euler angles of another order or about other axes: which of all conventions are worth a fit.

Three numbers a, b, c make R = R_i(a) R_j(b) R_k(c), or R_k(c) R_j(b) R_i(a), for twelve choices of axes, or they are a
rotation vector. So a rotation that was read by one convention is turned into its numbers, and these into a rotation by
each other one. A fit in closed form of all at once tells the few that may explain A and B; numbers of more than half a
turn, or a second angle of more than a quarter, are not found again from a rotation.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator

import numpy as np
from rwhec_factors.se3 import pose
from scipy.spatial.transform import Rotation

from gtsam_rwhec.calibration.other_readings import Mistake, OtherReading, of_sides
from gtsam_rwhec.calibration.row_shifts import fits_of_parts
from gtsam_rwhec.calibration.trial_fits import Sample
from gtsam_rwhec.geometry.poses import Array

#: The turning axes of all Euler angles, no axis twice in a row; the common ones first.
ORDERS = ("ZYX", "XYZ", "ZYZ", "ZXZ", "ZXY", "YXZ", "XZY", "YZX", "XYX", "XZX", "YXY", "YZY")
#: SciPy's names of all conventions: capitals for turning axes, small letters for fixed ones.
CONVENTIONS = ("rotvec", *ORDERS, *(of.lower() for of in ORDERS))
#: So many rows are looked at; with fewer, everything fits.
MOST_ROWS, FEWEST_ROWS = 60, 8
#: A convention is promising if the product of both residuals is below this share of that as read.
PROMISING = 0.5
#: At most so many are fitted.
MOST = 6


def readings_of_euler_angles(sample: Sample) -> list[OtherReading]:
    """The readings of Euler angles that fit the pair with the most rows better in closed form, the best first."""
    A, B = max(sample.values(), key=lambda poses: len(poses[0]))
    rows = np.unique(np.linspace(0, len(A) - 1, MOST_ROWS).astype(int))
    A, B = A[rows], B[rows]
    if len(rows) < FEWEST_ROWS:
        return []
    tried = {
        (side, read, meant): R for side, T in (("A", A), ("B", B)) for read, meant, R in _conventions(T[:, :3, :3])
    }
    of_A, of_B = (
        np.stack([T, *(pose(R, T[:, :3, 3]) if at == side else T for (at, *_), R in tried.items())])
        for side, T in (("A", A), ("B", B))
    )
    errors = fits_of_parts(of_A, of_B, np.ones(of_A.shape[:2]), is_scaled=True)[3]
    remains = np.log(np.maximum(errors, [1e-6, 1e-9])).sum(axis=1)
    # some conventions differ by names of axes only, and fit alike: the most common one is named
    best: dict[tuple[str, float], tuple[str, str, str]] = {}
    for value, one in zip(remains[1:].tolist(), tried, strict=True):
        if value < remains[0] + math.log(PROMISING):
            best.setdefault((one[0], round(value, 4)), one)
    return [_reading(*best[key]) for key in sorted(best, key=lambda key: key[1])[:MOST]]


def _conventions(R: Array) -> Iterator[tuple[str, str, Array]]:
    """Each convention that may have been read, each that may have been meant, and the rotations that were meant."""
    for read in ("rotvec", *ORDERS):
        numbers = _numbers(R, read)
        for meant in CONVENTIONS:
            if meant != read:
                yield read, meant, _rotations(numbers, meant)


def _numbers(R: Array, convention: str) -> Array:
    rotations = Rotation.from_matrix(R)
    if convention == "rotvec":
        return np.asarray(rotations.as_rotvec())
    with warnings.catch_warnings(action="ignore"):  # of gimbal lock: two of the numbers are one then
        return np.asarray(rotations.as_euler(convention))  # type: ignore[call-overload]  # it is one of its words


def _rotations(numbers: Array, convention: str) -> Array:
    if convention == "rotvec":
        return np.asarray(Rotation.from_rotvec(numbers).as_matrix())
    return np.asarray(Rotation.from_euler(convention, numbers).as_matrix())


def _reading(side: str, read: str, meant: str) -> OtherReading:
    def change(T: Array) -> Array:
        return pose(_rotations(_numbers(T[:, :3, :3], read), meant), T[:, :3, 3])

    return OtherReading(
        Mistake.EULER_AXES,
        f"the rotations of {side} are {words_of(meant)}, and were read as {words_of(read)}",
        f"read the angles of {side} by the convention of what wrote them: {words_of(meant)}",
        of_sides(side, change),
        of_B=side == "B",
    )


def words_of(convention: str) -> str:
    """A convention as a product: "Euler angles Rz(a) Ry(b) Rx(c)"."""
    if convention == "rotvec":
        return "rotation vectors (a, b, c)"
    parts = [f"R{axis.lower()}({number})" for axis, number in zip(convention, "abc", strict=True)]
    return f"Euler angles {' '.join(parts if convention.isupper() else reversed(parts))}"
