"""Measurements at standstill, of which few are kept, and in fast motion, which are removed."""

from __future__ import annotations

import numpy as np

from gtsam_rwhec.cleaning.removed import Kept, RemovalReason
from gtsam_rwhec.geometry.poses import Array

#: A carrier that has turned (rad) and moved (m) less than this since the last measurement kept has stood still.
STILL_RAD = float(np.radians(0.5))
STILL_M = 0.003


def thin(
    A: Array, stamps_ns: np.ndarray, *, min_rotation_rad: float = STILL_RAD, min_translation_m: float = STILL_M
) -> Kept:
    """Keep a measurement when the carrier has turned or moved since the last one kept.

    A hundred frames at one pose weigh a hundred times, and share the error of that pose (A's), which no covariance
    that takes them for independent knows.

    Parameters
    ----------
    A : (N, 4, 4) array
        Carrier poses, in order of time, metres.
    stamps_ns : (N,) integers
    min_rotation_rad, min_translation_m : float
    """
    bad = np.zeros(len(A), dtype=bool)
    moved = np.zeros(len(A))
    last = 0
    # |R - R'|_F = sqrt(8) sin(angle / 2): no logarithm needed to compare with a limit
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
    turning_rad_s: Array,
    moving_m_s: Array,
    stamps_ns: np.ndarray,
    *,
    max_turning_rad_s: float,
    max_moving_m_s: float,
) -> Kept:
    """Keep what was seen slowly: fast motion blurs images and makes stamps matter.

    Parameters
    ----------
    turning_rad_s, moving_m_s : (N,) arrays
        The carrier's speeds at each measurement.
    stamps_ns : (N,) integers
    max_turning_rad_s, max_moving_m_s : float
    """
    kept = Kept.of(
        turning_rad_s > max_turning_rad_s, RemovalReason.TURNING_FAST, stamps_ns, turning_rad_s, max_turning_rad_s
    )
    return kept.and_of(moving_m_s > max_moving_m_s, RemovalReason.MOVING_FAST, stamps_ns, moving_m_s, max_moving_m_s)
