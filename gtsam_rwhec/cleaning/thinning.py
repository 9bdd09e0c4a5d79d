"""Two steps of cleaning: most measurements at standstill are removed, and all measurements in fast motion."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.cleaning.removed import Kept, RemovalReason
from gtsam_rwhec.geometry.poses import Array

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
