"""Cleaning of odometries that are calibrated with one another: their steps, and why some are not used."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.logs import Log
from gtsam_rwhec.odometry import OdometryTrack
from gtsam_rwhec.odometry.gates import gated
from gtsam_rwhec.results.removed_measurements import RemovalReason
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs
from gtsam_rwhec.runs.odometry_solving import options_of
from gtsam_rwhec.runs.odometry_tracks import read_odometry


def odometry_steps(log: Log, rig: Rig, reference: OdometryTrack, sensor: str) -> MeasuredPairs:
    """The motions of a sensor from each of its poses to the next, with the gates' reasons, beside the reference's.

    A and B are the motions T_before_after of the reference and of the sensor; the stamps are those after each step.
    The answer compares longer windows of them, all sensors at once.
    """
    track = reference if sensor == reference.sensor else read_odometry(log, rig, sensor)
    stamps, T = np.asarray(track.stamps_ns), np.asarray(track.T_start_sensor)
    offset = rig.odometries[sensor].time_offset
    shift = 0 if offset == "estimate" else round(1e9 * float(offset))
    path = Trajectory(np.asarray(reference.stamps_ns), np.asarray(reference.T_start_sensor), reference.sensor)
    at, gap_s = path.at(stamps + shift)
    reasons = [""] * (len(stamps) - 1)
    for i in np.flatnonzero(np.isinf(gap_s[1:]) | np.isinf(gap_s[:-1])).tolist():
        reasons[i] = RemovalReason.OUTSIDE_TRAJECTORY
    own_gap = np.diff(stamps) > 1e9 * rig.odometries[sensor].odometry.max_gap_s
    for i in np.flatnonzero(own_gap).tolist():
        reasons[i] = RemovalReason.ODOMETRY_GAP
    for removed in gated(track, options_of(rig)).removed:
        reasons[removed.index - 1] = removed.reason
    return MeasuredPairs(
        target=sensor,
        sensor=sensor,
        stamps_ns=stamps[1:],
        B=se3.inverse(T[:-1]) @ T[1:],
        covariance=None,
        reasons=tuple(str(reason) for reason in reasons),
        A=se3.inverse(at[:-1]) @ at[1:],
    )
