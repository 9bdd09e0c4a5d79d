"""A carrier's poses over time, and their interpolation on SE(3) (RWHEC paper, Section 9, step 3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from rwhec_factors import se3

from gtsam_rwhec.errors import CountError, PoseError, StampError
from gtsam_rwhec.geometry.poses import (
    Array,
    PosesLike,
    QuaternionOrder,
    as_transforms,
    checked_rows,
    rows_to_transforms,
)


@dataclass(frozen=True)
class Trajectory:
    """Poses T_a_b (N, 4, 4), metres, at strictly increasing stamps (N,), nanoseconds."""

    stamps_ns: np.ndarray
    T: Array
    where: str = "the trajectory"

    @staticmethod
    def of(
        stamps_ns: ArrayLike, poses: PosesLike, where: str = "the trajectory", order: QuaternionOrder | None = None
    ) -> Trajectory:
        """A trajectory from checked stamps (N,), strictly increasing, and poses; ``where`` is its topic or file.

        A PoseError names a pose that is not valid, a StampError stamps that are all zero, not increasing, not integers,
        or not as many as the poses.
        """
        transforms = as_transforms(poses, order, where)
        stamps = increasing_stamps(stamps_ns, len(transforms), where)
        if len(transforms) == 0:
            raise PoseError(f"{where}: there are no poses; give at least one")
        rows = checked_rows(transforms, 0, where).rows
        return Trajectory(stamps, rows_to_transforms(rows), where)

    @property
    def span_s(self) -> tuple[float, float]:
        """The first and the last stamp, seconds."""
        return float(self.stamps_ns[0]) * 1e-9, float(self.stamps_ns[-1]) * 1e-9

    def at(self, stamps_ns: np.ndarray) -> tuple[Array, Array]:
        """Poses (M, 4, 4) at stamps (M,), and the gap (M,) in seconds between the two poses that each is between.

        T_i Expmap(tau Log(T_i^-1 T_i+1)) interpolates (Barfoot, State Estimation for Robotics, Chapter 8). At the stamp
        of a pose the gap is 0. Outside the trajectory the gap is infinite, and the pose is the nearest one.
        """
        stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
        before, after, gap_s = self._around(stamps_ns)
        poses = self.T[after].copy()
        inside = (gap_s > 0.0) & np.isfinite(gap_s)
        first = self.T[before[inside]]
        share = (stamps_ns[inside] - self.stamps_ns[before[inside]]) * 1e-9 / gap_s[inside]
        step = se3.logmap(se3.inverse(first) @ self.T[after[inside]])
        poses[inside] = first @ se3.expmap(share[:, None] * step)
        return poses, gap_s

    def gaps(self, stamps_ns: np.ndarray) -> Array:
        """The gaps (M,) of ``at``, seconds, without the poses."""
        return self._around(stamps_ns)[2]

    def _around(self, stamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray, Array]:
        """The poses before and after each stamp, which are one where a stamp is met, and the gaps of ``at``."""
        after = np.clip(np.searchsorted(self.stamps_ns, stamps_ns), 0, len(self.T) - 1)
        before = np.where(self.stamps_ns[after] == stamps_ns, after, np.maximum(after - 1, 0))
        outside = (stamps_ns < self.stamps_ns[0]) | (stamps_ns > self.stamps_ns[-1])
        return before, after, np.where(outside, np.inf, (self.stamps_ns[after] - self.stamps_ns[before]) * 1e-9)

    def speeds(self, stamps_ns: np.ndarray, side_ns: int) -> tuple[Array, Array]:
        """Angular (rad/s) and linear (m/s) speeds (M,) at stamps, by differences over `side_ns` to both sides."""
        before, after = self.at(stamps_ns - side_ns)[0], self.at(stamps_ns + side_ns)[0]
        step, seconds = se3.inverse(before) @ after, 2e-9 * side_ns
        turning = np.linalg.norm(se3.so3_logmap(step[:, :3, :3]), axis=1)
        return turning / seconds, np.linalg.norm(step[:, :3, 3], axis=1) / seconds


def increasing_stamps(stamps_ns: ArrayLike, count: int, where: str) -> np.ndarray:
    """The stamps as (count,) strictly increasing integer nanoseconds; StampError for any others."""
    stamps = np.asarray(stamps_ns)
    if stamps.shape != (count,):
        raise StampError(f"{where}: stamps have shape {stamps.shape} for {count} poses; give one stamp for each pose")
    if count == 0:
        return stamps.astype(np.int64)
    if not np.issubdtype(stamps.dtype, np.integer):
        raise StampError(f"{where}: stamps are {stamps.dtype}; give integer nanoseconds")
    stamps = stamps.astype(np.int64)
    if count > 1 and not stamps.any():
        raise StampError(
            f"{where}: all {count} stamps are 0, so the driver does not fill header.stamp; use the log's own time"
        )
    step = np.diff(stamps)
    if (step <= 0).any():
        i = int(np.flatnonzero(step <= 0)[0])
        word = "repeats" if step[i] == 0 else "is before"
        raise StampError(
            f"{where}: stamp {i + 1} ({stamps[i + 1]} ns) {word} the stamp ahead of it ({stamps[i]} ns); sort "
            "the messages by header.stamp and leave repeated messages out"
        )
    return stamps


#: The longest half window, s.
LONGEST_S = 0.4
#: The shortest half window holds about this many poses on each side.
FEWEST_A_SIDE = 3.5
#: A window is too long if its poses scatter by this factor (of standard deviations) more than in the shortest window.
LACK_OF_FIT = 1.05
#: Knots are this part of the half window apart.
KNOT_STEP = 0.25
#: This many knots are used to test whether a window is too long.
TRIAL_KNOTS = 200
#: At most this many poses in a window are used; they are taken evenly.
MOST_IN_WINDOW = 400


@dataclass(frozen=True)
class SmoothPath:
    """A smooth path T_a_b over time: at each knot a cubic in the tangent space of a pose."""

    knots_ns: np.ndarray  #: (K,)
    T: Array  #: (K, 4, 4): the poses that the tangent spaces belong to, metres
    coefficients: Array  #: (K, 4, 6): c_0 (rad, m), c_1 (rad/s, m/s), c_2, c_3
    velocity_variance: Array  #: (K, 6): of c_1, from the poses' scatter
    scatter: Array  #: (6,): variance of a logged pose about the path, rad^2 and m^2
    degrees_of_freedom: float  #: of the scatter

    @staticmethod
    def of(path: Trajectory, longest_s: float = LONGEST_S) -> SmoothPath:
        """The smooth path of logged poses; the window is as long as it can be without a lack of fit.

        A StampError says that the path has fewer than eight poses.
        """
        if len(path.T) < 8:
            raise StampError(
                f"{path.where}: {len(path.T)} poses are too few for a velocity, which needs eight; log poses faster"
            )
        period_s = float(np.median(np.diff(path.stamps_ns))) * 1e-9
        half_s = FEWEST_A_SIDE * period_s
        trial = _cubics_at_knots(path, half_s, TRIAL_KNOTS)
        # The scatter has a relative error of sqrt(2 / degrees of freedom); up to three times this is no lack of fit.
        most = LACK_OF_FIT**2 * (1.0 + 3.0 * np.sqrt(2.0 / trial.degrees_of_freedom)) * trial.scatter + 1e-24
        while half_s < longest_s:
            longer = min(1.6 * half_s, longest_s)
            if (_cubics_at_knots(path, longer, TRIAL_KNOTS).scatter > most).any():
                break
            half_s = longer
        return _cubics_at_knots(path, half_s)

    def at(self, stamps_ns: np.ndarray) -> tuple[Array, Array, Array]:
        """Poses (M, 4, 4), velocities (M, 6) in the moved frame's own axes, and velocities' variances (M, 6)."""
        nearest, d = self._nearest(stamps_ns)
        h = 1e-4
        before, here, after = (self._poses(nearest, x) for x in (d - h, d, d + h))
        velocity = se3.logmap(se3.inverse(before) @ after) / (2.0 * h)
        return here, velocity, self.velocity_variance[nearest]

    def poses(self, stamps_ns: np.ndarray) -> Array:
        """Poses (M, 4, 4) alone."""
        return self._poses(*self._nearest(stamps_ns))

    def _nearest(self, stamps_ns: np.ndarray) -> tuple[np.ndarray, Array]:
        """The knot nearest to each stamp, and the time from there, s."""
        stamps = np.asarray(stamps_ns, dtype=np.int64)
        nearest = np.searchsorted((self.knots_ns[1:] + self.knots_ns[:-1]) // 2, stamps)
        return nearest, (stamps - self.knots_ns[nearest]) * 1e-9

    def _poses(self, knot: np.ndarray, d: Array) -> Array:
        c, d = self.coefficients[knot], d[:, None]
        poses: Array = self.T[knot] @ se3.expmap(c[:, 0] + d * (c[:, 1] + d * (c[:, 2] + d * c[:, 3])))
        return poses


def _cubics_at_knots(path: Trajectory, half_s: float, most_knots: int | None = None) -> SmoothPath:
    """The cubics with one window length, at all knots, or at some of them."""
    stamps = path.stamps_ns
    # Knots are at logged stamps, about a quarter of the half window apart, and at both ends of each gap.
    cell = ((stamps - stamps[0]) // max(round(KNOT_STEP * half_s * 1e9), 1)).astype(np.int64)
    new = np.r_[True, np.diff(cell) > 0]
    new |= np.r_[new[1:] & (np.diff(cell) > 1), True]
    at = np.flatnonzero(new)
    if most_knots is not None and len(at) > most_knots:
        at = at[np.linspace(0, len(at) - 1, most_knots).astype(int)]
    window_ns = round(half_s * 1e9)
    low = np.searchsorted(stamps, stamps[at] - window_ns)
    high = np.searchsorted(stamps, stamps[at] + window_ns, side="right")
    low, high = np.minimum(low, np.maximum(at - 2, 0)), np.maximum(high, np.minimum(at + 3, len(stamps)))
    stride = np.maximum((high - low) // MOST_IN_WINDOW, 1)
    fit = _cubics(path, path.T[at], stamps[at], low, high, half_s, lambda count: np.arange(4) < count - 1, stride)
    free = max(fit.degrees_of_freedom, 1.0)
    scatter = fit.squares / free
    variance = fit.leverage[:, None] * scatter
    return SmoothPath(stamps[at], path.T[at], fit.coefficients, variance, scatter, free)


@dataclass(frozen=True)
class _Cubics:
    """Cubics c_0 + c_1 d + c_2 d^2 + c_3 d^3 about n poses, (n, 4, 6), and how well they fit."""

    coefficients: Array
    leverage: Array  #: (n,): variance of c_1 over that of a pose, 1/s^2
    squares: Array  #: (6,): what is left, summed
    degrees_of_freedom: float


def _cubics(
    path: Trajectory,
    poses: Array,
    stamps_ns: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    window_s: float,
    terms: Callable[[np.ndarray], np.ndarray],
    stride: np.ndarray | int = 1,
) -> _Cubics:
    """Cubics in the tangent spaces of poses (n, 4, 4), each fitted to ``path[low:high:stride]``.

    ``terms`` gives, for each number of poses (n, 1), which of the four terms are fitted.
    """
    stride = np.broadcast_to(stride, low.shape)
    width = int(((high - low - 1) // stride + 1).max())
    coefficients, leverage = np.zeros((len(poses), 4, 6)), np.zeros(len(poses))
    squares, degrees_of_freedom = np.zeros(6), 0
    block = max(1, POSES_AT_ONCE // width)
    for i in range(0, len(poses), block):
        own = slice(i, i + block)
        rows = low[own, None] + stride[own, None] * np.arange(width)
        near = rows < high[own, None]
        rows = np.minimum(rows, len(path.T) - 1)
        # Times are in units of the window: third powers of milliseconds would be too small.
        tau = (path.stamps_ns[rows] - stamps_ns[own, None]) * 1e-9 / window_s
        xi = se3.logmap((se3.inverse(poses[own])[:, None] @ path.T[rows]).reshape(-1, 4, 4)).reshape(*tau.shape, 6)
        used = terms(near.sum(axis=1)[:, None])
        # Columns and rows of zeros change nothing.
        Z = np.where(near[..., None] & used[:, None], tau[..., None] ** np.arange(4), 0.0)
        inverse = np.linalg.pinv(Z)
        solution = inverse @ xi
        coefficients[own] = solution / window_s ** np.arange(4)[:, None]
        leverage[own] = (inverse[:, 1] ** 2).sum(axis=1) / window_s**2
        squares += (np.where(near[..., None], xi - Z @ solution, 0.0) ** 2).sum(axis=(0, 1))
        degrees_of_freedom += int(near.sum() - used.sum())
    return _Cubics(coefficients, leverage, squares, float(degrees_of_freedom))


#: Poses within this time, s, of a stamp determine the motion there.
WINDOW_S = 0.5
#: This many poses about a stamp are taken from a path that was logged fast.
NEAREST = 32
#: This many poses are compared with their neighbours at once, so that memory stays bounded.
POSES_AT_ONCE = 200_000
#: The motion between two poses is unknown when more than this time, s, lies between them.
LONGEST_GAP_S = 1.0
#: Entries (rad and m) of two poses of one stamp and one carrier may differ by this much.
SAME_POSE = 1e-6
#: Where a larger share of the stamps has no velocity, no offset is estimated: these measurements would not follow it.
MOST_WITHOUT_VELOCITY = 0.5


@dataclass(frozen=True)
class LocalPaths:
    """The motion about each of N stamps.

    About a stamp beside a gap no velocity is known. It is zero there: the measurement counts without a term of its
    clock. Where poses are too few to scatter, ``velocity_variance`` comes from how well their neighbours predict them:
    between stations nothing is known of the path.
    """

    coefficients: Array  #: (N, 3, 6): c_1 (rad/s, m/s), c_2, c_3
    leverage: Array  #: (N,): variance of c_1 over the variance of a pose's noise, 1/s^2
    scatter: Array  #: (6,): variance of the poses about the cubics, rad^2 and m^2
    velocity_variance: Array  #: (6,): mean square error of c_1
    known: np.ndarray  #: (N,): whether the motion is known

    def motion(self, offset_s: float | Array) -> Array:
        """Expmap(c_1 d + c_2 d^2 + c_3 d^3), (N, 4, 4); d (one, or N) is limited to the window of the fit."""
        powers = np.clip(np.reshape(offset_s, (-1, 1)), -WINDOW_S, WINDOW_S) ** np.arange(1, 4)
        return se3.expmap((powers[:, :, None] * self.coefficients).sum(axis=1))

    def twists(self, offset_s: float | Array = 0.0) -> Array:
        """Velocities (N, 6) at the stamps plus an offset, [omega rad/s, v m/s], in the moved carrier's own axes."""
        if not np.any(offset_s):
            return self.coefficients[:, 0]
        h = 1e-4
        return se3.logmap(se3.inverse(self.motion(offset_s - h)) @ self.motion(offset_s + h)) / (2.0 * h)

    def selected(self, mask: np.ndarray) -> LocalPaths:
        """The motion about the stamps that a mask or an index array selects."""
        return LocalPaths(
            self.coefficients[mask], self.leverage[mask], self.scatter, self.velocity_variance, self.known[mask]
        )

    @staticmethod
    def of(A: Array, stamps_ns: np.ndarray, where: str) -> LocalPaths:
        """The motion about the stamps of measured poses A (N, 4, 4) in any order, fitted to the poses themselves.

        A CountError says that there are fewer than two stamps, two poses at one stamp, or that most poses have no
        neighbour within a second.
        """
        stamps, first, place = np.unique(stamps_ns, return_index=True, return_inverse=True)
        poses = A[first]
        off = np.abs(A - poses[place]).max(axis=(1, 2))
        if off.max() > SAME_POSE:
            raise CountError(
                f"{where}: two different carrier poses have the stamp {stamps_ns[int(off.argmax())]} ns; give one pose "
                "for each stamp, or estimate no time offset for the sensor"
            )
        if len(stamps) < 2:
            raise CountError(f"{where}: a time offset needs at least two stamps; there is {len(stamps)}")
        low, high = _neighbours((stamps - stamps[0]) * 1e-9)
        known = high - low >= 2
        if np.mean(~known) > MOST_WITHOUT_VELOCITY:
            raise CountError(
                f"{where}: the measurement at {stamps[np.argmin(high - low)]} ns and {int((~known).sum()) - 1} others "
                f"of {len(stamps)} have no other measurement within {LONGEST_GAP_S:g} s, so the carrier's velocity "
                "there is unknown. Leave them out, or estimate no time offset for their sensor"
            )
        found = _cubics_at_stamps(poses, stamps, Trajectory(stamps, poses, where), low, high, known, place)
        unknown = _unpredicted(poses, (stamps - stamps[0]) * 1e-9, found.leverage[first])
        return replace(found, velocity_variance=np.maximum(found.velocity_variance, unknown))

    @staticmethod
    def along(path: Trajectory, stamps_ns: np.ndarray) -> LocalPaths:
        """The motion about the stamps, fitted to a path that was logged faster than the measurements were made.

        A CountError says that the path has fewer than four poses within half a second of most stamps.
        """
        stamps, place = np.unique(stamps_ns, return_inverse=True)
        poses, _ = path.at(stamps)
        first = np.searchsorted(path.stamps_ns, stamps) - NEAREST // 2
        first = np.clip(first, 0, max(len(path.T) - NEAREST, 0))
        window_ns = round(WINDOW_S * 1e9)
        low = np.maximum(first, np.searchsorted(path.stamps_ns, stamps - window_ns))
        high = np.minimum(first + NEAREST, np.searchsorted(path.stamps_ns, stamps + window_ns, side="right"))
        known = high - low >= 4
        if np.mean(~known) > MOST_WITHOUT_VELOCITY:
            i = int(np.argmin(high - low))
            raise CountError(
                f"{path.where}: only {max(high[i] - low[i], 0)} poses are within {WINDOW_S:g} s of the measurement at "
                f"{stamps[i]} ns, and few of {int((~known).sum()) - 1} others of {len(stamps)}; a time offset needs at "
                "least four, for the carrier's velocity. Log the poses faster"
            )
        return _cubics_at_stamps(poses, stamps, path, low, high, known, place)


def _cubics_at_stamps(
    poses: Array,
    stamps_ns: np.ndarray,
    path: Trajectory,
    low: np.ndarray,
    high: np.ndarray,
    known: np.ndarray,
    place: np.ndarray,
) -> LocalPaths:
    """The cubics about ``poses`` at ``stamps_ns``, each fitted to ``path[low:high]``; ``place`` repeats them.

    Those that are not ``known`` are zero, and say nothing of the scatter.
    """
    # With enough poses the fit has a constant term, because the pose at the stamp is noisy too.
    fit = _cubics(
        path,
        poses,
        stamps_ns,
        low,
        np.where(known, high, low),
        WINDOW_S,
        lambda count: (np.arange(4) >= np.where(count > 2, 0, 1)) & (np.arange(4) < count),
    )
    scatter = fit.squares / max(fit.degrees_of_freedom, 1.0)
    leverage = fit.leverage[place]
    mean = fit.leverage[place][known[place]].mean()
    return LocalPaths(fit.coefficients[place, 1:], leverage, scatter, mean * scatter, known[place])


def _unpredicted(poses: Array, seconds: Array, leverage: Array) -> Array:
    """Mean square error of velocities (6,) from each pose's distance to the cubic through two neighbours a side.

    For a smooth path with noise, the distance is the noise and the small error of a cubic. If the carrier stopped
    between the stamps, or turned back, the distance is as large as the steps. Poses without two
    neighbours on each side, at an end or beside a gap, are left out.
    """
    beside = np.arange(2, len(seconds) - 2)[:, None] + np.array([-2, -1, 1, 2])
    beside = beside[np.diff(seconds[beside], axis=1).max(axis=1) <= LONGEST_GAP_S] if len(beside) else beside
    if not len(beside):
        return np.zeros(6)
    middle = beside[:, 1] + 1
    tau = seconds[beside] - seconds[middle, None]
    # Lagrange's weights at 0; the sum of their squares is the variance that noise in the neighbours adds.
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
    weights = np.prod(-tau[:, others] / (tau[:, :, None] - tau[:, others]), axis=2)
    steps = (se3.inverse(poses[middle])[:, None] @ poses[beside]).reshape(-1, 4, 4)
    off = np.einsum("nk,nki->ni", weights, se3.logmap(steps).reshape(-1, 4, 6))
    squares = off**2 / (1.0 + (weights**2).sum(axis=1))[:, None]
    result: Array = np.mean(leverage[middle, None] * squares, axis=0)
    return result


def _neighbours(seconds: Array) -> tuple[np.ndarray, np.ndarray]:
    """Each pose's neighbours as ``low:high``: half a second each way, at least two, not across a long gap."""
    index = np.arange(len(seconds))
    long_gap = np.diff(seconds) > LONGEST_GAP_S
    first = np.maximum.accumulate(np.where(np.r_[True, long_gap], index, 0))
    last = np.minimum.accumulate(np.where(np.r_[long_gap, True], index, len(seconds))[::-1])[::-1]
    low = np.searchsorted(seconds, seconds - WINDOW_S)
    high = np.searchsorted(seconds, seconds + WINDOW_S, side="right") - 1
    return np.maximum(first, np.minimum(low, index - 2)), np.minimum(last, np.maximum(high, index + 2)) + 1
