"""A sensor's clock against its carrier's, before anything is calibrated: turning has no frame.

A_i X = Y B_i makes A_i^-1 A_j and B_i B_j^-1 rotations by one angle, whatever X and Y are. The offset that makes the
angles agree best over all intervals is found on a grid (by a quantile of the differences that wrong detections do not
move), then by Gauss-Newton. Refinement takes it from there, with poses, as a variable (``RefineOptions.time_offsets``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import StampError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.trajectories.trajectory import Trajectory

#: Angles are compared over about this time: long against a frame's noise, short against what the motion does.
INTERVAL_S = 0.4
#: Intervals that are used, at most, evenly from all of them.
MOST = 3000
GRID_S = 0.01
#: For derivatives of the angle by the offset.
STEP_S = 0.005
#: This quantile of the differences tells how well an offset fits. An interval has two detections, so that 30 % wrong
#: ones spoil half of all intervals.
QUANTILE = 0.3
#: The same quantile of |x| for a normal x of unit variance.
NORMAL_QUANTILE = 0.3853
#: Beyond this many standard deviations a difference of angles is a wrong detection's.
GROSS = 3.0


@dataclass(frozen=True)
class TimeOffset:
    """A sensor's stamp t is its carrier's t + offset_s.

    Attributes
    ----------
    offset_s, sigma_s : float
        And its standard deviation, from the scatter of the angles.
    intervals : int
        How many angles were compared.
    angle_rms_rad : float
        Of what is left of their differences, gross ones left out.
    """

    offset_s: float
    sigma_s: float
    intervals: int
    angle_rms_rad: float


def coarse_time_offset(
    carrier: Trajectory,
    tracks: Sequence[tuple[np.ndarray, Array]],
    *,
    search_s: float = 1.0,
    max_gap_s: float = 0.2,
    where: str = "the sensor",
) -> TimeOffset:
    """Estimate a constant offset from the turning of carrier and sensor.

    Parameters
    ----------
    carrier : Trajectory
    tracks : sequence of (stamps_ns (M,), B (M, 4, 4))
        Of each target that the sensor saw, in order of time.
    search_s : float
        Offsets up to this are looked for.
    max_gap_s : float
        The carrier's poses are not interpolated over more.
    where : str
        For messages.

    Raises
    ------
    StampError
        When the motion does not tell: too little turning, a turning that repeats itself, or an offset at the search's
        end.
    """
    start, end, angle = (np.concatenate(parts) for parts in zip(*(_intervals(*t) for t in tracks), strict=True))
    thinned = np.linspace(0, max(len(start) - 1, 0), min(MOST, len(start))).astype(int)
    start, end, angle = start[thinned], end[thinned], angle[thinned]
    if len(start) < 10:
        raise StampError(
            f"{where}: {len(start)} intervals of {INTERVAL_S:g} s in which a target stayed in view; a time offset "
            "needs ten and more. Record longer, or set it to what is known"
        )

    def differences(offset_s: float) -> Array:
        shift = round(offset_s * 1e9)
        first, gap_first = carrier.at(start + shift)
        second, gap_second = carrier.at(end + shift)
        turned = se3.so3_logmap(first[:, :3, :3].transpose(0, 2, 1) @ second[:, :3, :3])
        result: Array = angle - np.linalg.norm(turned, axis=1)
        result[(gap_first > max_gap_s) | (gap_second > max_gap_s)] = np.nan
        return result

    grid = np.arange(-round(search_s / GRID_S), round(search_s / GRID_S) + 1) * GRID_S
    costs = np.full(len(grid), np.inf)
    for i, offset in enumerate(grid):
        at = np.abs(differences(float(offset)))
        known = np.isfinite(at)
        if known.sum() >= max(10, 0.5 * len(at)):
            costs[i] = np.quantile(at[known], QUANTILE)
    if not np.isfinite(costs).any():
        first, last = carrier.span_s
        raise StampError(
            f"{where}: no offset of up to {search_s:g} s brings half of its stamps, from {start.min() * 1e-9:.3f} to "
            f"{end.max() * 1e-9:.3f} s, into {carrier.where}, from {first:.3f} to {last:.3f} s (gaps of up to "
            f"{max_gap_s:g} s bridged); are they of another clock?"
        )
    best = int(np.argmin(costs))
    _check_grid(grid, costs, best, len(start), where, search_s)
    offset, sigma, rms, used = _refined(differences, float(grid[best]))
    if not sigma < 0.1 * search_s:
        raise StampError(
            f"{where}: the turning of carrier and sensor tells the time offset to +-{sigma:.2g} s only; turn faster "
            "and unevenly while recording, or set the offset to what is known"
        )
    return TimeOffset(offset, sigma, used, rms)


def _intervals(stamps_ns: np.ndarray, B: Array) -> tuple[np.ndarray, np.ndarray, Array]:
    """Start, end (stamps) and angle of each pair of frames that are about an interval apart."""
    later = np.searchsorted(stamps_ns, stamps_ns + round(INTERVAL_S * 1e9))
    i = np.flatnonzero(later < len(stamps_ns))
    j = later[i]
    near = stamps_ns[j] - stamps_ns[i] < round(2.0 * INTERVAL_S * 1e9)
    i, j = i[near], j[near]
    turned = se3.so3_logmap(B[i, :3, :3] @ B[j, :3, :3].transpose(0, 2, 1))
    return stamps_ns[i], stamps_ns[j], np.linalg.norm(turned, axis=1)


def _check_grid(grid: Array, costs: Array, best: int, count: int, where: str, search_s: float) -> None:
    if best in (0, len(grid) - 1):
        raise StampError(
            f"{where}: turning agrees best at the search's end, {grid[best]:+.2f} s; widen the search (now "
            f"{search_s:g} s), or the motion does not tell the offset"
        )
    far = np.abs(grid - grid[best]) > 2.0 * INTERVAL_S
    if far.any() and costs[far].min() < costs[best] * (1.0 + 3.0 / np.sqrt(count)):
        other = grid[far][int(np.argmin(costs[far]))]
        raise StampError(
            f"{where}: turning agrees as well at {other:+.2f} s as at {grid[best]:+.2f} s: the motion repeats "
            "itself or hardly turns. Turn unevenly while recording, or set the offset to what is known"
        )


def _refined(differences: Callable[[float], Array], offset: float) -> tuple[float, float, float, int]:
    """Gauss-Newton from the grid's best: offset, its standard deviation, the angles' scatter, intervals used."""
    sigma = rms = np.inf
    used = 0
    for _ in range(20):
        d = differences(offset)
        slope = (differences(offset + STEP_S) - differences(offset - STEP_S)) / (2.0 * STEP_S)
        known = np.isfinite(d) & np.isfinite(slope)
        scatter = float(np.quantile(np.abs(d[known]), QUANTILE)) / NORMAL_QUANTILE
        good = known & (np.abs(d) <= GROSS * max(scatter, 1e-9))
        information = float(np.sum(slope[good] ** 2))
        used = int(good.sum())
        rms = float(np.sqrt(np.mean(d[good] ** 2)))
        if not information > 0.0:
            break
        step = -float(np.sum(slope[good] * d[good])) / information
        step = float(np.clip(step, -5.0 * GRID_S, 5.0 * GRID_S))
        offset += step
        sigma = rms / np.sqrt(information)
        if abs(step) < 1e-7:
            break
    return offset, float(sigma), rms, used
