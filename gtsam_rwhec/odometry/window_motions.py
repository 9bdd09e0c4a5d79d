"""The motions of all sensors over common windows of time, and how their noise grows with the window."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.odometry_track import OdometryTrack
from gtsam_rwhec.geometry.poses import Array

#: Velocities are central differences over this time to each side (s), or over one step where a step is longer.
HALF_S = 0.1
#: Poses that are no further apart, m and 1, are the same.
STILL = 1e-9
#: Poses of one cubic: the two around the time, one before and one after them.
POINTS = 4


@dataclass(frozen=True)
class SampledTrack:
    """A track and the offset of its clock; times are in seconds from ``origin_ns`` on the reference's clock."""

    track: OdometryTrack
    origin_ns: int
    offset_s: float  #: A stamp t of the track is the reference's t + offset_s
    good: np.ndarray  #: (N - 1,) booleans: steps that may be used

    @cached_property
    def times(self) -> Array:
        """(N,) seconds on the reference's clock."""
        return (np.asarray(self.track.stamps_ns) - self.origin_ns) * 1e-9 + self.offset_s

    @cached_property
    def _sums(self) -> tuple[Array, Array, Array]:
        """Integrals of dt, p dt and p p' dt up to each pose. p is a step's end, relative to the track's mean."""
        p = self.track.T_start_sensor[:, :3, 3] - self.centre
        dt = np.r_[0.0, np.diff(self.times)]
        return self.times, np.cumsum(p * dt[:, None], axis=0), np.cumsum(_outer(p, p) * dt[:, None, None], axis=0)

    @cached_property
    def centre(self) -> Array:
        """The mean (3,) of the track's positions."""
        mean: Array = np.asarray(self.track.T_start_sensor)[:, :3, 3].mean(axis=0)
        return mean

    def poses(self, at: Array) -> Array:
        """T_start_sensor (M, 4, 4) at times (M,), by cubics through the four nearest poses in their tangent space."""
        times, T = self.times, np.asarray(self.track.T_start_sensor)
        i = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
        points = min(POINTS, len(times))
        first = np.clip(i - 1, 0, len(times) - points)
        from_here = se3.inverse(T[i])
        tangent = np.zeros((len(at), 6))
        for a in range(points):
            weight = np.ones(len(at))  # Lagrange's polynomial
            for b in range(points):
                if a != b:
                    weight *= (at - times[first + b]) / (times[first + a] - times[first + b])
            tangent += weight[:, None] * se3.logmap(from_here @ T[first + a])
        return T[i] @ se3.expmap(tangent)

    def covers(self, start: Array, end: Array, max_gap_s: float) -> np.ndarray:
        """Which windows (M,) are inside the track and contain no bad step and no gap."""
        times = self.times
        inside = (start >= times[0] - 1e-9) & (end <= times[-1] + 1e-9)
        a = np.clip(np.searchsorted(times, start + 1e-9, side="right") - 1, 0, len(times) - 1)
        b = np.clip(np.searchsorted(times, end - 1e-9, side="left"), 0, len(times) - 1)
        bad_before = np.r_[0, np.cumsum(~self.good | (np.diff(times) > max_gap_s))]  # steps that end there or earlier
        clean: np.ndarray = inside & (bad_before[b] == bad_before[a])
        return clean

    def velocities(self, at: Array) -> Array:
        """Body velocities (M, 6) at times (M,), [rad/s, m/s], by central differences."""
        half = max(HALF_S, float(np.median(np.diff(self.times))))
        before = np.clip(at - half, self.times[0], self.times[-1])
        after = np.clip(at + half, self.times[0], self.times[-1])
        motion = se3.logmap(se3.inverse(self.poses(before)) @ self.poses(after))
        velocity: Array = motion / np.maximum(after - before, 1e-9)[:, None]
        return velocity

    def path_sums(self, start: Array, end: Array, T_end: Array) -> tuple[Array, Array, Array]:
        """For each window: its length (M,) and the integrals (M, 3), (M, 3, 3) of p and p p' in the end's frame.

        p is a past position of the sensor. By the adjoint, a twist of the pose at p moves the pose at the end.
        """
        length, first, second = (_between(self.times, sums, start, end) for sums in self._sums)
        R, at_end = T_end[:, :3, :3], T_end[:, :3, 3] - self.centre
        # relative to p_end, then rotated into the end's frame
        across = _outer(first, at_end)
        second = second - across - np.swapaxes(across, 1, 2) + length[:, None, None] * _outer(at_end, at_end)
        first = first - length[:, None] * at_end
        turned = np.swapaxes(R, 1, 2)
        return length, np.einsum("nij,nj->ni", turned, first), turned @ second @ R


def _between(times: Array, sums: Array, start: Array, end: Array) -> Array:
    """The difference of cumulative sums (N, ...) between two times; interpolated linearly between poses."""
    flat = sums.reshape(len(times), -1)

    def at(when: Array) -> Array:
        i = np.clip(np.searchsorted(times, when, side="right") - 1, 0, len(times) - 2)
        share = ((when - times[i]) / (times[i + 1] - times[i]))[:, None]
        return flat[i] + share * (flat[i + 1] - flat[i])

    return (at(end) - at(start)).reshape(len(start), *sums.shape[1:])


def _outer(p: Array, q: Array) -> Array:
    return p[:, :, None] * q[:, None, :]


@dataclass(frozen=True)
class WindowMotions:
    """Motions of m sensors over n consecutive windows; the windows' errors are independent."""

    #: start, end: (n,) s
    start: Array
    end: Array
    M: Array  #: (m, n, 4, 4): T_before_after of each sensor, lengths as it measured them
    T_end: Array  #: (m, n, 4, 4): T_start_sensor at the windows' ends
    used: np.ndarray  #: (m, n) booleans: where a sensor has the window
    length: Array  #: (m, n) s
    #: first, second: (m, n, 3) and (m, n, 3, 3): Integrals of p dt and p p' dt along the way, p in the frame at the
    #: window's end
    first: Array
    second: Array
    by_offset: Array  #: (m, n, 6): derivative of M (right perturbation) by the sensor's time offset, per second

    @staticmethod
    def of(tracks: Sequence[SampledTrack], edges: Array, max_gap_s: float, *, clocks: bool = True) -> WindowMotions:
        """Between neighbouring times ``edges`` (n + 1,); windows with fewer than two sensors are left out.

        So are those in which nothing moves: a track that repeats its pose while it stands would seem to have no noise.
        Without ``clocks`` the derivatives with respect to the time offsets are zero.
        """
        start, end = edges[:-1], edges[1:]
        used = np.array([track.covers(start, end, max_gap_s) for track in tracks])
        kept = used.sum(axis=0) >= 2
        start, end, used = start[kept], end[kept], used[:, kept]
        parts = [_of_track(track, start, end, clocks=clocks) for track in tracks]
        M, T_end, length, first, second, by_offset = (np.array(part) for part in zip(*parts, strict=True))
        M[~used] = np.eye(4)
        every = WindowMotions(start, end, M, T_end, used, length, first, second, by_offset)
        moves = (np.abs(M - np.eye(4)) > STILL).any(axis=(0, 2, 3))
        return every.without(np.broadcast_to(~moves, used.shape))

    @property
    def sensors(self) -> int:
        """The number of sensors."""
        return len(self.M)

    def __len__(self) -> int:
        return len(self.start)

    def rotation_vectors(self) -> Array:
        """(m, n, 3) rotation vectors of the motions."""
        m, n = self.M.shape[:2]
        return se3.so3_logmap(self.M[:, :, :3, :3].reshape(m * n, 3, 3)).reshape(m, n, 3)

    def covariance_parts(self) -> tuple[Array, Array]:
        """Covariances (m, n, 6, 6) of M's right perturbation for a unit of rotation noise, and of translation noise.

        Each step's error e is carried to the window's end by Ad(T_end_step) = [R, 0; p^ R, R] (isotropic in e):
        so e_rotation gives [I, -p^; p^, -p^ p^] and e_translation [0, 0; 0, I], integrated over the window.
        """
        m, n = self.length.shape
        of_rotation, of_translation = np.zeros((m, n, 6, 6)), np.zeros((m, n, 6, 6))
        I3 = np.eye(3)
        by_length = self.length[:, :, None, None] * I3
        hats = se3.hat(self.first.reshape(-1, 3)).reshape(m, n, 3, 3)
        of_rotation[..., :3, :3] = by_length
        of_rotation[..., 3:, :3] = hats
        of_rotation[..., :3, 3:] = -hats
        # -p^ p^ = |p|^2 I - p p'
        of_rotation[..., 3:, 3:] = np.einsum("mnii->mn", self.second)[..., None, None] * I3 - self.second
        of_translation[..., 3:, 3:] = by_length
        return of_rotation, of_translation

    def without(self, left_out: np.ndarray) -> WindowMotions:
        """The same motions, without those of sensor and window (m, n) where ``left_out`` is true."""
        used = self.used & ~left_out
        kept = used.sum(axis=0) >= 2
        parts = (self.M, self.T_end, used, self.length, self.first, self.second, self.by_offset)
        return WindowMotions(self.start[kept], self.end[kept], *(part[:, kept] for part in parts))


def _of_track(track: SampledTrack, start: Array, end: Array, *, clocks: bool) -> tuple[Array, ...]:
    T_start, T_end = track.poses(start), track.poses(end)
    M = se3.inverse(T_start) @ T_end
    length, first, second = track.path_sums(start, end, T_end)
    if not clocks:
        return M, T_end, length, first, second, np.zeros((len(start), 6))
    at_start = np.einsum("nij,nj->ni", se3.adjoint(se3.inverse(M)), track.velocities(start))
    # The sensor's stamp t is the reference's t + offset: a larger offset reads the track earlier.
    return M, T_end, length, first, second, at_start - track.velocities(end)


def first_rotation_variances(windows: WindowMotions) -> Array:
    """First estimates (m,) of the rotation variances, rad^2/s.

    All sensors turn by the same angle, whatever their poses. So the variance of the difference of two sensors' angles
    is the sum of both variances. It is estimated by medians, which outliers hardly change.
    """
    angles = np.linalg.norm(windows.rotation_vectors(), axis=2)
    m = windows.sensors
    rows, right = [], []
    for j in range(m):
        for k in range(j + 1, m):
            both = windows.used[j] & windows.used[k]
            if both.sum() < 5:
                continue
            length = 0.5 * (windows.length[j] + windows.length[k])[both]
            rows.append(np.eye(m)[j] + np.eye(m)[k])
            right.append((np.median(np.abs(angles[j, both] - angles[k, both]) / np.sqrt(length)) / 0.6745) ** 2)
    if not rows:
        return np.full(m, 1e-6)
    mean = float(np.mean(right)) / 2.0
    # A weak pull towards the mean: two sensors determine only the sum.
    ridge = 1e-3 * np.eye(m)
    found = np.linalg.lstsq(np.vstack([rows, ridge]), np.r_[right, np.full(m, 1e-3 * mean)], rcond=None)[0]
    result: Array = np.maximum(found, max(0.05 * mean, 1e-16))
    return result


#: The window lengths to try, in steps of the slowest sensor.
LADDER = (1, 2, 3, 4, 5, 7, 10, 14, 20, 28, 40)
#: The longest window, seconds: a second of driving is one motion, a minute is not.
LONGEST_S = 5.0
#: Turns of more than this in 95 % of windows make rotation vectors a poor measure, rad.
LARGEST_TURN_RAD = 1.2
#: Longer windows may lose this share of the information along each axis.
LOSS = 0.01
#: An axis has information if its sum of squares is this many times that of noise alone.
CLEARLY = 4.0
#: The vehicle turned about an axis if its mean square turn is this many times the estimated noise variance.
PLAINLY = 10.0
#: Fewer windows than this are not enough to estimate their noise.
FEWEST = 20


def edges_of(tracks: Sequence[SampledTrack], every: int) -> Array:
    """Times (n + 1,) of every ``every``-th pose of the slowest track, while at least two tracks run."""
    slowest = max(tracks, key=lambda track: float(np.median(np.diff(track.times))))
    begin = sorted(track.times[0] for track in tracks)[1]
    end = sorted(track.times[-1] for track in tracks)[-2]
    times = slowest.times[(slowest.times >= begin - 1e-9) & (slowest.times <= end + 1e-9)]
    chosen: Array = times[::every]
    return chosen


def edges_near(tracks: Sequence[SampledTrack], seconds: float) -> Array:
    """Times (n + 1,) about ``seconds`` apart."""
    step = max(float(np.median(np.diff(track.times))) for track in tracks)
    return edges_of(tracks, max(1, round(seconds / step)))


def best_length(tracks: Sequence[SampledTrack], max_gap_s: float) -> float:
    """The window length, seconds, with the most information from the rotations."""
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
    # The longest of the lengths with nearly the most information: fewer windows, and turns well above the noise.
    enough = max(value for value, _ in found) - LOSS * 3.0 * len(tracks)
    return [seconds for value, seconds in found if value >= enough][-1]


def _information(windows: WindowMotions, variances: Array) -> tuple[float, float]:
    """The log information, summed over the axes that have any, and the windows' turn (rad, 95 % quantile)."""
    w = windows.rotation_vectors()
    value = 0.0
    for k in range(windows.sensors):
        used = windows.used[k]
        noise = variances[k] * windows.length[k, used]
        rows = w[k, used] / np.sqrt(noise)[:, None]
        N = 2.0 * float(used.sum())
        S = np.linalg.eigvalsh(float((rows**2).sum()) * np.eye(3) - rows.T @ rows)
        # A small excess over N is no information: it is chance, or an error of the roughly known noise.
        told = np.where(S > CLEARLY * N, S - N, 0.0)
        value += float(np.log1p(told**2 / (told + N + 1e-300)).sum())
    return value, float(np.quantile(np.linalg.norm(w[windows.used], axis=1), 0.95))


def axes_turned(windows: WindowMotions, motion: Array, variance: float) -> tuple[int, Array, Array]:
    """The number of axes (0 to 3) of fused turns above the noise, the mean squares (3,), and all axes (3, 3).

    ``variance`` is the fused rotation's variance about each axis, rad^2/s.
    """
    w = se3.so3_logmap(motion[:, :3, :3])
    square, axes = np.linalg.eigh(w.T @ w)
    order = np.argsort(-square)
    n = max(len(windows), 1)
    limit = PLAINLY * variance * float(np.median(windows.length)) * n
    return int((square > limit).sum()), square[order] / n, axes[:, order].T
