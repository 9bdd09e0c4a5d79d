"""Misreadings: mistakes in reading A and B, found because another reading of the same numbers fits far better.

A certificate proves that no other poses fit better; it says nothing about numbers that were misread. So, where
residuals are not plainly those of a sensor, each likely mistake is undone on a sample, and fitted again. A reading is
named only if it explains the measurements, and explains them better than the given one by a factor and by more than
chance allows.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.calibration.readings import DOUBLE, SINGLE, Mistake, Reading, shifted
from gtsam_rwhec.calibration.samples import Sampled
from gtsam_rwhec.calibration.trial_fits import Spread, TrialFit, fitted, residual_of, signal_of
from gtsam_rwhec.files.progress import Progress, check_progress, silent
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solving.solution import Solution

#: Residuals below this share of what B varies by are plainly those of a sensor: nothing is tried.
PLAIN_SHARE = 0.05
#: The product of both residuals' ratios must be at least this: "fits far better".
FAR_BETTER = 5.0
#: And it must be above what chance does by this many of its standard deviations.
SIGMAS = 5.0
#: A residual that became smaller must be below this share of what B varies by: the reading then explains it.
EXPLAINED = 0.3
#: A residual may be larger by this factor, if the other one gains more.
NOT_WORSE = 1.5
#: The variance of the logarithm of a median's ratio, over that of a root mean square's.
INEFFICIENCY_OF_MEDIANS = 2.7
#: With fewer degrees of freedom, rotations and translations each, any reading may fit by chance.
FEWEST_DEGREES_OF_FREEDOM = 9
#: Two readings fit alike when their products of residuals differ by less than this factor.
ALIKE = 1.5
#: Smaller rotation residuals (rad) are the same to this test: no sensor is better.
SMALLEST_RAD = 2e-4
#: Smaller translation residuals, as a share of what B varies by, are the same too.
SMALLEST_SHARE = 2e-4
#: Rows are shifted by up to so many.
MOST_SHIFTED = 5


@dataclass(frozen=True)
class Misreading:
    """A likely mistake in reading the poses; ``str()`` is one sentence with both residuals and the cure.

    Attributes
    ----------
    mistake : Mistake
    likely, cure : str
        What was likely misread, and what to do.
    rotation_deg, translation_mm : (float, float)
        The median residuals as read, and if read otherwise.
    """

    mistake: Mistake
    likely: str
    cure: str
    rotation_deg: tuple[float, float]
    translation_mm: tuple[float, float]

    def __str__(self) -> str:
        before, after = (
            f"{deg:.3g} deg and {mm:.3g} mm" for deg, mm in zip(self.rotation_deg, self.translation_mm, strict=True)
        )
        return f"{self.likely}: the median residual is {before} as read, and {after} otherwise; {self.cure}"


@one_blas_thread()
def misreadings(
    problem: Problem, solution: Solution | None, *, progress: Progress | None = None
) -> tuple[Misreading, ...]:
    """Find likely mistakes in the reading of A and B.

    Parameters
    ----------
    problem : Problem
    solution : Solution or None
        The problem's solution; None where it has none (a scale that is not positive).
    progress : callable, optional
        Is called with what is tried.

    Returns
    -------
    tuple of Misreading
        Empty where residuals are plainly those of a sensor, where no other reading fits far better, and where the
        problem did not keep its measurements. Two or more readings fit alike: data cannot tell which mistake it was.
    """
    check_progress(progress)
    sampled = Sampled.of(problem)
    if sampled is None or _degrees_of_freedom(sampled) < FEWEST_DEGREES_OF_FREEDOM:
        return ()
    sample = sampled.as_read()
    signal = signal_of(sample)
    given = residual_of(problem, solution) if solution is not None else None
    if given is not None and is_plain(given, signal):
        return ()
    (progress or silent)("trying other readings of the poses")
    base = fitted(problem, sample)
    known = [spread for spread in (given, base.residual if base else None) if spread is not None]
    if not known:
        known = [signal]
    before = min(known, key=lambda spread: _log_volume(spread, signal))
    if is_plain(before, signal):
        return ()
    trial = _Trial(problem, sampled, signal, before)
    return trial.found([*SINGLE, *map(shifted, _shifts())]) or trial.found(DOUBLE)


def is_plain(residual: Spread, signal: Spread) -> bool:
    """Whether residuals are plainly those of a sensor: small beside what B varies by."""
    return (
        residual.rotation_rad < PLAIN_SHARE * signal.rotation_rad
        and residual.translation_m < PLAIN_SHARE * signal.translation_m
    )


def _shifts() -> list[int]:
    return [sign * n for n in range(1, MOST_SHIFTED + 1) for sign in (1, -1)]


def _degrees_of_freedom(sampled: Sampled) -> int:
    """Of the rotations alone, and of the translations alone."""
    return 3 * (sampled.count - sampled.unknown_poses)


def _floored(spread: Spread, signal: Spread) -> Spread:
    return Spread(
        max(spread.rotation_rad, SMALLEST_RAD), max(spread.translation_m, SMALLEST_SHARE * signal.translation_m, 1e-12)
    )


def _log_volume(spread: Spread, signal: Spread) -> float:
    floored = _floored(spread, signal)
    return math.log(floored.rotation_rad) + math.log(floored.translation_m)


@dataclass(frozen=True)
class _Trial:
    """What other readings are compared with."""

    problem: Problem
    sampled: Sampled
    signal: Spread
    before: Spread

    @property
    def needed(self) -> float:
        """The logarithm of the least product of ratios that is not chance."""
        variance = 2.0 * INEFFICIENCY_OF_MEDIANS / _degrees_of_freedom(self.sampled)
        return math.log(FAR_BETTER) + SIGMAS * math.sqrt(variance)

    def found(self, readings: Iterable[Reading]) -> tuple[Misreading, ...]:
        """The readings that fit best, if they fit far better than the given one."""
        gains: list[tuple[float, Misreading]] = []
        for reading in readings:
            fit = fitted(self.problem, self.sampled.by(reading), to_beat=self.before)
            if fit is not None and (gain := self.gain(fit)) > self.needed:
                gains.append((gain, self.named(reading, fit)))
        most = max((gain for gain, _ in gains), default=0.0)
        return tuple(misreading for gain, misreading in gains if gain > most - math.log(ALIKE))

    def gain(self, fit: TrialFit) -> float:
        """The logarithm of the product of both residuals' ratios; 0 where the reading does not explain its gain."""
        before, after = _floored(self.before, self.signal), _floored(fit.residual, self.signal)
        ratios = (before.rotation_rad / after.rotation_rad, before.translation_m / after.translation_m)
        shares = (
            after.rotation_rad / max(self.signal.rotation_rad, SMALLEST_RAD),
            after.translation_m / max(self.signal.translation_m, 1e-12),
        )
        for ratio, share in zip(ratios, shares, strict=True):
            if ratio < 1.0 / NOT_WORSE or (ratio > NOT_WORSE and share > EXPLAINED):
                return 0.0
        return float(np.sum(np.log(ratios)))

    def named(self, reading: Reading, fit: TrialFit) -> Misreading:
        """The record of a reading that fits."""
        return Misreading(
            reading.mistake,
            reading.likely,
            reading.cure,
            (math.degrees(self.before.rotation_rad), math.degrees(fit.residual.rotation_rad)),
            (1e3 * self.before.translation_m, 1e3 * fit.residual.translation_m),
        )
