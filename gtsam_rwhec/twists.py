"""The carriers' velocity at each stamp, from the poses themselves: what a time offset moves A along."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import CountError
from gtsam_rwhec.poses import Array

#: Differences over longer than this say little of the velocity in between.
LONGEST_GAP_S = 1.0


def carrier_twists(A: Array, stamps_ns: np.ndarray, where: str) -> Array:
    """Twists (N, 6), [omega rad/s, v m/s], such that A(t + d) = A Expmap(d twist) to first order.

    From the neighbours in time: the slope at the stamp of the parabola through before, at and after (one side alone at
    the ends and beside gaps), on the Lie algebra of each pose.

    Parameters
    ----------
    A : (N, 4, 4) array
        T_sensorcarrier_targetcarrier, in any order.
    stamps_ns : (N,) integers
    where : str
        For messages.

    Raises
    ------
    CountError
        For fewer than two stamps, two poses at one stamp, or a pose without any neighbour within a second.
    """
    if len(A) < 2:
        raise CountError(f"{where}: a time offset needs at least two stamped measurements; there is {len(A)}")
    order = np.argsort(stamps_ns, kind="stable")
    seconds = (stamps_ns[order] - stamps_ns[order[0]]) * 1e-9
    step = np.diff(seconds)
    if (step <= 0.0).any():
        index = int(np.flatnonzero(step <= 0.0)[0])
        raise CountError(
            f"{where}: two measurements have the stamp {stamps_ns[order[index]]} ns; an offset needs each stamp once"
        )
    near = step <= LONGEST_GAP_S
    slope = se3.logmap(se3.inverse(A[order[:-1]]) @ A[order[1:]]) / step[:, None]  # mean twist of each gap
    twists = np.zeros((len(A), 6))
    before, after = np.r_[False, near], np.r_[near, False]
    alone = np.flatnonzero(~before & ~after)
    if alone.size:
        raise CountError(
            f"{where}: the measurement at {stamps_ns[order[alone[0]]]} ns has no other within {LONGEST_GAP_S:g} s, so "
            "nothing tells how fast the carrier moved there; leave it out, or estimate no time offset for its sensor"
        )
    h_before, h_after = np.r_[1.0, step][:, None], np.r_[step, 1.0][:, None]
    s_before, s_after = np.vstack([slope[:1], slope]), np.vstack([slope, slope[-1:]])
    parabola = (h_after * s_before + h_before * s_after) / (h_before + h_after)
    ordered = np.where((before & after)[:, None], parabola, np.where(before[:, None], s_before, s_after))
    twists[order] = ordered
    return twists
