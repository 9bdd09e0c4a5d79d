"""The first guess of a time offset: the one at which sensor and carrier turn about the same axes by the same angles.

A_i X = Y B_i makes R_B,j R_B,i' = R_Y' (R_A,j R_A,i') R_Y for every target alike, so that the rotation vectors of all
intervals are turned by one R_Y (Park and Martin, 1994). A search compares offsets by what is left after the best R_Y,
each difference cut off at a few standard deviations: standstill then weighs nothing, and a wrong detection little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.trajectories.smooth_path import SmoothPath
from gtsam_rwhec.trajectories.trajectory import Trajectory

#: The two detections of an interval are this many seconds apart. The time is long enough for the turn to exceed a
#: detection's noise, and short enough for the motion not to repeat itself.
INTERVAL_S = 0.4
#: At most this many intervals are used; they are taken evenly from all.
MOST = 1500
#: Differences are cut off at this many standard deviations.
CUT = 4.0
#: Rounds of reweighting for each R_Y.
ROUNDS = 3


@dataclass(frozen=True)
class Turns:
    """The intervals of all tracks of a sensor.

    Attributes
    ----------
    start_ns, end_ns : (N,) integers
        The sensor's stamps.
    turn : (N, 3) array
        Log(R_B,end R_B,start'), rad, in the sensor's axes.
    noise_rad : float
        Robust standard deviation of a turn about each axis, from the detections.
    """

    start_ns: np.ndarray
    end_ns: np.ndarray
    turn: Array
    noise_rad: float

    @staticmethod
    def of(tracks: Sequence[tuple[np.ndarray, Array]]) -> Turns:
        """The intervals between detections of one target that are about `INTERVAL_S` apart, of all tracks."""
        parts = [_of_track(stamps, B) for stamps, B in tracks]
        start, end, turn = (np.concatenate(part) for part in zip(*(p[:3] for p in parts), strict=True))
        jerks = np.concatenate([p[3] for p in parts])
        # A second difference has six times a detection's variance; motion can only add to it.
        scatter = float(np.median(np.abs(jerks))) / 0.6745 / np.sqrt(6.0) if jerks.size else 0.0
        some = np.linspace(0, max(len(start) - 1, 0), min(MOST, len(start))).astype(int)
        return Turns(start[some], end[some], turn[some], np.sqrt(2.0) * scatter)

    def compared(
        self, carrier: Trajectory, smooth: SmoothPath, offset_s: float, max_gap_s: float
    ) -> tuple[float, Array, int]:
        """The mean cut-off squared difference (rad^2) at an offset, the best R_Y, and how many turns are known."""
        shift = round(offset_s * 1e9)
        known = np.ones(len(self.turn), dtype=bool)
        R = []
        for stamps in (self.start_ns + shift, self.end_ns + shift):
            known &= carrier.gaps(stamps) <= max_gap_s
            R.append(smooth.poses(stamps)[:, :3, :3])
        if not known.any():
            return np.inf, np.eye(3), 0
        a, b = se3.so3_logmap((R[1] @ R[0].transpose(0, 2, 1))[known]), self.turn[known]
        cut = CUT * max(np.sqrt(self.noise_rad**2 + 2.0 * smooth.scatter[:3].mean()), 1e-9)
        weight = np.ones(len(a))
        for _ in range(ROUNDS):
            R_Y = aligned(a, b, weight)
            off = np.linalg.norm(a - b @ R_Y.T, axis=1)
            weight = 1.0 / np.maximum(off, 0.3 * cut)
        return float(np.mean(np.minimum(off, cut) ** 2)), R_Y, int(known.sum())


def aligned(a: Array, b: Array, weight: Array) -> Array:
    """The rotation R with the smallest sum of weight |a - R b|^2, for (N, 3) vectors (Kabsch 1976)."""
    U, _, Vt = np.linalg.svd((a * weight[:, None]).T @ b)
    R: Array = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return R


def _of_track(stamps_ns: np.ndarray, B: Array) -> tuple[np.ndarray, np.ndarray, Array, Array]:
    """Stamps (start, end) and turns of a track's intervals, and second differences of its rotations."""
    if len(stamps_ns) < 3:
        return stamps_ns[:0], stamps_ns[:0], np.zeros((0, 3)), np.zeros((0, 3))
    interval_ns = round(max(INTERVAL_S * 1e9, 1.2 * float(np.median(np.diff(stamps_ns)))))
    later = np.searchsorted(stamps_ns, stamps_ns + interval_ns)
    i = np.flatnonzero(later < len(stamps_ns))
    j = later[i]
    near = stamps_ns[j] - stamps_ns[i] < 2 * interval_ns
    i, j = i[near], j[near]
    R = B[:, :3, :3]
    steps = se3.so3_logmap(R[1:] @ R[:-1].transpose(0, 2, 1))
    return stamps_ns[i], stamps_ns[j], se3.so3_logmap(R[j] @ R[i].transpose(0, 2, 1)), np.diff(steps, axis=0)
