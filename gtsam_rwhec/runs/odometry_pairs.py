"""Cleaning of an odometry beside carriers whose motion is known: its clock, and its motions as measured pairs."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.logs import Log
from gtsam_rwhec.odometry import OdometryTrack
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.carrier_motion import CarrierMotion
from gtsam_rwhec.runs.clocks_by_turning import offset_of_either_direction
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs
from gtsam_rwhec.runs.odometry_tracks import read_odometry
from gtsam_rwhec.runs.odometry_windows import odometry_windows

#: Seconds. Clocks are compared over pieces of this length, within which an odometry has hardly drifted.
PIECE_S = 30.0
#: With fewer windows a sensor has no answer.
FEWEST_USED = 3


def odometry_pairs(log: Log, rig: Rig, sensor: str, motion: CarrierMotion) -> tuple[MeasuredPairs, float, float | None]:
    """The motions of an odometry against the carriers', A Y = Y B; its time offset, and its deviation if estimated.

    Raises
    ------
    StampError
        The motion does not determine the time offset.
    LogError
        No window is left.
    """
    track = read_odometry(log, rig, sensor)
    section = rig.odometries[sensor]
    offset_s, sigma_s = _time_offset(track, rig, motion.trajectory)
    windows = odometry_windows(
        track, motion.trajectory, offset_s, section.odometry, rig.cleaning, rig.carriers.max_gap_s
    )
    pairs = MeasuredPairs(
        target=sensor,
        sensor=sensor,
        stamps_ns=windows.end_ns,
        B=windows.B,
        covariance=windows.covariance,
        reasons=windows.reasons,
        A=windows.A,
    )
    if pairs.used.sum() < FEWEST_USED:
        removed = ", ".join(f"{why}: {count}" for why, count in pairs.count.removed.items()) or "none was removed"
        raise LogError(
            f"{rig.source.place(('sensors', sensor))}: {section.odometry.place} has {int(pairs.used.sum())} windows of "
            f"{windows.window_s:g} s to compare with the carriers' motion, of {len(pairs.B)} ({removed}). Are both of "
            "one drive and of one clock? Else leave the sensor out"
        )
    return pairs, offset_s, sigma_s


def _time_offset(track: OdometryTrack, rig: Rig, path: Trajectory) -> tuple[float, float | None]:
    given = rig.odometries[track.sensor].time_offset
    if given != "estimate":
        return float(given), None
    stamps, B = np.asarray(track.stamps_ns), se3.inverse(np.asarray(track.T_start_sensor))
    piece = ((stamps - stamps[0]) // round(1e9 * PIECE_S)).astype(int)
    pieces = [(stamps[piece == k], B[piece == k]) for k in np.unique(piece) if (piece == k).sum() >= 2]
    found = offset_of_either_direction(path, pieces, rig.carriers.max_gap_s, track.sensor)
    return found.offset_s, found.sigma_s
