"""Limits for odometry (DQ paper, Appendix D.1): the largest step of a sensor, the largest distance of two stamps."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cleaning.removed import Kept, RemovalReason
from gtsam_rwhec.geometry.poses import Array

#: Metres. By the paper, a step between two consecutive frames that is larger than this is a tracking error.
MAX_STEP_M = 0.10
#: Radians. The paper limits the turn in the same step to 11.5 degrees.
MAX_STEP_RAD = float(np.radians(11.5))
#: Seconds. By the paper, two sensors' poses with stamps further apart than this are not of one instant.
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
    """Keep the poses of one instant that both sensors reached in a step within the limits.

    Parameters
    ----------
    T_first, T_second : (N, 4, 4) arrays
        Poses of two sensors, metres. Row i of both arrays is of about one instant.
    stamps_first_ns, stamps_second_ns : (N,) integers
    max_step_m, max_step_rad, max_apart_s : float

    Returns
    -------
    Kept
        The pose after a step that is too large is removed. The next pose is still compared with it, as in the paper.
    """
    apart_s = np.abs(stamps_first_ns - stamps_second_ns) * 1e-9
    checks = [(RemovalReason.STAMPS_APART, apart_s, max_apart_s)]
    for T, too_far, too_turned in (
        (T_first, RemovalReason.FIRST_SENSOR_STEP_M, RemovalReason.FIRST_SENSOR_STEP_RAD),
        (T_second, RemovalReason.SECOND_SENSOR_STEP_M, RemovalReason.SECOND_SENSOR_STEP_RAD),
    ):
        step = se3.inverse(T[:-1]) @ T[1:]
        checks.append((too_far, np.r_[0.0, np.linalg.norm(step[:, :3, 3], axis=1)], max_step_m))
        checks.append((too_turned, np.r_[0.0, np.linalg.norm(se3.so3_logmap(step[:, :3, :3]), axis=1)], max_step_rad))
    return Kept.within(stamps_first_ns, *checks)
