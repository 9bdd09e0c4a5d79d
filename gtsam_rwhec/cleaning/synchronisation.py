"""The carrier's pose at each of a sensor's stamps (RWHEC paper, Section 9, step 3)."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.cleaning.removed import Kept, RemovalReason, Removed
from gtsam_rwhec.errors import StampError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.trajectories.trajectory import Trajectory

#: Poses further apart than this are not bridged: an arm at 1 m/s is 20 cm further by then.
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
    stamps_ns : (M,) integers
        The sensor's.
    time_offset_s : float
        The sensor's stamp t is the carrier's t + offset (Kalibr's convention).
    max_gap_s : float
        Between poses further apart than this nothing is interpolated.
    where : str
        The sensor, for messages.
    needs_overlap : bool
        Whether it is an error that no stamp is inside the trajectory.

    Returns
    -------
    A : (M, 4, 4) array
    kept : Kept

    Raises
    ------
    StampError
        When no stamp is inside the trajectory, and one must: other clocks, most often.
    """
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    A, gap_s = carrier.at(stamps + round(time_offset_s * 1e9))
    outside = np.isinf(gap_s)
    if needs_overlap and len(stamps) and outside.all():
        first, last = carrier.span_s
        raise StampError(
            f"no overlap in time: {carrier.where} is from {first:.3f} to {last:.3f} s, the stamps of {where} (with its "
            f"time offset of {time_offset_s:g} s) from {stamps.min() * 1e-9 + time_offset_s:.3f} to "
            f"{stamps.max() * 1e-9 + time_offset_s:.3f} s; are they of different clocks? If their difference is "
            "constant and known, it goes into the sensor's time offset"
        )
    begins = carrier.stamps_ns[0]
    removed = tuple(
        Removed(
            RemovalReason.OUTSIDE_TRAJECTORY, int(i), int(stamps[i]), float(stamps[i]) * 1e-9,
            carrier.span_s[int(stamps[i] > begins)],
        )
        for i in np.flatnonzero(outside)
    )  # fmt: skip
    kept = Kept(~outside, removed)
    return A, kept.and_of(gap_s > max_gap_s, RemovalReason.GAP, stamps, gap_s, max_gap_s)
