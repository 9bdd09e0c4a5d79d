"""The first guess of each sensor's time offset to the reference, from their turning."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import StampError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.time_offset import estimate_time_offset
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.odometry.options import OdometryOptions
from gtsam_rwhec.odometry.tracks import OdometryTrack

#: The search takes so many seconds of two tracks, from the middle of what they share, at most.
MOST_S = 180.0
#: About so many of its poses are enough for a first guess; all are taken where these do not tell.
ENOUGH = 400
#: A track is compared in pieces of so many seconds: in one piece, what it drifts would look like a turn.
PIECE_S = 10.0
#: A piece has at least so many poses.
FEWEST_POSES = 5


@dataclass(frozen=True)
class Clock:
    """A sensor's stamp t is the reference's t + offset_s; ``unknown`` says in words why it was not found."""

    offset_s: float
    unknown: str = ""


def first_offset(reference: OdometryTrack, track: OdometryTrack, options: OdometryOptions) -> Clock:
    """By `cleaning.time_offset`: the sensor's start is a target that stands still, the reference's is the world."""
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
    for every in {few: None, 1: None}:
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
    """The track in pieces without gaps: each is a target of its own, so that what it drifts is small."""
    step = float(np.median(np.diff(stamps_ns)))
    gap = np.r_[False, np.diff(stamps_ns) > max(1e9 * max_gap_s, 1.5 * step)]
    piece = np.cumsum(gap | np.r_[False, np.diff((stamps_ns - stamps_ns[0]) // round(1e9 * PIECE_S)) > 0])
    cuts = np.flatnonzero(np.diff(piece)) + 1
    return [
        pair for pair in zip(np.split(stamps_ns, cuts), np.split(T, cuts), strict=True) if len(pair[0]) >= FEWEST_POSES
    ]
