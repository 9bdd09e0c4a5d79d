"""Robust fits of a sample of a problem's measurements: what a reading of them leaves unexplained.

A fit iterates re-weighted certified-form least squares: its weights come from its own residuals, so neither stated
weights nor outliers decide, and the same measure serves a good reading and a wrong one. Only the search of the solver
runs: no certificate, no covariances.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from rwhec_factors.se3 import inverse, pose

from gtsam_rwhec.errors import RwhecError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.descent import descend
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solver.start import spectral_start, unconstrained_start
from gtsam_rwhec.solver.variables import answer_of, scales_of
from gtsam_rwhec.solving.solution import Solution

#: The median length of a Gaussian vector in three dimensions, in its standard deviations about one axis.
MEDIAN_OF_CHI = 1.5382
#: Rounds of re-weighting; weights of measurements settle in three or four.
ROUNDS = 5
#: Degrees of freedom of Student's t, which weighs outliers down.
DEGREES_OF_T = 6.0
#: Standard deviation of rotations before the first round (rad): the balance against translations.
FIRST_RAD = 0.05
#: Standard deviation of translations before the first round, as a share of the distances that B has.
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
    """A robust fit of a reading.

    Attributes
    ----------
    residual : Spread
        Of B against its prediction, in the unit that B has.
    scale : float or dict of str to float
        Lengths in B over true lengths; negative where A and B are of different handedness.
    errors : (2, N) array
        Of each measurement, pair after pair: angle (rad) and distance (in B's unit).
    frames : dict of str to (4, 4) array
        The poses of targets and sensors.
    """

    residual: Spread
    scale: float | dict[str, float]
    errors: Array
    frames: dict[str, Array]

    @property
    def log_likelihoods(self) -> Array:
        """Of each measurement (N,), up to a constant: Student's t in six dimensions, with the fit's own spreads."""
        s_R, s_t = self.residual.rotation_rad, self.residual.translation_m
        squared = (self.errors[0] / s_R) ** 2 + (self.errors[1] / s_t) ** 2
        dimensions = 6.0
        tails = 0.5 * (DEGREES_OF_T + dimensions) * np.log1p(MEDIAN_OF_CHI**2 * squared / DEGREES_OF_T)
        result: Array = -3.0 * np.log(s_R * s_t) - tails
        return result

    @property
    def one_scale(self) -> float:
        """The scale, or the median of the targets' scales."""
        return float(np.median(list(self.scale.values()))) if isinstance(self.scale, dict) else self.scale


@dataclass(frozen=True)
class _Answer:
    frames: dict[str, Array]  #: (4, 4) by name
    scales: dict[str, float]  #: by the first name of a pair
    rotations: list[Array]  #: of each part, where the next round starts


def fitted(
    problem: Problem, sample: Sample, scale: ScaleMode | None = None, *, rounds: int = ROUNDS
) -> TrialFit | None:
    """Fit a sample of a problem robustly; ``scale`` overrules the problem's. None where the sample has no answer."""
    mode = scale or problem.scale
    if not sample:
        return None  # a shift of rows leaves nothing of pairs with one row each
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # the words of trials are for nobody
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
        answer = _solved(trial, starts)
        starts = answer.rotations
        errors = {pair: residuals(answer.frames, answer.scales[pair.target], pair, *sample[pair]) for pair in sample}
        joined = np.concatenate(list(errors.values()), axis=1)
        if not np.isfinite(joined).all():
            return best
        spread = Spread.of(*joined)
        kept = best is None or _volume(spread, distance) < _volume(best.residual, distance)
        if kept:
            scales = {pair.target: answer.scales[pair.target] for pair in sample}
            own = scales if mode == "per_target" else next(iter(scales.values()))
            best = TrialFit(spread, own, joined, answer.frames)
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
        if pair.is_motion:
            trial.add_motion(pair.sensor, A, B, sigma / np.sqrt(w), kappa * w)
        else:
            trial.add(*pair, A, B, sigma / np.sqrt(w), kappa * w)
    names = trial.targets + trial.sensors
    trial.fixed = {name: T for name, T in problem.fixed.items() if name in names}
    if mode == "per_target":
        trial.fixed_scales = {name: problem.fixed_scales[name] for name in names if name in problem.fixed_scales}
    return trial


def _solved(trial: Problem, starts: list[Array] | None) -> _Answer:
    """The best of a few descents, part by part; no proof."""
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
    return _Answer(frames, scales, rotations)


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
        scale = solution.scale[pair.target] if isinstance(solution.scale, dict) else solution.scale
        found += [residuals(frames, scale, pair, batch.A, batch.B) for batch in problem.batches(*pair)]
    return Spread.of(*np.concatenate(found, axis=1)) if found else None


def median_distance(sample: Sample) -> float:
    """The median length of B's translations, and one micrometre at least."""
    return max(
        float(np.median(np.concatenate([np.linalg.norm(B[:, :3, 3], axis=1) for _, B in sample.values()]))), 1e-6
    )


def signal_of(sample: Sample) -> Spread:
    """How much B varies within its pairs: medians of what is left by the best constant pose of each pair."""
    rotation, translation = [], []
    for _, B in sample.values():
        R, t = B[:, :3, :3], B[:, :3, 3]
        U, _, V = np.linalg.svd(R.sum(axis=0))
        mean = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
        rotation.append(angles(R, mean))
        translation.append(np.linalg.norm(t - np.median(t, axis=0), axis=1))
    return Spread.of(np.concatenate(rotation), np.concatenate(translation))
