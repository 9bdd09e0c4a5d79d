"""The time offset between a sensor's clock and its carrier's, from rotations, before anything is calibrated.

A search over offsets compares turns: R_B,j R_B,i' = R_Y' (R_A,j R_A,i') R_Y for every target alike, so that the
rotation vectors of all intervals are turned by one R_Y (Park and Martin, 1994). Each likely offset is then fitted to
R_Y' R_A(t + offset) R_X = R_B by Gauss-Newton, with noise that is correlated in time and without wrong detections. The
best one is kept if no other one fits nearly as well. Translations and scales play no part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from rwhec_factors import se3
from scipy.special import stdtrit

from gtsam_rwhec.errors import StampError
from gtsam_rwhec.geometry.correlated_noise import CorrelatedNoise, likeliest
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import SmoothPath, Trajectory

#: A detection whose rotation is off by more than this many standard deviations is wrong.
GROSS = 4.5
#: With this share of correlated noise, residuals drift: a gross error differs from the median of this many neighbours.
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
    """The fit at its optimum."""

    #: The offset and its standard deviation: 1.96 of them hold 95 %.
    offset_s: float
    sigma_s: float
    noise_share: float  #: The part of the carrier's squared turning rate that is noise
    rms_rad: float  #: Root mean square of the rotations' residuals about an axis
    used: int  #: Detections that agree
    squares: Array  #: (N,): squared residuals of all detections, rad^2; NaN where the carrier's pose is not known
    block: np.ndarray  #: (N,): the block of each detection
    noise: CorrelatedNoise  #: Correlation of the residuals in time


@dataclass(frozen=True)
class _At:
    """Residuals and derivatives at one estimate, in the target's or in the sensor's axes."""

    r: Array  # (N, 3)
    J: Array  # (N, 3, 7): by the offset, R_Y, the track's R_X
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
            turns = se3.expmap(np.hstack([turn, np.zeros_like(turn)]))[:, :3, :3]
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
                R = se3.so3_nearest(np.einsum("n,nij->ij", weight, own))
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
        J = np.zeros((len(r), 3, 7))
        J[:, :, 0] = np.einsum("nji,nj->ni", X, velocity[:, :3])
        J[:, :, 1:4] = -predicted.transpose(0, 2, 1)
        J[:, :, 4:] = np.eye(3)
        if in_sensor:
            r, J = np.einsum("nij,nj->ni", self.R_B, r), self.R_B @ J
        return _At(r, J, variance[:, :3].sum(axis=1), self.carrier.gaps(stamps) <= self.max_gap_s)

    def _good(self, good: np.ndarray) -> tuple[np.ndarray, Array, np.ndarray]:
        """Indices, times (s) and tracks of the good detections."""
        own = np.flatnonzero(good)
        return own, (self.stamps_ns[own] - self.stamps_ns[0]) * 1e-9, self.track[own]

    def _normal(self, at: _At, good: np.ndarray, noise: CorrelatedNoise) -> tuple[Array, Array, Array]:
        """J' W J (p, p) and J' W r (p,) by the offset, R_Y and all R_X, and W J (N, 3, 7), over the good detections."""
        weighted, tracks = np.zeros_like(at.J), int(self.track.max()) + 1
        own, seconds, track = self._good(good)
        weighted[own] = noise.weighted(seconds, at.J[own].reshape(-1, 21), track)[0].reshape(-1, 3, 7)
        by_track = np.zeros((tracks, 7, 8))
        both = np.concatenate([at.J, np.where(good[:, None], at.r, 0.0)[:, :, None]], axis=2)
        np.add.at(by_track, self.track, weighted.transpose(0, 2, 1) @ both)
        H, right = np.zeros((4 + 3 * tracks, 4 + 3 * tracks)), np.zeros(4 + 3 * tracks)
        places = _places(np.arange(tracks))
        np.add.at(H, (places[:, :, None], places[:, None]), by_track[:, :, :7])
        np.add.at(right, places, by_track[:, :, 7])
        return H, right, weighted

    def _agreeing(self, at: _At, drifts: bool) -> np.ndarray:
        """Detections that are not gross errors; where residuals drift, those near their neighbours' median."""
        off = at.r
        if drifts:
            from scipy.ndimage import median_filter  # slow to import, and few logs need it

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
        own, seconds, track = self._good(good)
        here, there = (likeliest(seconds, r[own], track) for r in (at.r, turned))
        return (there[0], not in_sensor) if there[1] < here[1] else (here[0], in_sensor)

    def _finished(self, at: _At, offset_s: float, good: np.ndarray, noise: CorrelatedNoise) -> RotationFit:
        H, _, weighted = self._normal(at, good, noise)
        others = np.linalg.pinv(H[1:, 1:], rcond=1e-9, hermitian=True) @ H[1:, 0]
        direction = np.r_[1.0, -others]  # the offset with all else following
        along = direction[_places(self.track)][:, :, None]
        g, Wg = (at.J @ along)[:, :, 0], (weighted @ along)[:, :, 0]
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
        own, seconds, track = self._good(good)
        wr[own] = noise.weighted(seconds, r[own], track)[0]
        freedom = max(3 * int(good.sum()) - len(direction), 1)
        variance = float((r * wr).sum()) / freedom
        true = information * max(1.0 - noise_share, 1e-3)
        sigma = max(np.sqrt(variance * information), scatter) / max(true, 1e-300)
        squares = np.where(at.known, (at.r**2).sum(axis=1), np.nan)
        rms = float(np.sqrt(squares[good].mean() / 3.0)) if good.any() else np.inf
        return RotationFit(
            offset_s, float(sigma), noise_share, rms, int(good.sum()), squares, _blocks(share, BLOCKS), noise
        )


def _places(track: np.ndarray) -> np.ndarray:
    """Where the offset, R_Y and each track's R_X are among all unknowns (n, 7)."""
    return np.hstack([np.broadcast_to(np.arange(4), (len(track), 4)), 4 + 3 * track[:, None] + np.arange(3)])


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


#: The two detections of an interval are this many seconds apart. The time is long enough for the turn to exceed a
#: detection's noise, and short enough for the motion not to repeat itself.
INTERVAL_S = 0.4
#: At most this many intervals are used; they are taken evenly from all.
MOST_TURNS = 1500
#: Differences are cut off at this many standard deviations.
CUT = 4.0
#: Rounds of reweighting for each R_Y.
ROUNDS = 3


@dataclass(frozen=True)
class Turns:
    """The intervals of all tracks of a sensor."""

    #: (N,): the sensor's stamps
    start_ns: np.ndarray
    end_ns: np.ndarray
    turn: Array  #: (N, 3): log(R_B,end R_B,start'), rad, in the sensor's axes
    noise_rad: float  #: Robust standard deviation of a turn about each axis, from the detections

    @staticmethod
    def of(tracks: Sequence[tuple[np.ndarray, Array]]) -> Turns:
        """The intervals between detections of one target that are about `INTERVAL_S` apart, of all tracks."""
        parts = [_of_track(stamps, B) for stamps, B in tracks]
        start, end, turn = (np.concatenate(part) for part in zip(*(p[:3] for p in parts), strict=True))
        jerks = np.concatenate([p[3] for p in parts])
        # A second difference has six times a detection's variance; motion can only add to it.
        scatter = float(np.median(np.abs(jerks))) / 0.6745 / np.sqrt(6.0) if jerks.size else 0.0
        some = np.linspace(0, max(len(start) - 1, 0), min(MOST_TURNS, len(start))).astype(int)
        return Turns(start[some], end[some], turn[some], np.sqrt(2.0) * scatter)

    def compared(
        self, carrier: Trajectory, smooth: SmoothPath, offset_s: float, max_gap_s: float
    ) -> tuple[float, Array, int]:
        """The mean cut-off squared difference (rad^2) at an offset, the best R_Y, and how many turns are known."""
        shift = round(offset_s * 1e9)
        known = np.ones(len(self.turn), dtype=bool)
        R = []
        for stamps in (self.start_ns + shift, self.end_ns + shift):
            known &= carrier.gaps(stamps) <= max_gap_s
            R.append(smooth.poses(stamps)[:, :3, :3])
        if not known.any():
            return np.inf, np.eye(3), 0
        a, b = se3.so3_logmap((R[1] @ R[0].transpose(0, 2, 1))[known]), self.turn[known]
        cut = CUT * max(np.sqrt(self.noise_rad**2 + 2.0 * smooth.scatter[:3].mean()), 1e-9)
        weight = np.ones(len(a))
        for _ in range(ROUNDS):
            R_Y = aligned(a, b, weight)
            off = np.linalg.norm(a - b @ R_Y.T, axis=1)
            weight = 1.0 / np.maximum(off, 0.3 * cut)
        return float(np.mean(np.minimum(off, cut) ** 2)), R_Y, int(known.sum())


def aligned(a: Array, b: Array, weight: Array) -> Array:
    """The rotation R with the smallest sum of weight |a - R b|^2, for (N, 3) vectors (Kabsch 1976)."""
    return se3.so3_nearest((a * weight[:, None]).T @ b)


def _of_track(stamps_ns: np.ndarray, B: Array) -> tuple[np.ndarray, np.ndarray, Array, Array]:
    """Stamps (start, end) and turns of a track's intervals, and second differences of its rotations."""
    if len(stamps_ns) < 3:
        return stamps_ns[:0], stamps_ns[:0], np.zeros((0, 3)), np.zeros((0, 3))
    interval_ns = round(max(INTERVAL_S * 1e9, 1.2 * float(np.median(np.diff(stamps_ns)))))
    later = np.searchsorted(stamps_ns, stamps_ns + interval_ns)
    i = np.flatnonzero(later < len(stamps_ns))
    j = later[i]
    near = stamps_ns[j] - stamps_ns[i] < 2 * interval_ns
    i, j = i[near], j[near]
    R = B[:, :3, :3]
    steps = se3.so3_logmap(R[1:] @ R[:-1].transpose(0, 2, 1))
    return stamps_ns[i], stamps_ns[j], se3.so3_logmap(R[j] @ R[i].transpose(0, 2, 1)), np.diff(steps, axis=0)


#: Two neighbouring offsets of the search are this many seconds apart.
GRID_S = 0.02
#: This many of the search's minima are fitted.
CANDIDATES = 4
#: At most this many detections are used; they are taken evenly from all.
MOST = 3000
#: A standard deviation above this, s, is no use: the offset is not determined.
LARGEST_SIGMA_S = 0.05
#: At most this share of the carrier's squared turning rate may be noise.
LARGEST_NOISE_SHARE = 0.7
#: Another offset fits worse only if the difference is this many of its standard deviations, from blocks of time.
CLEARLY = 3.0


@dataclass(frozen=True)
class TimeOffset:
    """A sensor's stamp t is its carrier's t + offset_s."""

    #: The offset and its standard deviation: offset_s +- 1.96 sigma_s holds the truth in 95 % of cases. It contains
    #: residuals that are correlated in time, and the noise of the carrier's poses.
    offset_s: float
    sigma_s: float
    measurements: int  #: Detections that agree with the offset
    rms_rad: float  #: Root mean square of their rotations' residuals about an axis


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
        if abs(other.offset_s) > search_s + GRID_S:
            continue  # a descent that left the search: few measurements overlap there, and the last digit sends it
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
