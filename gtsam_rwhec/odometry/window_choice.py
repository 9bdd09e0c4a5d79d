"""How long windows are: long enough for a turn to stand out of its noise, short enough to lose none.

What a window tells of a rotation or a lever arm grows with the square of its turn. With S the sum of |w|^2 I - w w'
over the noise of w, and N what noise alone would make of S, the information is S - N and the covariance of the best
estimate (S - N)^-1 S (S - N)^-1. Neighbouring frames have the largest N; long windows lose turns that go to and fro.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.noise_by_residuals import first_rotation_variances
from gtsam_rwhec.odometry.sampling import SampledTrack
from gtsam_rwhec.odometry.window_motions import WindowMotions

#: Lengths that are tried, in steps of the slowest sensor.
LADDER = (1, 2, 3, 4, 5, 7, 10, 14, 20, 28, 40)
#: The longest window, seconds: a second of driving is one motion, a minute is not.
LONGEST_S = 5.0
#: Turns of more than this in 95 % of windows make rotation vectors a poor measure, rad.
LARGEST_TURN_RAD = 1.2
#: This part of the information along each axis may be lost to longer windows.
LOSS = 0.01
#: An axis has information if what it shows is so many times what noise would.
CLEARLY = 4.0
#: A vehicle turned about an axis if the square of its turns is so many times that of their noise, as it was found.
PLAINLY = 10.0
#: Fewer windows than this say little about their own noise.
FEWEST = 20


def edges_of(tracks: Sequence[SampledTrack], every: int) -> Array:
    """Times (n + 1,) at each so-many-th pose of the slowest track, where at least two tracks are."""
    slowest = max(tracks, key=lambda track: float(np.median(np.diff(track.times))))
    begin = sorted(track.times[0] for track in tracks)[1]
    end = sorted(track.times[-1] for track in tracks)[-2]
    times = slowest.times[(slowest.times >= begin - 1e-9) & (slowest.times <= end + 1e-9)]
    chosen: Array = times[::every]
    return chosen


def edges_near(tracks: Sequence[SampledTrack], seconds: float) -> Array:
    """Times (n + 1,) about so many seconds apart."""
    step = max(float(np.median(np.diff(track.times))) for track in tracks)
    return edges_of(tracks, max(1, round(seconds / step)))


def best_length(tracks: Sequence[SampledTrack], max_gap_s: float) -> float:
    """The length, seconds, of the windows that have the most information of the turns."""
    step = max(float(np.median(np.diff(track.times))) for track in tracks)
    pilot = WindowMotions.of(tracks, edges_near(tracks, 5.0 * step), max_gap_s, clocks=False)
    variances = first_rotation_variances(pilot)
    found: list[tuple[float, float]] = []
    for every in LADDER:
        candidate = edges_of(tracks, every)
        if every > 1 and (every * step > LONGEST_S or len(candidate) <= FEWEST):
            break
        windows = WindowMotions.of(tracks, candidate, max_gap_s, clocks=False)
        if not len(windows):
            continue
        value, turn = _information(windows, variances)
        if every > 1 and turn > LARGEST_TURN_RAD:
            break
        found.append((value, every * step))
    if not found:
        return step
    # Of lengths that tell as much, the longest: fewer windows, with turns that stand out of the noise.
    enough = max(value for value, _ in found) - LOSS * 3.0 * len(tracks)
    return [seconds for value, seconds in found if value >= enough][-1]


def _information(windows: WindowMotions, variances: Array) -> tuple[float, float]:
    """The logarithm of the information along the axes in which there is any, and the turn of long windows."""
    w = windows.rotation_vectors()
    value = 0.0
    for k in range(windows.sensors):
        used = windows.used[k]
        noise = variances[k] * windows.length[k, used]
        rows = w[k, used] / np.sqrt(noise)[:, None]
        N = 2.0 * float(used.sum())
        S = np.linalg.eigvalsh(float((rows**2).sum()) * np.eye(3) - rows.T @ rows)
        # What is above N by chance, or as the noise is known roughly, tells nothing.
        told = np.where(S > CLEARLY * N, S - N, 0.0)
        value += float(np.log1p(told**2 / (told + N + 1e-300)).sum())
    return value, float(np.quantile(np.linalg.norm(w[windows.used], axis=1), 0.95))


def axes_turned(windows: WindowMotions, motion: Array, variance: float) -> tuple[int, Array, Array]:
    """About how many axes the fused motions turned beyond their noise (0 to 3), mean squares (3,), and the axes (3, 3).

    ``variance`` is that of the fused rotation about each axis, rad^2 a second.
    """
    w = se3.so3_logmap(motion[:, :3, :3])
    square, axes = np.linalg.eigh(w.T @ w)
    order = np.argsort(-square)
    n = max(len(windows), 1)
    limit = PLAINLY * variance * float(np.median(windows.length)) * n
    return int((square > limit).sum()), square[order] / n, axes[:, order].T
