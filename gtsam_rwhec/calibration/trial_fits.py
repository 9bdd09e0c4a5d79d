"""Robust fits of a sample of the measurements: the residuals of a reading, and whether these may be noise.

A fit iterates re-weighted certified-form least squares: its weights come from its own residuals, so neither stated
weights nor outliers decide, and the same measure serves a good reading and a wrong one. Only the search of the solver
runs: no certificate, no covariances.
"""

from __future__ import annotations

import math
import warnings
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

import numpy as np
from rwhec_factors.se3 import inverse, pose

from gtsam_rwhec.calibration.other_readings import OtherReading
from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import ScaleMode, scale_at
from gtsam_rwhec.problem.measurements import Measurements, Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.answers import answer_of, scales_of
from gtsam_rwhec.solver.descent import descend, spectral_start, unconstrained_start
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solver.solution import Solution

#: The median length of a Gaussian vector in three dimensions, in its standard deviations about one axis.
MEDIAN_OF_CHI = 1.5382
#: Rounds of re-weighting; weights of measurements settle in three or four.
ROUNDS = 5
#: Degrees of freedom of Student's t, which weighs outliers down.
DEGREES_OF_T = 6.0
#: Standard deviation of rotations before the first round (rad): the balance against translations.
FIRST_RAD = 0.05
#: Standard deviation of translations before the first round, as a share of B's median distance.
FIRST_SHARE = 0.05
#: Weights use no rotation noise below this (rad), and no translation noise below this share of the distances.
SMALLEST_SHARE = 1e-5
#: Descents from one start take at most so many steps; three to ten are usual.
STEPS = 30

Sample = Mapping[Pair, tuple[Array, Array]]


@dataclass(frozen=True)
class Spread:
    """Medians over measurements: of rotation angles (rad) and of lengths (m)."""

    rotation_rad: float
    translation_m: float

    @staticmethod
    def of(rotation_rad: Array, translation_m: Array) -> Spread:
        """The medians of single values (N,)."""
        return Spread(float(np.median(rotation_rad)), float(np.median(translation_m)))


@dataclass(frozen=True)
class TrialFit:
    """A robust fit of a reading."""

    residual: Spread  #: Of B against its prediction, in the unit that B has
    #: Lengths in B over true lengths; negative where A and B are of different handedness
    scale: float | dict[str, float]
    errors: Array  #: (2, N): of each measurement, pair after pair: angle (rad) and distance (in B's unit)
    frames: dict[str, Array]  #: The poses of targets and sensors

    @property
    def log_likelihoods(self) -> Array:
        """One per measurement (N,), up to a constant: Student's t in six dimensions, with the fit's own spreads."""
        s_R, s_t = self.residual.rotation_rad, self.residual.translation_m
        squared = (self.errors[0] / s_R) ** 2 + (self.errors[1] / s_t) ** 2
        tails = 0.5 * (DEGREES_OF_T + 6.0) * np.log1p(MEDIAN_OF_CHI**2 * squared / DEGREES_OF_T)
        result: Array = -3.0 * np.log(s_R * s_t) - tails
        return result

    @property
    def one_scale(self) -> float:
        """The scale, or the median of the targets' scales."""
        return float(np.median(list(self.scale.values()))) if isinstance(self.scale, dict) else self.scale


def likelihood_of_a_wrong_one(signal: Spread) -> float:
    """The log likelihood of a measurement that is anywhere in the variation of B, as `TrialFit.log_likelihoods`."""
    S_R, S_t = max(signal.rotation_rad, 1e-12), max(signal.translation_m, 1e-12)
    return -3.0 * math.log(S_R * S_t) - 0.5 * (DEGREES_OF_T + 6.0) * math.log1p(6.0 / DEGREES_OF_T)


def fitted(
    problem: Problem, sample: Sample, scale: ScaleMode | None = None, *, rounds: int = ROUNDS
) -> TrialFit | None:
    """Fit a sample of a problem robustly; ``scale`` overrules the problem's. None where the sample has no answer."""
    mode = scale or problem.scale
    if not sample:
        return None  # a shift of rows leaves nothing of pairs with one row each
    try:
        with warnings.catch_warnings(action="ignore"), np.errstate(all="ignore"):  # the words of trials are for nobody
            return _fitted(problem, sample, mode, rounds)
    except (RwhecError, np.linalg.LinAlgError):
        return None  # too few measurements for this scale, or no finite answer: this reading explains nothing


def _fitted(problem: Problem, sample: Sample, mode: ScaleMode, rounds: int) -> TrialFit | None:
    distance = median_distance(sample)
    kappa, sigma = 0.5 / FIRST_RAD**2, FIRST_SHARE * distance
    weights: dict[Pair, Array] = {pair: np.ones(len(B)) for pair, (_, B) in sample.items()}
    starts: list[Array] | None = None
    best: TrialFit | None = None
    for _ in range(rounds):
        trial = _problem_of(problem, sample, mode, weights, sigma, kappa)
        frames, scales, starts = _solved(trial, starts)
        errors = {pair: residuals(frames, scales[pair.target], pair, *sample[pair]) for pair in sample}
        joined = np.concatenate(list(errors.values()), axis=1)
        if not np.isfinite(joined).all():
            return best
        spread = Spread.of(*joined)
        if best is None or _volume(spread, distance) < _volume(best.residual, distance):
            own = {pair.target: scales[pair.target] for pair in sample}
            best = TrialFit(spread, own if mode == "per_target" else next(iter(own.values())), joined, frames)
        s_R = max(spread.rotation_rad, SMALLEST_SHARE) / MEDIAN_OF_CHI
        s_t = max(spread.translation_m, SMALLEST_SHARE * distance) / MEDIAN_OF_CHI
        kappa, sigma = 0.5 / s_R**2, s_t
        weights = {
            pair: 1.0 / (1.0 + ((rotation / s_R) ** 2 + (translation / s_t) ** 2) / DEGREES_OF_T)
            for pair, (rotation, translation) in errors.items()
        }
    return best


def _volume(spread: Spread, distance: float) -> float:
    return max(spread.rotation_rad, SMALLEST_SHARE) * max(spread.translation_m, SMALLEST_SHARE * distance)


def _problem_of(
    problem: Problem, sample: Sample, mode: ScaleMode, weights: dict[Pair, Array], sigma: float, kappa: float
) -> Problem:
    """The sample as a problem with the same knowledge of frames."""
    trial = Problem(mode, keep_measurements=False)
    for pair, (A, B) in sample.items():
        w = weights[pair]
        add = partial(trial.add_motion, pair.sensor) if pair.is_motion else partial(trial.add, *pair)
        add(A, B, sigma / np.sqrt(w), kappa * w)
    names = trial.targets + trial.sensors
    trial.fixed = {name: T for name, T in problem.fixed.items() if name in names}
    if mode == "per_target":
        trial.fixed_scales = {name: problem.fixed_scales[name] for name in names if name in problem.fixed_scales}
    return trial


def _solved(trial: Problem, starts: list[Array] | None) -> tuple[dict[str, Array], dict[str, float], list[Array]]:
    """Poses by name, scales by a pair's first name, and rotations by part, of the best of a few descents; no proof."""
    frames: dict[str, Array] = dict(trial.fixed)
    scales: dict[str, float] = {}
    rotations = []
    for number, part in enumerate(parts_of(trial)):
        form = PartForm.of(part)
        first = [starts[number]] if starts else spectral_start(part, form.rotation) + unconstrained_start(form.reduced)
        ends = [descend(form.reduced, R, STEPS) for R in first]
        R = min(ends, key=lambda end: end.cost).R
        rotations.append(R)
        answer = answer_of(part, form.reduced, R)
        for name, R_name, t in zip(part.free, answer.R, answer.t, strict=True):
            frames[name] = pose(R_name, t + part.frame_shift(name))
        scales |= scales_of(part, answer)
    return frames, scales, rotations


def residuals(frames: Mapping[str, Array], scale: float, pair: Pair, A: Array, B: Array) -> Array:
    """The angles (rad) and distances (in B's unit) of B (N, 4, 4) from its prediction Y^-1 A X: (2, N)."""
    predicted = inverse(frames[pair.sensor]) @ A @ frames[pair.target]
    return np.stack(
        [angles(B[:, :3, :3], predicted[:, :3, :3]), np.linalg.norm(B[:, :3, 3] - scale * predicted[:, :3, 3], axis=1)]
    )


def angles(R: Array, S: Array) -> Array:
    """The angles (N,) between rotations (N, 3, 3) or (3, 3), rad."""
    half_chord = np.linalg.norm(R - S, axis=(-2, -1)) / np.sqrt(8.0)  # sin(angle / 2)
    result: Array = 2.0 * np.arcsin(np.minimum(1.0, half_chord))
    return result


def residual_of(problem: Problem, solution: Solution) -> Spread | None:
    """The median residuals of all measurements that the problem kept; None where it kept none."""
    frames = {name: T.matrix() for name, T in (solution.X | solution.Y).items()}
    found = []
    for pair in problem.pairs:
        scale = scale_at(solution.scale, pair.target)
        found += [residuals(frames, scale, pair, batch.A, batch.B) for batch in problem.batches(*pair)]
    return Spread.of(*np.concatenate(found, axis=1)) if found else None


def median_distance(sample: Sample) -> float:
    """The median length of B's translations, and one micrometre at least."""
    return max(
        float(np.median(np.concatenate([np.linalg.norm(B[:, :3, 3], axis=1) for _, B in sample.values()]))), 1e-6
    )


def signal_of(sample: Sample) -> Spread:
    """The variation of B within its pairs: medians of the residuals from the best constant pose of each pair."""
    rotation, translation = [], []
    for _, B in sample.values():
        R, t = B[:, :3, :3], B[:, :3, 3]
        U, _, V = np.linalg.svd(R.sum(axis=0))
        mean = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
        rotation.append(angles(R, mean))
        translation.append(np.linalg.norm(t - np.median(t, axis=0), axis=1))
    return Spread.of(np.concatenate(rotation), np.concatenate(translation))


#: At most so many measurements of a pair, from all over its rows.
MOST_OF_A_PAIR = 200
#: At most so many pairs: those that join the frames with the most measurements.
MOST_PAIRS = 24
#: At most so many measurements in all.
MOST_IN_ALL = 2000
#: About so many blocks of neighbouring rows are compared.
BLOCKS = 24
#: A row turns by at most this share of what rows far apart differ by, where carriers move slowly.
SLOW_SHARE = 0.3
#: A pair with fewer measurements is not sampled where others have more: it says little, and has its own unknowns.
FEWEST_OF_A_PAIR = 4


@dataclass(frozen=True)
class Sampled:
    """The raw measurements of some pairs, and which rows of each are looked at."""

    whole: dict[Pair, Measurements]
    rows: dict[Pair, np.ndarray]

    @staticmethod
    def of(problem: Problem, most_pairs: int = MOST_PAIRS, most_in_all: int = MOST_IN_ALL) -> Sampled | None:
        """A sample of a problem; None where it kept no measurements."""
        if not problem.has_measurements:
            return None
        pairs = _pairs(problem, most_pairs)
        most = max(min(MOST_OF_A_PAIR, most_in_all // len(pairs)), FEWEST_OF_A_PAIR)
        whole = {pair: problem.measurements(*pair) for pair in pairs}
        rows = {pair: np.unique(np.linspace(0, len(raw.A) - 1, most).astype(int)) for pair, raw in whole.items()}
        return Sampled(whole, rows)

    @property
    def count(self) -> int:
        """The number of measurements."""
        return sum(map(len, self.rows.values()))

    @property
    def unknown_poses(self) -> int:
        """The number of frames."""
        return len({name for pair in self.rows for name in pair.frames})

    def as_read(self) -> dict[Pair, tuple[Array, Array]]:
        """A and B as they are."""
        return {pair: (raw.A[self.rows[pair]], raw.B[self.rows[pair]]) for pair, raw in self.whole.items()}

    @property
    def has_clock(self) -> bool:
        """Whether every pair has stamps, and moves slowly from one row to the next: then rows tell a clock's offset.

        A shift of such rows and an offset of the clock are one thing, and the offset is estimated.
        """
        for raw in self.whole.values():
            if raw.stamps_ns is None or len(raw.A) < 3:
                return False
            R = raw.A[np.argsort(raw.stamps_ns), :3, :3]
            apart = len(R) // 2
            if np.median(angles(R[1:], R[:-1])) > SLOW_SHARE * np.median(angles(R[apart:], R[: len(R) - apart])):
                return False
        return True

    @property
    def all_poses(self) -> tuple[Array, Array]:
        """A and B (N, 4, 4) of all pairs, as they are."""
        A, B = (np.concatenate(poses) for poses in zip(*self.as_read().values(), strict=True))
        return A, B

    @property
    def median_lengths(self) -> tuple[float, float]:
        """Median lengths of A's translations about their own median, and of B's."""
        A, B = (poses[:, :3, 3] for poses in self.all_poses)
        centred = A - np.median(A, axis=0)
        return float(np.median(np.linalg.norm(centred, axis=1))), float(np.median(np.linalg.norm(B, axis=1)))

    def by(self, reading: OtherReading) -> dict[Pair, tuple[Array, Array]]:
        """A and B by another reading. Motions have one frame, and their rows belong together: no roles, no shift."""
        found = {}
        for pair, raw in self.whole.items():
            rows, shift = self.rows[pair][self._remains(pair, reading)], 0 if pair.is_motion else reading.shift
            if len(rows):
                found[reading.pair(pair)] = reading.changed(raw.A[rows], raw.B[rows + shift])
        return found

    def remains(self, reading: OtherReading) -> np.ndarray:
        """Which measurements of ``as_read`` the reading has too, pair after pair: a shift leaves some out."""
        return np.concatenate([self._remains(pair, reading) for pair in self.rows])

    def _remains(self, pair: Pair, reading: OtherReading) -> np.ndarray:
        shifted = self.rows[pair] + (0 if pair.is_motion else reading.shift)
        return (shifted >= 0) & (shifted < len(self.whole[pair].B))

    def blocks(self) -> np.ndarray:
        """A block number of each measurement: blocks are contiguous rows of a pair, since neighbours share errors."""
        of_a_pair = -(-BLOCKS // len(self.rows))
        numbers, first = [], 0
        for rows in self.rows.values():
            many = min(of_a_pair, len(rows))
            numbers.append(first + np.arange(len(rows)) * many // len(rows))
            first += many
        return np.concatenate(numbers)


def _pairs(problem: Problem, most: int) -> list[Pair]:
    """The pairs with the most measurements, each joined to those before it where there is such a pair."""
    counts = {pair: problem.moments(*pair).count for pair in problem.pairs}
    by_frame: dict[str, set[Pair]] = defaultdict(set)
    for pair in counts:
        for name in pair:
            by_frame[name].add(pair)
    enough = [pair for pair, count in counts.items() if count >= FEWEST_OF_A_PAIR] or list(counts)
    left = sorted(enough, key=lambda pair: -counts[pair])
    chosen: list[Pair] = []
    names: set[str] = set()
    while left and len(chosen) < most:
        # A pair that closes a loop tells more than one with a frame of its own.
        best = max(left, key=lambda pair: (sum(name in names for name in pair), counts[pair]))
        chosen.append(best)
        names.update(best)
        left.remove(best)
    return chosen


#: No camera, lidar or motion capture turns a target by this much (degrees) in half of its measurements.
LARGEST_DEG = 25.0
#: From this much (degrees) on, a residual that is most of what B varies by is no noise either.
LARGE_DEG = 12.0
#: "Most of what B varies by": the calibration then explains next to nothing.
UNEXPLAINED_PART = 0.6
#: Half of a sensor's measurements are never off by this share of the target's distance.
LARGEST_SHARE_OF_DISTANCE = 0.25


class Unlikely(StrEnum):
    """Why residuals are no measurement noise."""

    #: The median rotation residual is larger than any sensor's.
    ROTATION = "rotation"
    #: Rotations of B vary as much after the calibration as before it.
    ROTATION_UNEXPLAINED = "rotation_unexplained"
    #: Translations of B vary as much after the calibration as before it.
    TRANSLATION_UNEXPLAINED = "translation_unexplained"


@dataclass(frozen=True)
class Implausible:
    """Residuals that no sensor has; ``str()`` is one sentence."""

    why: Unlikely
    #: The median residuals; root mean squares where measurements were not kept
    rotation_deg: float
    translation_mm: float
    #: What B varies by within its pairs, medians; nan where measurements were not kept
    varies_deg: float
    varies_mm: float

    def __str__(self) -> str:
        deg, mm = rounded(self.rotation_deg, 3), rounded(self.translation_mm, 3)
        found = {
            Unlikely.ROTATION: f"half of the measurements are off by {deg} deg or more ({mm} mm)",
            Unlikely.ROTATION_UNEXPLAINED: f"the median residual of rotations, {deg} deg, is about "
            f"as large as what B varies by ({rounded(self.varies_deg, 3)} deg)",
            Unlikely.TRANSLATION_UNEXPLAINED: f"the median residual of translations, {mm} mm, is "
            f"about as large as what B varies by ({rounded(self.varies_mm, 3)} mm)",
        }[self.why]
        return f"{found}: no sensor measures like that, so A and B do not belong together as given"


def implausible(problem: Problem, solution: Solution | None) -> Implausible | None:
    """Find residuals that are no measurement noise, with weights or without.

    ``calibrate`` tests the measurements that agree again, since wrong ones may spoil the fit of all of them.

    Medians decide, of the solution or of a robust fit of a sample, whichever are smaller: outliers change nothing as
    long as they are fewer than half. Without raw measurements the solution's root mean squares decide.

    Parameters
    ----------
    problem : Problem
    solution : Solution or None
        The problem's solution; None where it has none.

    Returns
    -------
    Implausible or None
        None where the residuals may be noise.
    """
    sampled = Sampled.of(problem)
    if sampled is None:
        return _by_root_mean_squares(solution) if solution is not None else None
    sample = sampled.as_read()
    signal = signal_of(sample)
    residual = residual_of(problem, solution) if solution is not None else None
    if residual is not None and _why(residual, signal, median_distance(sample)) is None:
        return None
    fit = fitted(problem, sample)
    found = [spread for spread in (residual, fit.residual if fit else None) if spread is not None]
    reasons = [why for spread in found if (why := _why(spread, signal, median_distance(sample))) is not None]
    if not found or len(reasons) < len(found):
        return None
    why, best = min(zip(reasons, found, strict=True), key=lambda each: each[1].rotation_rad * each[1].translation_m)
    return _record(why, best, signal)


def _why(residual: Spread, signal: Spread, distance_m: float) -> Unlikely | None:
    degrees = math.degrees(residual.rotation_rad)
    if degrees > LARGEST_DEG:
        return Unlikely.ROTATION
    if degrees > LARGE_DEG and residual.rotation_rad > UNEXPLAINED_PART * signal.rotation_rad:
        return Unlikely.ROTATION_UNEXPLAINED
    if (
        residual.translation_m > UNEXPLAINED_PART * signal.translation_m
        and residual.translation_m > LARGEST_SHARE_OF_DISTANCE * distance_m
    ):
        return Unlikely.TRANSLATION_UNEXPLAINED
    return None


def _by_root_mean_squares(solution: Solution) -> Implausible | None:
    values = solution.residuals.values()
    counts = np.array([value.number_of_measurements for value in values], dtype=float)
    squares = np.array([(value.rotation_rms_rad**2, value.translation_rms_m**2) for value in values])
    rotation, translation = np.sqrt(counts @ squares / counts.sum())
    if math.degrees(rotation) <= LARGEST_DEG:
        return None
    return _record(Unlikely.ROTATION, Spread(float(rotation), float(translation)), Spread(np.nan, np.nan))


def _record(why: Unlikely, residual: Spread, signal: Spread) -> Implausible:
    return Implausible(
        why,
        math.degrees(residual.rotation_rad),
        1e3 * residual.translation_m,
        math.degrees(signal.rotation_rad),
        1e3 * signal.translation_m,
    )
