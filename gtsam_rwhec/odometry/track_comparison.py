"""Checks of tracks before solving: whether they can be of one drive, and a first guess of their time offsets.

All sensors of a vehicle turn by the same angles, wherever they are mounted, and a vehicle mostly moves in one
direction of its own axes: ahead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import OptionError, OutlierError, StampError
from gtsam_rwhec.geometry.odometry_track import OdometryNoise as OdometryNoise
from gtsam_rwhec.geometry.odometry_track import OdometryTrack as OdometryTrack
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.time_offset import estimate_time_offset
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.runs.odometry_cleaning import Gates


@dataclass(frozen=True)
class OdometryOptions:
    """How odometries are calibrated."""

    #: Length of the windows over which motions are compared, seconds. None: the length with the most information
    window_s: float | None = None
    #: Whether each sensor's clock is compared with the reference's. False only where all share one clock
    estimate_time_offsets: bool = True
    search_s: float = 1.0  #: Time offsets are searched from -search_s to search_s
    #: A step faster than this is an error of tracking (DQ paper, Appendix D.1, whose limit of 0.1 m a frame
    #: depends on the frame rate). The default is above road speeds
    max_speed_m_per_s: float = 70.0
    #: A step that turns faster than this is an error of tracking. The paper's 11.5 degrees a frame at 30 frames a
    #: second
    max_turn_rad_per_s: float = float(np.radians(11.5 * 30.0))
    max_gap_s: float = 0.5  #: Poses of a track are not interpolated over gaps longer than this
    reject_outliers: bool = True  #: Whether windows are left out in which a sensor contradicts the others

    @property
    def gates(self) -> Gates:
        """The limits beyond which parts of a track are not used."""
        return Gates(self.max_speed_m_per_s, self.max_turn_rad_per_s, self.reject_outliers)

    def __post_init__(self) -> None:
        for name in ("window_s", "search_s", "max_speed_m_per_s", "max_turn_rad_per_s", "max_gap_s"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0.0):
                raise OptionError(f"OdometryOptions: {name} is {value!r}; give a positive number")


#: Motions over about this time are compared (s).
STEP_S = 1.0
#: A track stands still if its root mean square turn rate is below this share of the others'.
TURNS_LESS = 0.2
#: If the others turn more slowly than this (rad/s), their turns may be noise and are not compared.
LEAST_TURN = float(np.radians(1.0))
#: The fewest poses that a track must have during another track.
FEWEST_SHARED = 3
#: Poses are reported as inverted if their inverses raise the share of motion in one direction by more than this.
MORE_AHEAD = 0.5


def check_common_time(tracks: Sequence[OdometryTrack], search_s: float) -> None:
    """Raise `StampError` where a track shares too little time with the first, even if clocks differ by ``search_s``."""
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
    """Raise `OutlierError` where two tracks are equal: then they are not from two sensors."""
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
    """Velocities (n, 6) over about ``STEP_S`` in the sensor's axes: rad/s, and the track's length unit per second."""
    stamps, T = np.asarray(track.stamps_ns), np.asarray(track.T_start_sensor)
    every = max(1, min(round(STEP_S / (1e-9 * float(np.median(np.diff(stamps))))), (len(stamps) - 1) // 2))
    stamps, T = stamps[::every], T[::every]
    if inverted:
        T = se3.inverse(T)
    return se3.logmap(se3.inverse(T[:-1]) @ T[1:]) / (1e-9 * np.diff(stamps))[:, None]


def _ahead(velocity: Array) -> float:
    """The share of motion in one direction: the length (0 to 1) of the mean of the motions' unit vectors."""
    way = velocity[:, 3:]
    size = np.linalg.norm(way, axis=1)
    mean = (way / np.maximum(size, 1e-12)[:, None]).mean(axis=0)
    return float(np.linalg.norm(mean))


#: The search uses at most this time (s), from the middle of the time that both tracks share.
MOST_S = 180.0
#: About this many poses are enough for a first guess; if they fail, all are used.
ENOUGH = 400
#: A track is compared in pieces of this length (s): over a longer time, its drift would look like a rotation.
PIECE_S = 10.0
#: The fewest poses of a piece.
FEWEST_POSES = 5


@dataclass(frozen=True)
class Clock:
    """A sensor's stamp t is the reference's t + offset_s; ``unknown`` explains why no offset was found."""

    offset_s: float
    unknown: str = ""


def first_offset(reference: OdometryTrack, track: OdometryTrack, options: OdometryOptions) -> Clock:
    """Find the offset by both tracks' rotations: the sensor's start is a static target, the reference's the world."""
    first = max(reference.stamps_ns[0], track.stamps_ns[0])
    last = min(reference.stamps_ns[-1], track.stamps_ns[-1])
    middle, half = (int(first) + int(last)) // 2, round(0.5e9 * MOST_S)
    part = np.abs(np.asarray(track.stamps_ns) - middle) <= half
    near = np.abs(np.asarray(reference.stamps_ns) - middle) <= half + round(2e9 * options.search_s)
    carrier = Trajectory.of(
        np.asarray(reference.stamps_ns)[near],
        se3.inverse(np.asarray(reference.T_start_sensor)[near]),
        where=f"the track of {reference.sensor}",
    )
    stamps, T = np.asarray(track.stamps_ns)[part], se3.inverse(np.asarray(track.T_start_sensor)[part])
    if not _pieces(stamps, T, options.max_gap_s):
        return Clock(0.0, f"no piece of its track has {FEWEST_POSES} poses without a gap")
    unknown = ""
    few = max(1, len(stamps) // ENOUGH)
    for every in dict.fromkeys((few, 1)):
        pieces = _pieces(stamps[::every], T[::every], options.max_gap_s)
        if not pieces:
            continue
        try:
            found = estimate_time_offset(
                carrier, pieces, search_s=options.search_s, max_gap_s=options.max_gap_s, where=track.sensor
            )
        except StampError as error:
            unknown = str(error)
        else:
            return Clock(found.offset_s)
    return Clock(0.0, unknown)


def _pieces(stamps_ns: np.ndarray, T: Array, max_gap_s: float) -> list[tuple[np.ndarray, Array]]:
    """The track in pieces without gaps; each piece has its own target, so that drift within a piece is small."""
    step = float(np.median(np.diff(stamps_ns)))
    gap = np.r_[False, np.diff(stamps_ns) > max(1e9 * max_gap_s, 1.5 * step)]
    piece = np.cumsum(gap | np.r_[False, np.diff((stamps_ns - stamps_ns[0]) // round(1e9 * PIECE_S)) > 0])
    cuts = np.flatnonzero(np.diff(piece)) + 1
    return [
        pair for pair in zip(np.split(stamps_ns, cuts), np.split(T, cuts), strict=True) if len(pair[0]) >= FEWEST_POSES
    ]
