"""Frames that moved at some moment, where the fit has spread the step over all residuals.

A large step bends the answer itself: its residuals are then neither two groups nor noise, and look like drift. So,
where neighbours' residuals are alike, each frame is given a second pose from some moment on. A frame has moved where
this fits far better, and where both poses are much farther apart than the measurements of each are spread. A random
walk is not: its halves lie about as far apart as each is spread.
"""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.calibration.trial_fits import MEDIAN_OF_CHI, Sample, Spread, TrialFit, fitted
from gtsam_rwhec.calibration.two_poses import TwoPoses, by_station
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem

#: The step is tried at these shares of the rows, and then at each row between the neighbours of the best.
CUTS = tuple(np.arange(1, 8) / 8.0)
#: Each side of a cut has measurements from at least so many poses. Where there are more frames, the others hold a moved
#: one.
FEWEST, MOST_FRAMES = 6, 6
#: The product of the residuals' medians, rotation and translation, falls by this factor at least.
BETTER = 8.0
#: And by this factor at least below that of another explanation, where there is one.
CLEARLY_BETTER = 3.0
#: The two poses are this many standard deviations of one measurement apart, in rotation or in translation.
APART = 5.0
#: Rounds of a fit on trial, and halvings of the interval in which the step is looked for.
ROUNDS, HALVINGS = 2, 5


def moved_frame(problem: Problem, sample: Sample) -> TwoPoses | None:
    """The frame that moved once, from some measurement of its pairs on; None where none did: see `step_of`."""
    found = step_of(problem, sample)
    return None if found is None else found[0]


def step_of(problem: Problem, sample: Sample) -> tuple[TwoPoses, Spread] | None:
    """The frame that moved once, and the residuals that remain with its two poses; None where none did.

    Parameters
    ----------
    problem : Problem
        For its scale and for what is known of frames.
    sample : dict of Pair to (A, B)
        Its measurements in their order, (N, 4, 4) each.
    """
    frames = [name for pair in sample for name in pair.frames]
    names = [name for name in dict.fromkeys(frames) if name not in problem.fixed]
    number = sum(len(by_station(A)[1]) for A, _ in sample.values())
    if not names or len(set(frames)) > MOST_FRAMES or number < 2 * FEWEST:
        return None
    plain = fitted(problem, sample, rounds=ROUNDS)
    if plain is None:
        return None
    best: tuple[float, str, float] | None = None
    for name in names:
        tried = [(_volume(_split(problem, sample, name, cut)), name, cut) for cut in CUTS]
        best = min(tried if best is None else [best, *tried])
    if best is None or best[0] * BETTER > _volume(plain):
        return None
    name, cut = best[1], _refined_cut(problem, sample, best)
    fit = _split(problem, sample, name, cut)
    step = None if fit is None else _step(name, sample, cut, fit)
    return None if fit is None or step is None else (step, fit.residual)


def explains_more(problem: Problem, sample: Sample, remains: Spread) -> bool:
    """Whether a step of one frame leaves far smaller residuals than another explanation, which left `remains`.

    A step costs six unknowns and a moment; so what it leaves must be smaller by a factor, `CLEARLY_BETTER`.
    """
    found = step_of(problem, sample)
    return found is not None and _product(found[1]) * CLEARLY_BETTER < _product(remains)


def _second(name: str) -> str:
    return f"{name} after it moved"


def _cut_sample(sample: Sample, name: str, cut: float) -> dict[Pair, tuple[Array, Array]]:
    """The sample with another name for a frame from a share of each of its pairs' rows on."""
    found: dict[Pair, tuple[Array, Array]] = {}
    for pair, (A, B) in sample.items():
        if name not in pair.frames:
            found[pair] = (A, B)
            continue
        row = round(cut * len(B))
        second = Pair(*(_second(frame) if frame == name else frame for frame in (pair.target, pair.sensor)))
        for of, rows in ((pair, slice(0, row)), (second, slice(row, None))):
            if len(B[rows]):
                found[of] = (A[rows], B[rows])
    return found


def _split(problem: Problem, sample: Sample, name: str, cut: float) -> TrialFit | None:
    parts = _cut_sample(sample, name, cut)
    sides = [
        sum(len(by_station(A)[1]) for pair, (A, _) in parts.items() if of in pair.frames)
        for of in (name, _second(name))
    ]
    return fitted(problem, parts, rounds=ROUNDS) if min(sides) >= FEWEST else None


def _volume(fit: TrialFit | None) -> float:
    return np.inf if fit is None else _product(fit.residual)


def _product(residual: Spread) -> float:
    return residual.rotation_rad * residual.translation_m


def _refined_cut(problem: Problem, sample: Sample, best: tuple[float, str, float]) -> float:
    """The cut with the smallest residuals, by halving the steps about the best so far."""
    volume, name, cut = best
    step = 1.0 / 16.0
    for _ in range(HALVINGS):
        tried = [(_volume(_split(problem, sample, name, at)), at) for at in (cut - step, cut + step)]
        volume, cut = min((volume, cut), *tried)
        step *= 0.5
    return cut


def _step(name: str, sample: Sample, cut: float, fit: TrialFit) -> TwoPoses | None:
    """How far the frame moved, in standard deviations of its measurements; None where that is not far."""
    before, after = fit.frames[name], fit.frames[_second(name)]
    step = se3.logmap(se3.inverse(before[None]) @ after)[0]
    angle, distance = float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:]))
    scale = abs(fit.one_scale)
    spread_rad, spread_m = fit.residual.rotation_rad / MEDIAN_OF_CHI, fit.residual.translation_m / MEDIAN_OF_CHI
    if angle < APART * spread_rad and distance * scale < APART * spread_m:
        return None
    rows = [(round(cut * len(B)), len(B)) for pair, (_, B) in sample.items() if name in pair.frames]
    first = sum(row for row, _ in rows)
    second = sum(count for _, count in rows) - first
    from_row = rows[0][0] + 1 if len(rows) == 1 else None
    return TwoPoses(name, first, second, angle, distance, from_row, any(name == pair.sensor for pair in sample))
