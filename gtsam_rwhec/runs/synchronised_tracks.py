"""The carrier's pose at each of a sensor's stamps (RWHEC paper, Section 9, step 3), and thinning.

Most measurements at standstill are removed, and all measurements in fast motion.
"""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.errors import StampError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.results.removed_measurements import Kept, RemovalReason

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


#: Radians. A carrier that has turned and moved less than this since the last measurement kept has stood still.
STILL_RAD = float(np.radians(0.5))
#: Metres; see `STILL_RAD`.
STILL_M = 0.003


def thin(
    A: Array, stamps_ns: np.ndarray, *, min_rotation_rad: float = STILL_RAD, min_translation_m: float = STILL_M
) -> Kept:
    """Keep a measurement if the carrier has turned or moved since the last measurement that was kept.

    A hundred images at one pose weigh a hundred times, and they share the error of that pose (A). A covariance that
    takes the images for independent is then too small.

    Parameters
    ----------
    A : (N, 4, 4) array
        The carrier's poses, in order of time, metres.
    stamps_ns : (N,) integers
    min_rotation_rad, min_translation_m : float
    """
    bad = np.zeros(len(A), dtype=bool)
    moved = np.zeros(len(A))
    last = 0
    # |R - R'|_F = sqrt(8) sin(angle / 2), so the comparison with a limit needs no logarithm.
    limit = np.sqrt(8.0) * np.sin(0.5 * min(min_rotation_rad, np.pi))
    R, t = A[:, :3, :3], A[:, :3, 3]
    for i in range(1, len(A)):
        moved[i] = np.sqrt(((t[i] - t[last]) ** 2).sum())
        if moved[i] < min_translation_m and ((R[i] - R[last]) ** 2).sum() < limit**2:
            bad[i] = True
        else:
            last = i
    return Kept.of(bad, RemovalReason.STANDSTILL, stamps_ns, moved, min_translation_m)


def without_fast(
    turning_rad_s: Array, moving_m_s: Array, stamps_ns: np.ndarray, *, max_turning_rad_s: float, max_moving_m_s: float
) -> Kept:
    """Keep the measurements at low speed: fast motion blurs images, and errors of stamps count more.

    Parameters
    ----------
    turning_rad_s, moving_m_s : (N,) arrays
        The carrier's speeds at each measurement.
    stamps_ns : (N,) integers
    max_turning_rad_s, max_moving_m_s : float
    """
    return Kept.within(
        stamps_ns,
        (RemovalReason.TURNING_FAST, turning_rad_s, max_turning_rad_s),
        (RemovalReason.MOVING_FAST, moving_m_s, max_moving_m_s),
    )
