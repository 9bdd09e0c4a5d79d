"""Tracks that cannot be of one drive, or are read in a wrong way, before anything is solved.

All sensors of a vehicle turn by the same angles, whatever their mounts, and a vehicle goes much the same way in its own
axes all the time: ahead.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import OutlierError, StampError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.tracks import OdometryTrack

#: Motions over about so many seconds are compared.
STEP_S = 1.0
#: A track whose root mean square turn is less than this part of that of all others stands still beside them.
TURNS_LESS = 0.2
#: Below this, rad/s, all turns may be noise: whether the vehicle turned is another question.
LEAST_TURN = float(np.radians(1.0))
#: A track has at least so many poses in the time of the others.
FEWEST_SHARED = 3
#: Poses are taken as inverted where, read the other way, the vehicle would go so much more in one direction.
MORE_AHEAD = 0.5


def check_common_time(tracks: Sequence[OdometryTrack], search_s: float) -> None:
    """Raise `StampError` where a track shares too little time with the first, clocks being off by ``search_s``."""
    first = tracks[0]
    margin = round(1e9 * search_s)
    for other in tracks[1:]:
        for one, two in ((first, other), (other, first)):
            begin, end = int(two.stamps_ns[0]) - margin, int(two.stamps_ns[-1]) + margin
            shared = int(((one.stamps_ns >= begin) & (one.stamps_ns <= end)).sum())
            if shared < FEWEST_SHARED:
                raise StampError(
                    f"the tracks of {_lasts(first)} and {_lasts(other)} have no common time: {shared} poses of "
                    f"{one.sensor} are in the time of {two.sensor}; are they of one drive and one clock, with stamps "
                    "in one unit?"
                )


def check_turns(tracks: Sequence[OdometryTrack]) -> None:
    """Raise `OutlierError` where a track stands still while the others turn."""
    turns = np.array([float(np.sqrt((_velocities(track)[:, :3] ** 2).sum(axis=1).mean())) for track in tracks])
    for track, turn in zip(tracks, turns, strict=True):
        others = float(np.median(turns[turns != turn])) if (turns != turn).any() else turn
        if others > LEAST_TURN and turn < TURNS_LESS * others:
            raise OutlierError(
                f"{track.sensor} turns by {np.degrees(turn):.2g} degrees a second, and the other sensors by "
                f"{np.degrees(others):.2g}: sensors of one vehicle turn alike. Does its odometry stand still, is it on "
                "another vehicle, or are its quaternions in another order than x y z w?"
            )


def check_not_the_same(tracks: Sequence[OdometryTrack]) -> None:
    """Raise `OutlierError` where two tracks are one: their poses say nothing of two sensors."""
    for i, one in enumerate(tracks):
        for two in tracks[i + 1 :]:
            if np.array_equal(one.stamps_ns, two.stamps_ns) and np.allclose(
                one.T_start_sensor, two.T_start_sensor, rtol=0.0, atol=1e-9
            ):
                raise OutlierError(
                    f"the tracks of {one.sensor} and {two.sensor} are the same, pose for pose: two sensors never "
                    "measure alike. Give each its own topic or file"
                )


def inverted_in_words(tracks: Sequence[OdometryTrack]) -> tuple[str, ...]:
    """A sentence for each track whose poses look inverted (T_sensor_start)."""
    said = []
    for track in tracks:
        ahead, other_way = _ahead(_velocities(track)), _ahead(_velocities(track, inverted=True))
        if other_way > ahead + MORE_AHEAD:
            said.append(
                f"the poses of {track.sensor} look inverted: read as T_sensor_start the sensor goes one way in its own "
                f"axes ({100 * other_way:.0f} % of its motion, and {100 * ahead:.0f} % as they are). Give "
                "T_start_sensor"
            )
    return tuple(said)


def _lasts(track: OdometryTrack) -> str:
    begin, end = 1e-9 * float(track.stamps_ns[0]), 1e-9 * float(track.stamps_ns[-1])
    return f"{track.sensor} ({begin:.3f} to {end:.3f} s)"


def _velocities(track: OdometryTrack, *, inverted: bool = False) -> Array:
    """(n, 6) turns (rad/s) and ways (own lengths a second) over about ``STEP_S``, in the sensor's own axes."""
    stamps, T = np.asarray(track.stamps_ns), np.asarray(track.T_start_sensor)
    every = max(1, min(round(STEP_S / (1e-9 * float(np.median(np.diff(stamps))))), (len(stamps) - 1) // 2))
    stamps, T = stamps[::every], T[::every]
    if inverted:
        T = se3.inverse(T)
    velocity: Array = se3.logmap(se3.inverse(T[:-1]) @ T[1:]) / (1e-9 * np.diff(stamps))[:, None]
    return velocity


def _ahead(velocity: Array) -> float:
    """How much all motion goes one way: the length (0 to 1) of the mean of its unit vectors."""
    way = velocity[:, 3:]
    size = np.linalg.norm(way, axis=1)
    mean = (way / np.maximum(size, 1e-12)[:, None]).mean(axis=0)
    return float(np.linalg.norm(mean))
