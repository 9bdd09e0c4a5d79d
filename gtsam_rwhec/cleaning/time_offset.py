"""The time offset between a sensor's clock and its carrier's, from rotations, before anything is calibrated.

A search over offsets compares turns (`turning`), each likely offset is fitted to the rotations (`rotation_fit`), and
the best one is kept if no other one fits nearly as well. Refinement can go on from there, with the offset as a variable
beside the poses (``RefineOptions.time_offsets``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.cleaning.rotation_fit import BLOCKS, GROSS, RotationFit, RotationProblem
from gtsam_rwhec.cleaning.turning import INTERVAL_S, Turns
from gtsam_rwhec.errors import StampError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.trajectories.smooth_path import SmoothPath
from gtsam_rwhec.trajectories.trajectory import Trajectory

#: Two neighbouring offsets of the search are this many seconds apart.
GRID_S = 0.02
#: This many of the search's minima are fitted.
CANDIDATES = 4
#: At most this many detections are used; they are taken evenly from all.
MOST = 3000
#: A standard deviation above this, s, is no use: the offset is not determined.
LARGEST_SIGMA_S = 0.05
#: More of the carrier's turning rate than this may not be noise.
LARGEST_NOISE_SHARE = 0.7
#: Another offset fits as well unless the difference is this many of its standard deviations, over blocks of time.
CLEARLY = 3.0


@dataclass(frozen=True)
class TimeOffset:
    """A sensor's stamp t is its carrier's t + offset_s.

    Attributes
    ----------
    offset_s, sigma_s : float
        The offset and its standard deviation: offset_s +- 1.96 sigma_s holds the truth in 95 % of cases. It contains
        residuals that are correlated in time, and the noise of the carrier's poses.
    measurements : int
        Detections that agree with the offset.
    rms_rad : float
        Root mean square of their rotations' residuals about an axis.
    """

    offset_s: float
    sigma_s: float
    measurements: int
    rms_rad: float


def estimate_time_offset(
    carrier: Trajectory,
    tracks: Sequence[tuple[np.ndarray, Array]],
    *,
    search_s: float = 1.0,
    max_gap_s: float = 0.2,
    where: str = "the sensor",
) -> TimeOffset:
    """The constant time offset at which the carrier's and the sensor's rotations agree.

    Parameters
    ----------
    carrier : Trajectory
        Poses of the carrier.
    tracks : sequence of (stamps_ns (M,), B (M, 4, 4))
        One for each target that the sensor saw, in order of time; B = T_sensor_target, of any scale.
    search_s : float
        The search covers offsets from -search_s to search_s.
    max_gap_s : float
        Poses of the carrier are not interpolated over gaps longer than this.
    where : str
        The sensor, for messages.

    Raises
    ------
    StampError
        The stamps of a track do not increase, or the motion does not determine the offset: too little turning, turning
        that repeats itself, or the best offset is at the end of the search.
    """
    for k, (stamps, B) in enumerate(tracks):
        _check_track(np.asarray(stamps), B, f"{where}, track {k}")
    turns = Turns.of(tracks)
    if len(turns.turn) < 10:
        raise StampError(
            f"{where}: a target stayed in view for {len(turns.turn)} intervals of about {INTERVAL_S:g} s; a time "
            "offset needs at least ten. Record longer, or state the offset"
        )
    smooth = SmoothPath.of(carrier)
    count = round(search_s / GRID_S)
    grid = np.arange(-count, count + 1) * (search_s / count)
    found = [turns.compared(carrier, smooth, float(offset), max_gap_s) for offset in grid]
    costs = np.array([cost if known >= max(10, 0.5 * len(turns.turn)) else np.inf for cost, _, known in found])
    if not np.isfinite(costs).any():
        first, last = carrier.span_s
        raise StampError(
            f"{where}: no offset of up to {search_s:g} s brings half of its stamps, from "
            f"{turns.start_ns.min() * 1e-9:.3f} to {turns.end_ns.max() * 1e-9:.3f} s, into {carrier.where}, from "
            f"{first:.3f} to {last:.3f} s (gaps up to {max_gap_s:g} s are interpolated); are they of another clock?"
        )
    problem = RotationProblem.of(carrier, smooth, tracks, max_gap_s, MOST)
    fits = [problem.fit(float(grid[i]), found[i][1]) for i in _minima(costs)]
    fits = [
        fit for fit in fits if np.isfinite([fit.sigma_s, fit.rms_rad]).all() and np.isfinite(fit.squares).sum() >= 10
    ]
    if not fits:
        raise StampError(f"{where}: its rotations agree with the carrier's at no offset; is it the right carrier?")
    cut = (GROSS * min(fit.rms_rad for fit in fits)) ** 2 * 3.0
    fits.sort(key=lambda fit: float(np.nanmean(np.minimum(fit.squares, cut))))
    best = fits[0]
    _check(best, fits[1:], cut, where, search_s)
    return TimeOffset(best.offset_s, best.sigma_s, best.used, best.rms_rad)


def _check_track(stamps: np.ndarray, B: Array, where: str) -> None:
    if stamps.shape != (len(B),) or not np.issubdtype(stamps.dtype, np.integer):
        raise StampError(
            f"{where}: stamps have shape {stamps.shape} of {stamps.dtype} for {len(B)} poses; give integer nanoseconds"
        )
    back = np.flatnonzero(np.diff(stamps) < 0)
    if back.size:
        i = int(back[0]) + 1
        raise StampError(
            f"{where}: stamp {i} ({stamps[i]} ns) is before the stamp ahead of it ({stamps[i - 1]} ns); sort the "
            "detections by stamp, or give the parts before and after a clock was set back apart"
        )


def _minima(costs: Array) -> list[int]:
    """The lowest local minima of the search, best first."""
    padded = np.r_[np.inf, costs, np.inf]
    low = np.isfinite(costs) & (padded[1:-1] <= padded[:-2]) & (padded[1:-1] <= padded[2:])
    at = np.flatnonzero(low)
    return [int(i) for i in at[np.argsort(costs[at], kind="stable")][:CANDIDATES]]


def _check(best: RotationFit, others: list[RotationFit], cut: float, where: str, search_s: float) -> None:
    """Refuse an offset that the motion does not determine."""
    if best.noise_share > LARGEST_NOISE_SHARE:
        raise StampError(
            f"{where}: {100 * min(best.noise_share, 1.0):.0f} % of the carrier's squared turning rate is noise: it "
            "stood still or hardly turned, and rotations do not determine a time offset. Turn faster and unevenly "
            "while recording, or state the offset"
        )
    if not best.sigma_s < LARGEST_SIGMA_S:
        raise StampError(
            f"{where}: the turning of carrier and sensor determines the time offset only to +-{best.sigma_s:.2g} s; "
            "turn faster and unevenly while recording, or state the offset"
        )
    for other in others:
        if abs(other.offset_s - best.offset_s) < max(6.0 * best.sigma_s, 0.5 * GRID_S):
            continue
        gain = np.minimum(other.squares, cut) - np.minimum(best.squares, cut)
        both = np.isfinite(gain)
        by_block = np.bincount(best.block[both], gain[both], BLOCKS)
        if by_block.sum() < CLEARLY * np.sqrt(BLOCKS) * by_block.std(ddof=1):
            raise StampError(
                f"{where}: turning agrees as well at {other.offset_s:+.3f} s as at {best.offset_s:+.3f} s: the motion "
                "repeats itself or hardly turns. Turn unevenly while recording, or state the offset"
            )
    if abs(best.offset_s) > search_s - GRID_S:
        raise StampError(
            f"{where}: turning agrees best at the end of the search, {best.offset_s:+.2f} s. Widen the search (now "
            f"{search_s:g} s), or turn unevenly while recording"
        )
