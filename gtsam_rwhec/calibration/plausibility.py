"""Whether residuals can be those of a sensor at all, whatever the weights say."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from gtsam_rwhec.calibration.samples import Sampled
from gtsam_rwhec.calibration.trial_fits import Spread, fitted, median_distance, residual_of, signal_of
from gtsam_rwhec.files.rounded_numbers import rounded
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solving.solution import Solution

#: No camera, lidar or motion capture turns a target by this much (degrees) in half of its measurements.
LARGEST_DEG = 25.0
#: From this much (degrees) on, a residual that is most of what B varies by is no noise either.
LARGE_DEG = 12.0
#: "Most of what B varies by": the calibration then explains next to nothing.
UNEXPLAINED = 0.6
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
    """Residuals that no sensor has; ``str()`` is one sentence.

    Attributes
    ----------
    why : Unlikely
    rotation_deg, translation_mm : float
        The median residuals; root mean squares where measurements were not kept.
    varies_deg, varies_mm : float
        What B varies by within its pairs, medians; nan where measurements were not kept.
    """

    why: Unlikely
    rotation_deg: float
    translation_mm: float
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

    ``calibrate`` asks again of the measurements that agree: wrong ones may pull the fit of all of them to these.

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
    reasons = [_why(spread, signal, median_distance(sample)) for spread in found]
    if not found or None in reasons:
        return None
    why, best = min(zip(reasons, found, strict=True), key=lambda each: each[1].rotation_rad * each[1].translation_m)
    assert why is not None
    return _record(why, best, signal)


def _why(residual: Spread, signal: Spread, distance_m: float) -> Unlikely | None:
    degrees = math.degrees(residual.rotation_rad)
    if degrees > LARGEST_DEG:
        return Unlikely.ROTATION
    if degrees > LARGE_DEG and residual.rotation_rad > UNEXPLAINED * signal.rotation_rad:
        return Unlikely.ROTATION_UNEXPLAINED
    if (
        residual.translation_m > UNEXPLAINED * signal.translation_m
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
