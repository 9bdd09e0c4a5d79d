"""Limits for odometry (DQ paper, Appendix D.1): steps that no sensor can make, stamps too far apart for one instant."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cleaning.removed import Kept, RemovalReason
from gtsam_rwhec.geometry.poses import Array

#: The paper's: 10 cm or 11.5 degrees between two consecutive frames indicate a tracking error.
MAX_STEP_M = 0.10
MAX_STEP_RAD = float(np.radians(11.5))
#: The paper's: further apart than this, two sensors' poses are not of one instant.
MAX_APART_S = 0.1


def odometry_gates(
    T_first: Array,
    T_second: Array,
    stamps_first_ns: np.ndarray,
    stamps_second_ns: np.ndarray,
    *,
    max_step_m: float = MAX_STEP_M,
    max_step_rad: float = MAX_STEP_RAD,
    max_apart_s: float = MAX_APART_S,
) -> Kept:
    """Keep poses that both sensors reached in a step that can be, at one instant.

    Parameters
    ----------
    T_first, T_second : (N, 4, 4) arrays
        Poses of two sensors, row by row of about one instant; metres.
    stamps_first_ns, stamps_second_ns : (N,) integers
    max_step_m, max_step_rad, max_apart_s : float

    Returns
    -------
    Kept
        A pose after a step too large is removed; the next is compared with it all the same, as the paper does.
    """
    apart = np.abs(stamps_first_ns - stamps_second_ns) * 1e-9
    kept = Kept.of(apart > max_apart_s, RemovalReason.STAMPS_APART, stamps_first_ns, apart, max_apart_s)
    for T, too_far, too_turned in (
        (T_first, RemovalReason.FIRST_SENSOR_STEP_M, RemovalReason.FIRST_SENSOR_STEP_RAD),
        (T_second, RemovalReason.SECOND_SENSOR_STEP_M, RemovalReason.SECOND_SENSOR_STEP_RAD),
    ):
        step = se3.inverse(T[:-1]) @ T[1:]
        metres = np.r_[0.0, np.linalg.norm(step[:, :3, 3], axis=1)]
        radians = np.r_[0.0, np.linalg.norm(se3.so3_logmap(step[:, :3, :3]), axis=1)]
        kept = kept.and_of(metres > max_step_m, too_far, stamps_first_ns, metres, max_step_m)
        kept = kept.and_of(radians > max_step_rad, too_turned, stamps_first_ns, radians, max_step_rad)
    return kept
