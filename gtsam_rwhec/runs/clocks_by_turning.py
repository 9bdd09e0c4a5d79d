"""Time offsets of sensors from rotations alone: estimates, and a check of those that the rig file states.

Rotations determine an offset of any size before anything is calibrated. So offsets are estimated from them first. They
also show a wrong stated offset, which large residuals of a calibration would hide. If the rig file exchanges the
carriers, their poses turn the other way, and the rotations agree at no offset. The offset is then found along the
inverse path, so that the next stage can report the exchange.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.calibration.verdict import Finding, Ground
from gtsam_rwhec.errors import StampError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.time_offset import TimeOffset, estimate_time_offset
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.rig import Rig
from gtsam_rwhec.runs.measured_pairs import MeasuredPairs

#: Rotations of one target by one sensor: stamps (M,), B (M, 4, 4).
Detections = tuple[np.ndarray, Array]
#: Radians about each axis. If rotations agree within this, the direction of the path is right, and the inverse is not
#: tried.
PLAIN_RAD = np.radians(2.0)
#: Rotations contradict a stated offset if theirs differs by more than this, in seconds and in standard deviations.
#: Smaller differences are left to the calibration, which knows the noise better.
LATE_S, SURELY = 0.03, 8.0
#: The other direction of the carriers' path must fit better by this factor.
FAR_BETTER = 2.0


def offset_of_either_direction(
    path: Trajectory, tracks: Sequence[Detections], max_gap_s: float, sensor: str
) -> TimeOffset:
    """The time offset of a sensor, along the carriers' path or, if that fits far better, along its inverse.

    Raises `StampError` if the motion determines no offset in either direction.
    """
    found, why = _offset(path, tracks, max_gap_s, sensor)
    if found is not None and found.rms_rad < PLAIN_RAD:
        return found
    other, _ = _offset(replace(path, T=se3.inverse(path.T)), tracks, max_gap_s, sensor)
    if other is not None and other.rms_rad < PLAIN_RAD and (found is None or _is_far_better(other, found)):
        return other
    if found is None:
        assert why is not None
        raise why
    return found


def late_clocks(
    pairs: Mapping[Pair, MeasuredPairs], path: Trajectory, rig: Rig, stated_s: Mapping[str, float]
) -> list[Finding]:
    """Findings about sensors whose rotations agree with the carriers' at another time offset than the stated one.

    ``pairs`` has measurements of which none is marked as an outlier yet, ``path`` T_sensorcarrier_targetcarrier over
    time, and ``stated_s`` the stated offsets by sensor, seconds.
    """
    findings = []
    for sensor, stated in stated_s.items():
        tracks = [(m.stamps_ns[m.used], m.B[m.used]) for m in pairs.values() if m.sensor == sensor and m.used.any()]
        if not tracks:
            continue
        found, _ = _offset(path, tracks, rig.carriers.max_gap_s, sensor)
        if found is None or found.rms_rad > PLAIN_RAD:
            continue  # the motion does not tell, or other things are wrong
        off = found.offset_s - stated
        if abs(off) > LATE_S and abs(off) > SURELY * found.sigma_s:
            words = (
                f"the time offset of {sensor} is {stated:g} s in the rig file, but its rotations agree with the "
                f"carriers' at {1e3 * found.offset_s:+.1f} ms, to +-{1e3 * found.sigma_s:.1f} ms "
                f"({rig.source.place(('sensors', sensor, 'time_offset'))}: write time_offset: estimate)"
            )
            findings.append(Finding(Ground.LATE_CLOCK, words))
    return findings


def _offset(
    path: Trajectory, tracks: Sequence[Detections], max_gap_s: float, sensor: str
) -> tuple[TimeOffset | None, StampError | None]:
    try:
        return estimate_time_offset(path, tracks, max_gap_s=max_gap_s, where=sensor), None
    except StampError as error:
        return None, error


def _is_far_better(one: TimeOffset, other: TimeOffset) -> bool:
    return FAR_BETTER * one.rms_rad < other.rms_rad and 2 * one.measurements > other.measurements
