"""Cleaning of odometries: steps that are too fast, jumps of tracking, and gaps are not used, with the reason.

The DQ paper (Appendix D.1) limits the step between two frames to 0.10 m and 11.5 degrees, which depends on its frame
rate. Here the limits are speeds. A step must also be like the steps before and after it: a step that is not is a jump
of tracking.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.odometry_track import OdometryTrack
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.logs import Log
from gtsam_rwhec.results.log_history import RemovalReason, Removed
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs
from gtsam_rwhec.runs.odometry_motions import read_odometry

#: A step is a jump if its velocity differs from the mean of its neighbours' by this many robust standard deviations.
JUMP = 12.0
#: A jump is larger than this, whatever the deviation: rad/s and m/s.
LEAST_RAD_PER_S, LEAST_M_PER_S = 0.2, 0.5


@dataclass(frozen=True)
class Gates:
    """Limits of a track's speed (m/s, rad/s): faster steps are not used. `reject_jumps`: jumps are not used either."""

    max_speed_m_per_s: float
    max_turn_rad_per_s: float
    reject_jumps: bool


def gates_of(rig: Rig) -> Gates:
    """The widest gates of all odometries of a rig file."""
    sources = [one.odometry for one in rig.odometries.values()]
    return Gates(
        max_speed_m_per_s=max(one.max_speed_m_s for one in sources),
        max_turn_rad_per_s=float(np.radians(max(one.max_turn_deg_s for one in sources))),
        reject_jumps=rig.cleaning.robust != "none",
    )


@dataclass(frozen=True)
class Gated:
    """Which steps (N - 1,) of a track are good, why the others are not, and the track with the bad steps replaced.

    A bad step is replaced by one like its neighbours, and all later poses move with it. So the track has no jump that
    would spoil interpolation and comparisons nearby. Motions over a bad step are not used.
    """

    good: np.ndarray
    removed: tuple[Removed, ...]
    track: OdometryTrack


def gated(track: OdometryTrack, gates: Gates) -> Gated:
    """Find the steps with speeds within the limits, and without jumps."""
    stamps, T = np.asarray(track.stamps_ns), np.asarray(track.T_start_sensor)
    dt = np.diff(stamps) * 1e-9
    velocity = se3.logmap(se3.inverse(T[:-1]) @ T[1:]) / dt[:, None]
    turning, moving = np.linalg.norm(velocity[:, :3], axis=1), np.linalg.norm(velocity[:, 3:], axis=1)
    limits = [(RemovalReason.TURNING_FAST, turning, gates.max_turn_rad_per_s)]
    if not track.has_unknown_scale:
        limits.append((RemovalReason.MOVING_FAST, moving, gates.max_speed_m_per_s))
    removed: dict[int, Removed] = {}
    for reason, values, limit in limits:
        _add(removed, reason, values, limit, stamps)
    if gates.reject_jumps and len(dt) >= 5:
        least_m = LEAST_M_PER_S if not track.has_unknown_scale else 0.2 * float(np.median(moving))
        for reason, part, least in (
            (RemovalReason.FIRST_SENSOR_STEP_RAD, velocity[:, :3], LEAST_RAD_PER_S),
            (RemovalReason.FIRST_SENSOR_STEP_M, velocity[:, 3:], least_m),
        ):
            off = _off_neighbours(part)
            limit = max(least, JUMP * float(np.median(off)) / 0.6745)
            worst = off > limit
            # Steps beside a jump differ from their neighbours by half of it. So of several steps in a row only the
            # largest counts.
            peak = worst & (off >= np.r_[0.0, off[:-1]]) & (off >= np.r_[off[1:], 0.0])
            values = np.where(peak, off * np.r_[dt], 0.0)
            _add(removed, reason, values, limit * float(np.median(dt)), stamps)
    good = np.ones(len(dt), dtype=bool)
    good[[item.index - 1 for item in removed.values()]] = False
    return Gated(good, tuple(removed[i] for i in sorted(removed)), _smoothed(track, velocity, dt, good))


def _smoothed(track: OdometryTrack, velocity: Array, dt: Array, good: np.ndarray) -> OdometryTrack:
    """Replace each bad step by one with the mean velocity of the nearest good steps before and after it."""
    bad = np.flatnonzero(~good)
    known = np.flatnonzero(good)
    if not len(bad) or not len(known):
        return track
    T = np.asarray(track.T_start_sensor)
    after = known[np.clip(np.searchsorted(known, bad), 0, len(known) - 1)]
    before = known[np.clip(np.searchsorted(known, bad) - 1, 0, len(known) - 1)]
    steps = se3.expmap(0.5 * (velocity[after] + velocity[before]) * dt[bad, None])
    repaired, moved = T.copy(), np.eye(4)
    for i, step, end in zip(bad, steps, np.r_[bad[1:], len(T) - 1], strict=True):
        # Pose i + 1 becomes repaired pose i and one step; all poses up to the next bad step move with it.
        moved = repaired[i] @ step @ se3.inverse(T[i + 1][None])[0]
        repaired[i + 1 : end + 1] = moved @ T[i + 1 : end + 1]
    return replace(track, T_start_sensor=repaired)


def _off_neighbours(velocity: Array) -> Array:
    """How far each velocity is from the mean of the velocities before and after it."""
    padded = np.vstack([velocity[1:2], velocity, velocity[-2:-1]])
    off: Array = np.linalg.norm(velocity - 0.5 * (padded[:-2] + padded[2:]), axis=1)
    return off


def _add(removed: dict[int, Removed], reason: RemovalReason, values: Array, limit: float, stamps: np.ndarray) -> None:
    """Add the pose at the end of each step whose value exceeds the limit. A pose added before keeps its reason."""
    for i in np.flatnonzero(values > limit).tolist():
        removed.setdefault(i + 1, Removed(reason, i + 1, int(stamps[i + 1]), float(values[i]), float(limit)))


def odometry_steps(log: Log, rig: Rig, reference: OdometryTrack, sensor: str) -> MeasuredPairs:
    """The motions of a sensor and of the reference between successive poses of the sensor, with reasons for bad steps.

    A and B are the motions T_before_after of the reference and of the sensor; the stamps are those after each step. The
    calibration itself compares motions over longer windows, of all sensors together.
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
    for removed in gated(track, gates_of(rig)).removed:
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
