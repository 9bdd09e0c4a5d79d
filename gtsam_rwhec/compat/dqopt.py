"""DQOpt over all pairs of stations: the minimum of the DQ paper's cost (8) over OpenCV's motions."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.compat.daniilidis import screws
from gtsam_rwhec.compat.stations import Stations
from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.handeye.cost import MotionMoments, motion_moments
from gtsam_rwhec.handeye.dual_quaternions import to_transform
from gtsam_rwhec.handeye.saddle import Minimum, minimum
from gtsam_rwhec.handeye.signs import UNCERTAIN

#: This many solutions follow the first one, each with alpha from the residuals of the solution before.
ROUNDS = 3


def dqopt(stations: Stations) -> tuple[Array, Array]:
    """DQOpt (Algorithm 1), with alpha the ratio of the rotation's residual to the translation's residual.

    Motions near half a turn are left out, because the signs of their quaternions are uncertain; other motions of the
    same stations remain. Raises UnderdeterminedError when fewer than two motions remain.
    """
    AA, BA, BB, used = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4)), 0
    for a, b, dual_a, dual_b, weight in screws(stations):
        kept = (weight > 0.0) & (a[3] + b[3] >= UNCERTAIN)
        sides = (a[:3] + b[:3], a - b, dual_a[:3] + dual_b[:3], dual_a - dual_b)  # Motions.rows
        rows = np.concatenate([side[:, kept] for side in sides])
        sums = motion_moments(rows)
        AA, BA, BB, used = AA + sums.AA, BA + sums.BA, BB + sums.BB, used + rows.shape[1]
    if used < 2:
        raise UnderdeterminedError(
            f"{used} motions between the poses are far enough from half a turn, and two are needed; add poses that "
            "turn less"
        )
    moments = MotionMoments(AA, BA, BB, used)
    # The first alpha: a translation as long as the motions' weighs as much as a rotation of about a radian.
    alpha = np.sqrt(used / max(float(np.trace(BB)), np.finfo(float).tiny))
    found = minimum(moments.cost(alpha))
    for _ in range(ROUNDS):
        rotation, translation = squared_sums(moments, found)
        floor = 1e-14 * used
        if rotation <= floor or translation * alpha**2 <= floor:
            break  # exact poses: nothing to weigh
        alpha = np.sqrt(rotation / translation)
        found = minimum(moments.cost(alpha))
    X = to_transform(found.q, found.q_dual)
    return X[:3, :3], X[:3, 3]


def squared_sums(moments: MotionMoments, found: Minimum) -> tuple[float, float]:
    """The sums of |A q|^2 and |B q + A q'|^2 of an answer."""
    q, p = found.q, found.q_dual
    rotation = float(q @ moments.AA @ q)
    translation = float(q @ moments.BB @ q + 2.0 * (q @ moments.BA @ p) + p @ moments.AA @ p)
    return rotation, translation
