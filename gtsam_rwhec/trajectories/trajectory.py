"""A carrier's poses over time, and their interpolation on SE(3) (RWHEC paper, Section 9, step 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from rwhec_factors import se3

from gtsam_rwhec.errors import PoseError, StampError
from gtsam_rwhec.geometry.poses import (
    Array,
    PosesLike,
    QuaternionOrder,
    as_transforms,
    checked_rows,
    rows_to_transforms,
)


@dataclass(frozen=True)
class Trajectory:
    """Poses T_a_b (N, 4, 4), metres, at strictly increasing stamps (N,), nanoseconds."""

    stamps_ns: np.ndarray
    T: Array
    where: str = "the trajectory"

    @staticmethod
    def of(
        stamps_ns: ArrayLike, poses: PosesLike, where: str = "the trajectory", order: QuaternionOrder | None = None
    ) -> Trajectory:
        """Check and make one.

        Parameters
        ----------
        stamps_ns : (N,) integers
            Strictly increasing.
        poses : (N, 4, 4) array, list of gtsam.Pose3, or (N, 7) rows
        where : str
            Topic or file, for messages.
        order : "wxyz" or "xyzw", optional
            Of quaternions in rows.

        Raises
        ------
        PoseError
            For poses that are none.
        StampError
            For stamps that are all zero, not increasing, no integers, or another number of them.
        """
        transforms = as_transforms(poses, order, where)
        stamps = increasing_stamps(stamps_ns, len(transforms), where)
        if len(transforms) == 0:
            raise PoseError(f"{where}: no poses")
        rows, _ = checked_rows(transforms, 0, where)
        return Trajectory(stamps, rows_to_transforms(rows), where)

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last stamp, seconds."""
        return float(self.stamps_ns[0]) * 1e-9, float(self.stamps_ns[-1]) * 1e-9

    def at(self, stamps_ns: np.ndarray) -> tuple[Array, Array]:
        """Poses (M, 4, 4) at stamps (M,), and the gap (M,) that each was interpolated over, in seconds.

        T_i Expmap(tau Log(T_i^-1 T_i+1)) between its neighbours (Barfoot, State Estimation for Robotics, Chapter 8).
        Where a stamp meets a pose the gap is 0; outside the trajectory it is infinite, and the pose the nearest one.
        """
        stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
        after = np.clip(np.searchsorted(self.stamps_ns, stamps_ns), 0, len(self.T) - 1)
        met = self.stamps_ns[after] == stamps_ns
        before = np.where(met, after, np.maximum(after - 1, 0))
        outside = (stamps_ns < self.stamps_ns[0]) | (stamps_ns > self.stamps_ns[-1])
        gap_ns = self.stamps_ns[after] - self.stamps_ns[before]
        inside = ~met & ~outside
        poses = self.T[after].copy()
        first = self.T[before[inside]]
        share = (stamps_ns[inside] - self.stamps_ns[before[inside]]) / gap_ns[inside]
        step = se3.logmap(se3.inverse(first) @ self.T[after[inside]])
        poses[inside] = first @ se3.expmap(share[:, None] * step)
        gap_s = np.where(outside, np.inf, np.where(met, 0.0, gap_ns * 1e-9))
        return poses, gap_s

    def speeds(self) -> tuple[Array, Array]:
        """Turning (rad/s) and moving (m/s) of each pose, (N,): the faster of the steps before and after it."""
        if len(self.T) < 2:
            return np.zeros(len(self.T)), np.zeros(len(self.T))
        seconds = np.diff(self.stamps_ns) * 1e-9
        step = se3.inverse(self.T[:-1]) @ self.T[1:]
        turning = np.linalg.norm(se3.so3_logmap(step[:, :3, :3]), axis=1) / seconds
        moving = np.linalg.norm(step[:, :3, 3], axis=1) / seconds
        return (
            np.maximum(np.r_[turning, turning[-1]], np.r_[turning[0], turning]),
            np.maximum(np.r_[moving, moving[-1]], np.r_[moving[0], moving]),
        )


def increasing_stamps(stamps_ns: ArrayLike, count: int, where: str) -> np.ndarray:
    """(count,) strictly increasing integer nanoseconds.

    Raises
    ------
    StampError
        For what is none.
    """
    stamps = np.asarray(stamps_ns)
    if stamps.shape != (count,):
        raise StampError(f"{where}: stamps have shape {stamps.shape} for {count} poses")
    if count == 0:
        return stamps.astype(np.int64)
    if not np.issubdtype(stamps.dtype, np.integer):
        raise StampError(f"{where}: stamps are of {stamps.dtype}; give integer nanoseconds")
    stamps = stamps.astype(np.int64)
    if count > 1 and not stamps.any():
        raise StampError(
            f"{where}: all {count} stamps are 0; does the driver fill header.stamp? Use the log's own time"
        )
    step = np.diff(stamps)
    if (step <= 0).any():
        i = int(np.flatnonzero(step <= 0)[0])
        word = "repeats" if step[i] == 0 else "is before"
        raise StampError(
            f"{where}: stamp {i + 1} ({stamps[i + 1]} ns) {word} the one ahead of it ({stamps[i]} ns); sort the "
            "messages by header.stamp and leave repeated ones out"
        )
    return stamps
