"""The carrier's pose at each of a sensor's stamps (RWHEC paper, Section 9, step 3)."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.cleaning.removed import Kept, RemovalReason
from gtsam_rwhec.errors import StampError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.trajectories.trajectory import Trajectory

#: Seconds. Poses further apart than this are not interpolated: an arm at 1 m/s moves 20 cm in this time.
MAX_GAP_S = 0.2


def synchronise(
    carrier: Trajectory,
    stamps_ns: np.ndarray,
    *,
    time_offset_s: float = 0.0,
    max_gap_s: float = MAX_GAP_S,
    where: str = "the sensor",
    needs_overlap: bool = True,
) -> tuple[Array, Kept]:
    """The carrier's pose at each of a sensor's stamps.

    Parameters
    ----------
    carrier : Trajectory
        Poses of the carrier.
    stamps_ns : (M,) integers
        Stamps of the sensor.
    time_offset_s : float
        The sensor's stamp t is the carrier's t + offset (Kalibr's convention).
    max_gap_s : float
        Poses further apart in time than this are not interpolated.
    where : str
        The sensor, for messages.
    needs_overlap : bool
        True: it is an error that no stamp is inside the trajectory.

    Returns
    -------
    A : (M, 4, 4) array
        The carrier's poses, metres.
    kept : Kept
        Removes stamps outside the trajectory and in its gaps.

    Raises
    ------
    StampError
        No stamp is inside the trajectory, and `needs_overlap` is true. Most often the clocks differ.
    """
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    A, gap_s = carrier.at(stamps + round(time_offset_s * 1e9))
    outside = np.isinf(gap_s)
    first, last = carrier.span_s
    if needs_overlap and len(stamps) and outside.all():
        raise StampError(
            f"no overlap in time: {carrier.where} is from {first:.3f} to {last:.3f} s, the stamps of {where} (with its "
            f"time offset of {time_offset_s:g} s) are from {stamps.min() * 1e-9 + time_offset_s:.3f} to "
            f"{stamps.max() * 1e-9 + time_offset_s:.3f} s. Are they of different clocks? If the clocks' difference is "
            "constant and known, give it as the sensor's time offset"
        )
    limits = np.where(stamps > carrier.stamps_ns[0], last, first)
    return A, Kept.by_all(
        Kept.of(outside, RemovalReason.OUTSIDE_TRAJECTORY, stamps, stamps * 1e-9, limits),
        Kept.of(gap_s > max_gap_s, RemovalReason.GAP, stamps, gap_s, max_gap_s),
    )
