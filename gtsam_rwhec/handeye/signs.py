"""The signs of q_C and q_H. The DQ paper's cost depends on them, and the paper does not say how to choose them.

q and -q are one rotation, but L(q_C) - R(q_H) is small for one relative sign only. q_C = q (x) q_H (x) q* has the
scalar part of q_H, so both quaternions get a scalar part that is not negative. Near half a turn the scalar part is
noise about 0 and does not tell the sign. There the motion takes the sign that agrees with the rotation from the other
motions. Where the other motions determine no rotation (few motions, one axis, only half turns), candidate rotations are
tried, and the cost decides.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import left, right
from gtsam_rwhec.handeye.cost import motion_moments, residuals
from gtsam_rwhec.handeye.saddle import minimum

#: Scalar parts whose sum is below this do not tell the sign: noise of 11 degrees could have changed it.
UNCERTAIN = 0.2
#: The other motions determine the rotation when M's second eigenvalue is this many times its first.
DETERMINED = 9.0
#: Signs and rotation are found from each other this many times.
ROUNDS = 3


def flipped(rows: Array, sums: Array) -> Array:
    """``Motions.rows`` (14, n) with the sign of q_H and of its dual changed; ``sums`` (2, n) of the scalar parts."""
    result = np.empty_like(rows)
    for top in (0, 7):
        result[top : top + 3], result[top + 3 : top + 6] = rows[top + 3 : top + 6], rows[top : top + 3]
    result[6], result[13] = sums
    return result


def resolve_signs(rows: Array, sums: Array, uncertain: NDArray[np.bool_]) -> None:
    """Choose the signs of the motions ``uncertain`` (N,), whose scalar parts do not tell the sign, in place.

    ``rows`` (14, N) are ``Motions.rows``, whose scalar parts are not negative; ``sums`` (2, N) are the sums of the
    scalar parts of q_C and q_H, and of their duals.
    """
    same = rows[:, uncertain]
    other = flipped(same, sums[:, uncertain])
    known = motion_moments(rows).AA - motion_moments(same).AA
    values, vectors = np.linalg.eigh(known)
    determined = values[1] > DETERMINED * values[0] + 1e-12 * values[3]
    trials = []
    for rotation in [vectors[:, 0]] if determined else _candidate_rotations(rows):
        for _ in range(ROUNDS):
            trial = np.where(_squares(other, rotation) < _squares(same, rotation), other, same)
            rotation = np.linalg.eigh(known + motion_moments(trial).AA)[1][:, 0]
        trials.append(trial)
    if len(trials) > 1:
        trials.sort(key=lambda trial: _cost(np.concatenate([rows[:, ~uncertain], trial], axis=1)))
    rows[:, uncertain] = trials[0]


def _squares(rows: Array, q: Array) -> Array:
    """|A q|^2 (n,) of motions (14, n)."""
    result: Array = (residuals(rows, q, np.zeros(4))[:4] ** 2).sum(axis=0)
    return result


def _cost(rows: Array) -> float:
    """The smallest cost of motions (14, n), with translations weighed as much as rotations."""
    moments = motion_moments(rows)
    lengths = np.trace(moments.BB)
    alpha = float(np.sqrt(np.trace(moments.AA) / lengths)) if lengths > 0.0 else 1.0
    return float(minimum(moments.cost(alpha)).values[0])


def _candidate_rotations(rows: Array) -> list[Array]:
    """Rotations that turn the axes of two motions of H onto their axes in C, with either sign of each axis."""
    C, H = 0.5 * (rows[:3] + rows[3:6]), 0.5 * (rows[:3] - rows[3:6])
    first = int((H * H).sum(axis=0).argmax())
    second = int((np.cross(H[:, first], H.T) ** 2).sum(axis=1).argmax())
    starts = []
    for i in (1.0, -1.0):
        for j in (1.0, -1.0):
            # q_C (x) q = q (x) q_H for both motions, without the scalar parts: vectors are turned onto vectors.
            M = np.zeros((4, 4))
            for index, sign in ((first, i), (second, j)):
                A = left(np.append(C[:, index], 0.0)) - right(np.append(sign * H[:, index], 0.0))
                M += A.T @ A
            starts += list(np.linalg.eigh(M)[1].T[:2])
    return starts
