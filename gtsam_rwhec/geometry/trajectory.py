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
        """A trajectory from checked stamps and poses.

        Parameters
        ----------
        stamps_ns : (N,) integers
            Strictly increasing.
        poses : (N, 4, 4) array, list of gtsam.Pose3, or (N, 7) rows
        where : str
            Topic or file, for messages.
        order : "wxyz" or "xyzw", optional
            Order of the quaternions in rows.

        Raises
        ------
        PoseError
            If there is no pose, or a pose is not valid.
        StampError
            If the stamps are all zero, not increasing, not integers, or not as many as the poses.
        """
        transforms = as_transforms(poses, order, where)
        stamps = increasing_stamps(stamps_ns, len(transforms), where)
        if len(transforms) == 0:
            raise PoseError(f"{where}: there are no poses; give at least one")
        rows = checked_rows(transforms, 0, where).rows
        return Trajectory(stamps, rows_to_transforms(rows), where)

    @property
    def span_s(self) -> tuple[float, float]:
        """The first and the last stamp, seconds."""
        return float(self.stamps_ns[0]) * 1e-9, float(self.stamps_ns[-1]) * 1e-9

    def at(self, stamps_ns: np.ndarray) -> tuple[Array, Array]:
        """Poses (M, 4, 4) at stamps (M,), and the gap (M,) in seconds between the two poses that each is between.

        T_i Expmap(tau Log(T_i^-1 T_i+1)) interpolates (Barfoot, State Estimation for Robotics, Chapter 8). At the stamp
        of a pose the gap is 0. Outside the trajectory the gap is infinite, and the pose is the nearest one.
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

    def gaps(self, stamps_ns: np.ndarray) -> Array:
        """The gaps (M,) of ``at``, seconds, without the poses."""
        after = np.clip(np.searchsorted(self.stamps_ns, stamps_ns), 0, len(self.T) - 1)
        before = np.where(self.stamps_ns[after] == stamps_ns, after, np.maximum(after - 1, 0))
        outside = (stamps_ns < self.stamps_ns[0]) | (stamps_ns > self.stamps_ns[-1])
        return np.where(outside, np.inf, (self.stamps_ns[after] - self.stamps_ns[before]) * 1e-9)

    def speeds(self) -> tuple[Array, Array]:
        """Angular (rad/s) and linear (m/s) speed at each pose, (N,): the faster of the steps before and after it."""
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
    """The stamps as (count,) strictly increasing integer nanoseconds; StampError for any others."""
    stamps = np.asarray(stamps_ns)
    if stamps.shape != (count,):
        raise StampError(f"{where}: stamps have shape {stamps.shape} for {count} poses; give one stamp for each pose")
    if count == 0:
        return stamps.astype(np.int64)
    if not np.issubdtype(stamps.dtype, np.integer):
        raise StampError(f"{where}: stamps are {stamps.dtype}; give integer nanoseconds")
    stamps = stamps.astype(np.int64)
    if count > 1 and not stamps.any():
        raise StampError(
            f"{where}: all {count} stamps are 0, so the driver does not fill header.stamp; use the log's own time"
        )
    step = np.diff(stamps)
    if (step <= 0).any():
        i = int(np.flatnonzero(step <= 0)[0])
        word = "repeats" if step[i] == 0 else "is before"
        raise StampError(
            f"{where}: stamp {i + 1} ({stamps[i + 1]} ns) {word} the stamp ahead of it ({stamps[i]} ns); sort "
            "the messages by header.stamp and leave repeated messages out"
        )
    return stamps
