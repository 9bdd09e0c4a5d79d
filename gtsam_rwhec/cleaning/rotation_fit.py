"""A time offset from a sensor's rotations: R_Y' R_A(t + offset) R_X = R_B, with R_Y and each target's R_X free.

Gauss-Newton with weights for noise that is correlated in time, and wrong detections left out. Translations and scales
play no part. The standard deviation is the larger one of two: of the noise model, and of the scatter between blocks of
time (Liang and Zeger 1986), which holds where the model is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3
from scipy.ndimage import median_filter
from scipy.special import stdtrit

from gtsam_rwhec.cleaning.correlated_noise import CorrelatedNoise, likeliest
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.trajectories.smooth_path import SmoothPath
from gtsam_rwhec.trajectories.trajectory import Trajectory

#: A detection whose rotation is off by more than this many standard deviations is wrong.
GROSS = 4.5
#: With this share of fading noise, residuals drift: a gross error differs from this many neighbours' median.
DRIFTS, NEIGHBOURS = 0.8, 9
#: Blocks of time, with equal shares of the information.
BLOCKS = 16
#: Steps of Gauss-Newton, and of the robust start.
STEPS, START_STEPS = 25, 12
#: A step is at most this long, s.
LONGEST_STEP_S = 0.05
#: Median of chi-square with three degrees of freedom.
MEDIAN = 2.366


@dataclass(frozen=True)
class RotationFit:
    """The fit at its optimum.

    Attributes
    ----------
    offset_s, sigma_s : float
        The offset and its standard deviation: 1.96 of them hold 95 %.
    noise_share : float
        The part of the carrier's squared turning rate that is noise.
    rms_rad : float
        Root mean square of the rotations' residuals about an axis.
    used : int
        Detections that agree.
    squares : (N,) array
        Squared residuals of all detections, rad^2; NaN where the carrier's pose is not known.
    block : (N,) integers
        The block of each detection.
    noise : CorrelatedNoise
        Correlation of the residuals in time.
    """

    offset_s: float
    sigma_s: float
    noise_share: float
    rms_rad: float
    used: int
    squares: Array
    block: np.ndarray
    noise: CorrelatedNoise


@dataclass(frozen=True)
class _At:
    """Residuals and derivatives at one estimate, in the target's or in the sensor's axes."""

    r: Array  # (N, 3)
    J: Array  # (N, 3, 1 + 3 + 3 tracks): by the offset, R_Y, each R_X
    rate_variance: Array  # (N,) of the carrier's turning rate, all axes
    known: np.ndarray  # (N,)


@dataclass(frozen=True)
class RotationProblem:
    """All detections of a sensor, track after track, each in the order of time."""

    carrier: Trajectory
    smooth: SmoothPath
    stamps_ns: np.ndarray
    R_B: Array
    track: np.ndarray
    max_gap_s: float

    @staticmethod
    def of(
        carrier: Trajectory, smooth: SmoothPath, tracks: Sequence[tuple[np.ndarray, Array]], max_gap_s: float, most: int
    ) -> RotationProblem:
        """The problem with at most ``most`` detections, taken evenly."""
        total = sum(len(stamps) for stamps, _ in tracks)
        step = max(1, -(-total // most))
        thinned = [(stamps[::step], B[::step, :3, :3]) for stamps, B in tracks]
        return RotationProblem(
            carrier,
            smooth,
            np.concatenate([stamps for stamps, _ in thinned]),
            np.concatenate([R for _, R in thinned]),
            np.repeat(np.arange(len(tracks)), [len(stamps) for stamps, _ in thinned]),
            max_gap_s,
        )

    def fit(self, offset_s: float, R_Y: Array) -> RotationFit:
        """The optimum near a first offset and R_Y."""
        R_X = self._start(offset_s, R_Y)
        noise, good = CorrelatedNoise.white(), np.ones(len(self.stamps_ns), dtype=bool)
        in_sensor = False
        for step in range(STEPS):
            at = self._at(offset_s, R_Y, R_X, in_sensor)
            if step in (3, 6):
                near = self._agreeing(at, False) & self._agreeing(at, True)
                noise, in_sensor = self._noise(at, near, in_sensor)
                at = self._at(offset_s, R_Y, R_X, in_sensor)
            now = self._agreeing(at, noise.share >= DRIFTS)
            settled, good = bool(np.array_equal(now, good)), now
            H, right, _ = self._normal(at, good, noise)
            change = -np.linalg.pinv(H, rcond=1e-9, hermitian=True) @ right
            change[0] = np.clip(change[0], -LONGEST_STEP_S, LONGEST_STEP_S)
            turn = np.minimum(1.0, 0.3 / max(float(np.abs(change[1:]).max()), 1e-12)) * change[1:].reshape(-1, 3)
            offset_s += float(change[0])
            turns = _exp(turn)
            R_Y, R_X = R_Y @ turns[0], R_X @ turns[1:]
            if step > 7 and settled and abs(change[0]) < 1e-7:
                break
        return self._finished(self._at(offset_s, R_Y, R_X, in_sensor), offset_s, good, noise)

    def _start(self, offset_s: float, R_Y: Array) -> Array:
        """Each target's R_X as a mean of R_A' R_Y R_B that wrong detections do not change (Weiszfeld's rounds)."""
        R_A = self.smooth.poses(self.stamps_ns + round(1e9 * offset_s))[:, :3, :3]
        each = R_A.transpose(0, 2, 1) @ R_Y @ self.R_B
        result = []
        for k in range(int(self.track.max()) + 1):
            own = each[self.track == k]
            weight = np.ones(len(own))
            for _ in range(START_STEPS):
                U, _, Vt = np.linalg.svd(np.einsum("n,nij->ij", weight, own))
                R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
                off = np.linalg.norm(own - R, axis=(1, 2))
                weight = 1.0 / np.maximum(off, 0.01)
            result.append(R)
        return np.array(result)

    def _at(self, offset_s: float, R_Y: Array, R_X: Array, in_sensor: bool) -> _At:
        stamps = self.stamps_ns + round(1e9 * offset_s)
        pose, velocity, variance = self.smooth.at(stamps)
        X = R_X[self.track]
        predicted = R_Y.T @ pose[:, :3, :3] @ X
        r = se3.so3_logmap(self.R_B.transpose(0, 2, 1) @ predicted)
        # R_A Exp(omega d) R_X, R_Y Exp(d) and R_X Exp(d) turn the prediction by R_X' omega d, -P' d and d.
        J = np.zeros((len(r), 3, 4 + 3 * len(R_X)))
        J[:, :, 0] = np.einsum("nji,nj->ni", X, velocity[:, :3])
        J[:, :, 1:4] = -predicted.transpose(0, 2, 1)
        for k in range(len(R_X)):
            J[self.track == k, :, 4 + 3 * k : 7 + 3 * k] = np.eye(3)
        if in_sensor:
            r, J = np.einsum("nij,nj->ni", self.R_B, r), self.R_B @ J
        return _At(r, J, variance[:, :3].sum(axis=1), self.carrier.gaps(stamps) <= self.max_gap_s)

    def _by_track(self, good: np.ndarray) -> list[tuple[np.ndarray, Array]]:
        """Indices and times (s) of each track's good detections."""
        rows = [np.flatnonzero(good & (self.track == k)) for k in range(int(self.track.max()) + 1)]
        return [(own, (self.stamps_ns[own] - self.stamps_ns[0]) * 1e-9) for own in rows if len(own)]

    def _normal(self, at: _At, good: np.ndarray, noise: CorrelatedNoise) -> tuple[Array, Array, Array]:
        """J' W J, J' W r and W J (N, 3, p) over the good detections."""
        p = at.J.shape[2]
        weighted = np.zeros_like(at.J)
        for own, seconds in self._by_track(good):
            columns, _ = noise.weighted(seconds, at.J[own].reshape(len(own), -1))
            weighted[own] = columns.reshape(len(own), 3, p)
        flat = weighted.reshape(-1, p)
        return at.J.reshape(-1, p).T @ flat, flat.T @ np.where(good[:, None], at.r, 0.0).ravel(), weighted

    def _agreeing(self, at: _At, drifts: bool) -> np.ndarray:
        """Detections that are not gross errors; where residuals drift, those near their neighbours' median."""
        off = at.r
        if drifts:
            off = at.r.copy()
            for k in range(int(self.track.max()) + 1):
                own = np.flatnonzero(at.known & (self.track == k))
                off[own] -= median_filter(at.r[own], size=(NEIGHBOURS, 1), mode="nearest")
        squares = (off**2).sum(axis=1)
        variance = float(np.median(squares[at.known])) / MEDIAN if at.known.any() else 0.0
        result: np.ndarray = at.known & (squares <= GROSS**2 * 3.0 * max(variance, 1e-18))
        return result

    def _noise(self, at: _At, good: np.ndarray, in_sensor: bool) -> tuple[CorrelatedNoise, bool]:
        """The likeliest correlation, and whether it is that of errors in the sensor's axes, not in the target's.

        Visual odometry drifts in the axes of its world; errors of a detection follow its view.
        """
        turned = np.einsum("nij,nj->ni", self.R_B if not in_sensor else self.R_B.transpose(0, 2, 1), at.r)
        here, there = (likeliest([(seconds, r[own]) for own, seconds in self._by_track(good)]) for r in (at.r, turned))
        return (there[0], not in_sensor) if there[1] < here[1] else (here[0], in_sensor)

    def _finished(self, at: _At, offset_s: float, good: np.ndarray, noise: CorrelatedNoise) -> RotationFit:
        H, _, weighted = self._normal(at, good, noise)
        others = np.linalg.pinv(H[1:, 1:], rcond=1e-9, hermitian=True) @ H[1:, 0]
        direction = np.r_[1.0, -others]  # the offset with all else following
        g, Wg = at.J @ direction, weighted @ direction
        information = float((g * Wg).sum())
        g_square = np.where(good, (g**2).sum(axis=1), 0.0)
        noise_share = float(at.rate_variance[good].sum() / max(g_square.sum(), 1e-300))
        order = np.argsort(self.stamps_ns, kind="stable")
        share = np.empty(len(order))
        share[order] = np.cumsum(g_square[order]) / max(g_square.sum(), 1e-300)
        r = np.where(good[:, None], at.r, 0.0)
        scores = (Wg * r).sum(axis=1)
        scatter = max(_scatter(scores, share, count) for count in (BLOCKS // 2, BLOCKS))
        wr = np.zeros_like(r)
        for own, seconds in self._by_track(good):
            wr[own] = noise.weighted(seconds, r[own])[0]
        freedom = max(3 * int(good.sum()) - len(direction), 1)
        variance = float((r * wr).sum()) / freedom
        true = information * max(1.0 - noise_share, 1e-3)
        sigma = max(np.sqrt(variance * information), scatter) / max(true, 1e-300)
        squares = np.where(at.known, (at.r**2).sum(axis=1), np.nan)
        rms = float(np.sqrt(squares[good].mean() / 3.0)) if good.any() else np.inf
        return RotationFit(
            offset_s, float(sigma), noise_share, rms, int(good.sum()), squares, _blocks(share, BLOCKS), noise
        )


def _blocks(share: Array, count: int) -> np.ndarray:
    """Blocks of time; ``share`` is the part of the information up to each detection."""
    result: np.ndarray = np.minimum((share * count).astype(int), count - 1)
    return result


def _scatter(scores: Array, share: Array, count: int) -> float:
    """The standard deviation of the scores' sum from blocks of time, wider by Student's quantile for few blocks."""
    block = _blocks(share, count)
    filled = max(len(np.unique(block)), 2)
    variance = float((np.bincount(block, scores, count) ** 2).sum()) * filled / (filled - 1)
    return float(np.sqrt(variance) * stdtrit(filled - 1, 0.975) / 1.96)


def _exp(omega: Array) -> Array:
    return se3.expmap(np.hstack([omega, np.zeros_like(omega)]))[:, :3, :3]
