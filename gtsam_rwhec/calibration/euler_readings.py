"""Euler angles of another order or about other axes: which of all conventions are worth a fit.

Three numbers a, b, c make R = R_i(a) R_j(b) R_k(c), or R_k(c) R_j(b) R_i(a), for twelve choices of axes, or they are a
rotation vector. So a rotation that was read by one convention is turned into its numbers, and these into a rotation by
each other one. Whatever X and Y are, the motion between two rows turns A and B by the same angle. That tells the few
conventions that may explain both; translations tell those apart that only rename the axes.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator

import numpy as np
from rwhec_factors.se3 import pose
from scipy.spatial.transform import Rotation

from gtsam_rwhec.calibration.other_readings import Mistake, OtherReading, of_sides
from gtsam_rwhec.calibration.trial_fits import Sample, angles
from gtsam_rwhec.geometry.poses import Array

#: The turning axes of all Euler angles: no axis twice in a row.
ORDERS = tuple("".join(of) for of in itertools.product("XYZ", repeat=3) if of[0] != of[1] and of[1] != of[2])
#: SciPy's names of all conventions: capitals for turning axes, small letters for fixed ones.
CONVENTIONS = (*ORDERS, *(of.lower() for of in ORDERS), "rotvec")
#: Rows that are looked at.
MOST_ROWS = 120
#: A convention is promising if the angles of A and B differ by at most this share of what they differ by as read.
PROMISING = 0.6
#: And by at most this many times what they differ by under the best one: such conventions only rename axes.
ALIKE = 1.3
#: At most so many are fitted.
MOST = 12


def readings_of_euler_angles(sample: Sample) -> list[OtherReading]:
    """The readings of Euler angles under which motions of A and B turn by the same angles, the best first."""
    chosen = [
        (A[rows], B[rows])
        for A, B in sample.values()
        for rows in [np.unique(np.linspace(0, len(A) - 1, MOST_ROWS // len(sample) + 1).astype(int))]
        if len(rows) > 2
    ]
    if not chosen:
        return []
    lengths = np.cumsum([len(A) for A, _ in chosen])[:-1]
    sides = {"A": np.concatenate([A for A, _ in chosen]), "B": np.concatenate([B for _, B in chosen])}

    def turned_by(R: Array) -> Array:
        return np.concatenate(
            [angles(np.roll(of, lag, axis=0), of) for of in np.split(R, lengths) for lag in (1, len(of) // 2)]
        )

    by = {side: turned_by(T[:, :3, :3]) for side, T in sides.items()}
    as_read = float(np.median(np.abs(by["A"] - by["B"])))
    found = []
    for side, T in sides.items():
        other = by["B" if side == "A" else "A"]
        for read, meant, R in _conventions(T[:, :3, :3]):
            found.append((float(np.median(np.abs(turned_by(R) - other))), side, read, meant))
    found.sort()
    likely = [one for one in found if one[0] < min(PROMISING * as_read, ALIKE * found[0][0])][:MOST]
    return [_reading(*one) for _, *one in likely]


def _conventions(R: Array) -> Iterator[tuple[str, str, Array]]:
    """Each convention that may have been read, each that may have been meant, and the rotations that were meant."""
    for read in (*ORDERS, "rotvec"):
        numbers = _numbers(R, read)
        for meant in CONVENTIONS:
            if meant != read:
                yield read, meant, _rotations(numbers, meant)


def _numbers(R: Array, convention: str) -> Array:
    rotations = Rotation.from_matrix(R)
    if convention == "rotvec":
        return np.asarray(rotations.as_rotvec())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of gimbal lock: two of the numbers are one then
        return np.asarray(rotations.as_euler(convention))


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
