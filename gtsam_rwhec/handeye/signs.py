"""Signs of q_C and q_H. The DQ paper never says how they are chosen, and its cost depends on it.

q and -q are one rotation, but L(q_C) - R(q_H) is small for one relative sign only. q_C = q (x) q_H (x) q* has the
scalar part of q_H, so both are given a scalar part that is not negative. Near half a turn that part is noise about 0
and says nothing: there the sign is the one with which the motion agrees with the rotation that the other motions
give. Where those give none (few, about one axis, or all half turns) the candidates are tried, and the cost decides.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.quaternions import left, right
from gtsam_rwhec.handeye.cost import motion_moments, residuals
from gtsam_rwhec.handeye.saddle import minimum

#: Scalar parts whose sum is below this do not tell the sign: noise of 11 degrees could have swapped it.
UNCERTAIN = 0.2
#: The other motions determine the rotation when M's second eigenvalue is this many times its first.
DETERMINED = 9.0
ROUNDS = 3


def flipped(rows: Array, sums: Array) -> Array:
    """``Motions.rows`` (14, n) with the sign of q_H and its dual changed; ``sums`` (2, n) of the scalar parts."""
    result = np.empty_like(rows)
    for top in (0, 7):
        result[top : top + 3], result[top + 3 : top + 6] = rows[top + 3 : top + 6], rows[top : top + 3]
    result[6], result[13] = sums
    return result


def resolve_signs(rows: Array, sums: Array, uncertain: NDArray[np.bool_]) -> None:
    """Choose the signs of the uncertain motions, in place.

    Parameters
    ----------
    rows : (14, N) array
        ``Motions.rows`` with all scalar parts not negative.
    sums : (2, N) array
        Sums of the scalar parts of q_C and q_H, and of their duals.
    uncertain : (N,) bool array
    """
    same = rows[:, uncertain]
    other = flipped(same, sums[:, uncertain])
    known = rotation_gram(rows) - rotation_gram(same)
    values, vectors = np.linalg.eigh(known)
    determined = values[1] > DETERMINED * values[0] + 1e-12 * values[3]
    starts = [vectors[:, 0]] if determined else _candidate_rotations(rows)
    best, chosen = np.inf, same
    for q in starts:
        rotation = q
        for _ in range(ROUNDS):
            swap = _squares(other, rotation) < _squares(same, rotation)
            trial = np.where(swap, other, same)
            rotation = np.linalg.eigh(known + rotation_gram(trial))[1][:, 0]
        if len(starts) == 1:
            chosen = trial
            break
        cost = _cost(np.concatenate([rows[:, ~uncertain], trial], axis=1))
        if cost < best:
            best, chosen = cost, trial
    rows[:, uncertain] = chosen


def rotation_gram(rows: Array) -> Array:
    """The sum of A'A (4, 4)."""
    return motion_moments(rows).AA


def _squares(rows: Array, q: Array) -> Array:
    result: Array = (residuals(rows, q, np.zeros(4))[:4] ** 2).sum(axis=0)
    return result


def _cost(rows: Array) -> float:
    """What the least squares solution costs, translations weighed as much as rotations."""
    moments = motion_moments(rows)
    lengths = np.trace(moments.BB)
    return minimum(moments.cost(float(np.sqrt(np.trace(moments.AA) / lengths)) if lengths > 0.0 else 1.0)).value


def _candidate_rotations(rows: Array) -> list[Array]:
    """Rotations that take the axes of two motions to each other, with either sign of each."""
    C, H = 0.5 * (rows[:3] + rows[3:6]), 0.5 * (rows[:3] - rows[3:6])
    first = int((H * H).sum(axis=0).argmax())
    second = int((np.cross(H[:, first], H.T) ** 2).sum(axis=1).argmax())
    starts = []
    for i in (1.0, -1.0):
        for j in (1.0, -1.0):
            # q_C (x) q = q (x) q_H for both motions, the scalar parts left out: vectors turned onto vectors.
            M = np.zeros((4, 4))
            for index, sign in ((first, i), (second, j)):
                A = left(np.append(C[:, index], 0.0)) - right(np.append(sign * H[:, index], 0.0))
                M += A.T @ A
            starts += list(np.linalg.eigh(M)[1].T[:2])
    return starts
