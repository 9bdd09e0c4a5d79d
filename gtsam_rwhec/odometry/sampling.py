"""One track at any time: interpolated poses, body velocities, and the sums that the noise of its windows needs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.odometry.tracks import OdometryTrack

#: Velocities are differences over so many seconds to each side, or a step if that is longer.
HALF_S = 0.1
#: A cubic has so many poses: one before, two around and one after.
POINTS = 4


@dataclass(frozen=True)
class SampledTrack:
    """A track with its clock's offset, times in seconds from ``origin_ns`` on the reference's clock.

    Attributes
    ----------
    track : OdometryTrack
    origin_ns : int
    offset_s : float
        A stamp t of the track is the reference's t + offset_s.
    good : (N - 1,) booleans
        Steps that may be used.
    """

    track: OdometryTrack
    origin_ns: int
    offset_s: float
    good: np.ndarray

    @cached_property
    def times(self) -> Array:
        """(N,) seconds on the reference's clock."""
        stamps: Array = (np.asarray(self.track.stamps_ns) - self.origin_ns) * 1e-9 + self.offset_s
        return stamps

    @cached_property
    def _bad_before(self) -> np.ndarray:
        """How many steps that may not be used end at or before each pose, (N,)."""
        counts: np.ndarray = np.r_[0, np.cumsum(~self.good)]
        return counts

    @cached_property
    def _sums(self) -> tuple[Array, Array, Array]:
        """Integrals to each pose of dt, p dt and p p' dt over the ends p of the steps, about the track's mean."""
        p = self.track.T_start_sensor[:, :3, 3] - self.centre
        dt = np.r_[0.0, np.diff(self.times)]
        return self.times, np.cumsum(p * dt[:, None], axis=0), np.cumsum(_outer(p) * dt[:, None, None], axis=0)

    @cached_property
    def centre(self) -> Array:
        """The mean (3,) of the track's positions."""
        mean: Array = np.asarray(self.track.T_start_sensor)[:, :3, 3].mean(axis=0)
        return mean

    def poses(self, at: Array) -> Array:
        """T_start_sensor (M, 4, 4) at times (M,), by cubics through the four nearest poses in their tangent space."""
        times, T = self.times, np.asarray(self.track.T_start_sensor)
        i = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
        if len(times) < POINTS:
            share = ((at - times[i]) / (times[i + 1] - times[i]))[:, None]
            return T[i] @ se3.expmap(share * se3.logmap(se3.inverse(T[i]) @ T[i + 1]))
        first = np.clip(i - 1, 0, len(times) - POINTS)
        weights = np.ones((len(at), POINTS))
        for a in range(POINTS):  # Lagrange's polynomials
            for b in range(POINTS):
                if a != b:
                    weights[:, a] *= (at - times[first + b]) / (times[first + a] - times[first + b])
        from_here = se3.inverse(T[i])
        tangent = np.zeros((len(at), 6))
        for a in range(POINTS):
            tangent += weights[:, a, None] * se3.logmap(from_here @ T[first + a])
        poses: Array = T[i] @ se3.expmap(tangent)
        return poses

    def covers(self, start: Array, end: Array, max_gap_s: float) -> np.ndarray:
        """Which windows (M,) are inside the track and have no bad step and no gap."""
        times = self.times
        inside = (start >= times[0] - 1e-9) & (end <= times[-1] + 1e-9)
        a = np.clip(np.searchsorted(times, start + 1e-9, side="right") - 1, 0, len(times) - 1)
        b = np.clip(np.searchsorted(times, end - 1e-9, side="left"), 0, len(times) - 1)
        gaps = np.r_[0, np.cumsum(np.diff(times) > max_gap_s)]
        clean: np.ndarray = inside & (self._bad_before[b] == self._bad_before[a]) & (gaps[b] == gaps[a])
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
        """Over each window: its length (M,), and the integrals (M, 3), (M, 3, 3) of p and p p' in the end's frame.

        p is where the sensor was, so that a twist of its pose there moves its pose at the end by the adjoint.
        """
        length, first, second = (_between(self.times, sums, start, end) for sums in self._sums)
        R, at_end = T_end[:, :3, :3], T_end[:, :3, 3] - self.centre
        # of p - p_end, then turned into the end's frame
        second = second - _outer_sum(first, at_end) + length[:, None, None] * _outer(at_end)
        first = first - length[:, None] * at_end
        turned = np.swapaxes(R, 1, 2)
        return length, np.einsum("nij,nj->ni", turned, first), turned @ second @ R


def _between(times: Array, sums: Array, start: Array, end: Array) -> Array:
    """The difference of cumulative sums (N, ...) at two times, linear between poses."""
    flat = sums.reshape(len(times), -1)

    def at(when: Array) -> Array:
        i = np.clip(np.searchsorted(times, when, side="right") - 1, 0, len(times) - 2)
        share = ((when - times[i]) / (times[i + 1] - times[i]))[:, None]
        value: Array = flat[i] + share * (flat[i + 1] - flat[i])
        return value

    difference: Array = (at(end) - at(start)).reshape(len(start), *sums.shape[1:])
    return difference


def _outer(p: Array) -> Array:
    product: Array = p[:, :, None] * p[:, None, :]
    return product


def _outer_sum(p: Array, q: Array) -> Array:
    product: Array = p[:, :, None] * q[:, None, :] + q[:, :, None] * p[:, None, :]
    return product
