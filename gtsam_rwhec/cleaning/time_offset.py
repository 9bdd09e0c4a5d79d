"""The time offset between a sensor's clock and its carrier's, from turning alone, before anything is calibrated.

A_i X = Y B_i makes A_i^-1 A_j and B_i B_j^-1 rotations by the same angle, whatever X and Y are. The offset is the one
at which the angles of all intervals agree best. A grid search finds it first; it compares a quantile of the
differences, which wrong detections do not change. Gauss-Newton follows. Refinement can go on from there, with the
offset as a variable beside the poses (``RefineOptions.time_offsets``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.errors import StampError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.trajectories.trajectory import Trajectory

#: The two detections of an interval are this many seconds apart. The time is long enough for the angle to exceed a
#: detection's noise, and short enough for the motion not to repeat itself.
INTERVAL_S = 0.4
#: At most this many intervals are used; they are taken evenly from all.
MOST = 3000
#: Two neighbouring offsets of the grid search are this many seconds apart.
GRID_S = 0.01
#: Central differences of the angle with respect to the offset use this step (seconds).
STEP_S = 0.005
#: This quantile of the differences tells how well an offset fits. An interval has two detections: with 30 % wrong
#: detections, half of all intervals are wrong.
QUANTILE = 0.3
#: This is the same quantile of |x|, where x is normal with unit variance.
NORMAL_QUANTILE = 0.3853
#: A difference of angles beyond this many standard deviations comes from a wrong detection.
GROSS = 3.0


@dataclass(frozen=True)
class TimeOffset:
    """A sensor's stamp t is its carrier's t + offset_s.

    Attributes
    ----------
    offset_s, sigma_s : float
        The offset and its standard deviation, which comes from the scatter of the angles.
    intervals : int
        How many angles were compared.
    angle_rms_rad : float
        Root mean square of the differences of the angles, without gross ones.
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
    """The constant time offset at which carrier and sensor turn by the same angles.

    Parameters
    ----------
    carrier : Trajectory
        Poses of the carrier.
    tracks : sequence of (stamps_ns (M,), B (M, 4, 4))
        One for each target that the sensor saw, in order of time.
    search_s : float
        The search covers offsets from -search_s to search_s.
    max_gap_s : float
        Poses of the carrier are not interpolated over gaps longer than this.
    where : str
        The sensor, for messages.

    Raises
    ------
    StampError
        The motion does not determine the offset: too little turning, turning that repeats itself, or the best offset
        is at the end of the search.
    """
    start, end, angle = (np.concatenate(parts) for parts in zip(*(_intervals(*t) for t in tracks), strict=True))
    thinned = np.linspace(0, max(len(start) - 1, 0), min(MOST, len(start))).astype(int)
    start, end, angle = start[thinned], end[thinned], angle[thinned]
    if len(start) < 10:
        raise StampError(
            f"{where}: a target stayed in view for {len(start)} intervals of {INTERVAL_S:g} s; a time offset needs at "
            "least ten. Record longer, or state the offset"
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
            f"{end.max() * 1e-9:.3f} s, into {carrier.where}, from {first:.3f} to {last:.3f} s (gaps "
            f"up to {max_gap_s:g} s are interpolated); are they of another clock?"
        )
    best = int(np.argmin(costs))
    _check_grid(grid, costs, best, len(start), where, search_s)
    offset, sigma, rms, used = _refined(differences, float(grid[best]))
    if not sigma < 0.1 * search_s:
        raise StampError(
            f"{where}: the turning of carrier and sensor determines the time offset only to +-{sigma:.2g} s; turn "
            "faster and unevenly while recording, or state the offset"
        )
    return TimeOffset(offset, sigma, used, rms)


def _intervals(stamps_ns: np.ndarray, B: Array) -> tuple[np.ndarray, np.ndarray, Array]:
    """Stamps (start, end) and angle of each pair of detections that are about `INTERVAL_S` apart."""
    later = np.searchsorted(stamps_ns, stamps_ns + round(INTERVAL_S * 1e9))
    i = np.flatnonzero(later < len(stamps_ns))
    j = later[i]
    near = stamps_ns[j] - stamps_ns[i] < round(2.0 * INTERVAL_S * 1e9)
    i, j = i[near], j[near]
    turned = se3.so3_logmap(B[i, :3, :3] @ B[j, :3, :3].transpose(0, 2, 1))
    return stamps_ns[i], stamps_ns[j], np.linalg.norm(turned, axis=1)


def _check_grid(grid: Array, costs: Array, best: int, count: int, where: str, search_s: float) -> None:
    """Refuse a best offset at the end of the search, or one that another offset matches."""
    if best in (0, len(grid) - 1):
        raise StampError(
            f"{where}: turning agrees best at the end of the search, {grid[best]:+.2f} s. Widen the search (now "
            f"{search_s:g} s), or turn unevenly while recording"
        )
    far = np.abs(grid - grid[best]) > 2.0 * INTERVAL_S
    if far.any() and costs[far].min() < costs[best] * (1.0 + 3.0 / np.sqrt(count)):
        other = grid[far][int(np.argmin(costs[far]))]
        raise StampError(
            f"{where}: turning agrees as well at {other:+.2f} s as at {grid[best]:+.2f} s: the motion repeats "
            "itself or hardly turns. Turn unevenly while recording, or state the offset"
        )


def _refined(differences: Callable[[float], Array], offset: float) -> tuple[float, float, float, int]:
    """Refine the grid's best offset by Gauss-Newton: offset, standard deviation, rms of the angles, intervals used."""
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
