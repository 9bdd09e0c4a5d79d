"""Measurements that look wrong where every measurement counts: gross errors beside a robust fit.

Least squares of all measurements hides them: its residuals are all large. So a robust fit of a sample is asked how far
each measurement is from its prediction, in medians of its own pair, after the ratios of the noise that was stated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.calibration.samples import Sampled
from gtsam_rwhec.calibration.trial_fits import fitted
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.problem import Problem

#: An error of so many medians is gross. Of Gaussian errors none is; of Student's t one in 4,000 with 5 degrees of
#: freedom, one in 300 with 3.
GROSS = 8.0
#: A pair with fewer rows has no median of its own; that of all pairs counts.
FEWEST_ROWS = 10
#: At most so many pairs and measurements are looked at.
MOST_PAIRS, MOST_MEASUREMENTS = 200, 10_000
#: With fewer measurements in all, one cannot be told from the others.
FEWEST_MEASUREMENTS = 8


@dataclass(frozen=True)
class GrossErrors:
    """How many of the measurements that were looked at look wrong; ``str()`` is a sentence's part.

    Attributes
    ----------
    number, looked_at, in_all : int
        Measurements that look wrong, those that were looked at, and those of the problem: of large problems a sample is
        looked at, and pairs with a few measurements are left out.
    """

    number: int
    looked_at: int
    in_all: int

    def __str__(self) -> str:
        look = "looks" if self.number == 1 else "look"
        rest = self.in_all - self.looked_at
        others = f"; {rest} more {'was' if rest == 1 else 'were'} not looked at" if rest else ""
        return (
            f"{self.number} of {self.looked_at} measurements {look} wrong (off by more than {GROSS:g} times what half "
            f"of the others are off by{others}), and still every measurement counts"
        )


def gross_errors(problem: Problem) -> GrossErrors | None:
    """Measurements of a problem, or of a sample of it, that look wrong; None where none does, or none can be told."""
    sampled = Sampled.of(problem, MOST_PAIRS, MOST_MEASUREMENTS)
    if sampled is None or sampled.count < FEWEST_MEASUREMENTS:
        return None
    fit = fitted(problem, sampled.as_read())
    if fit is None:
        return None
    ends = np.cumsum([len(rows) for rows in sampled.rows.values()])[:-1]
    errors = fit.errors / _stated(sampled)
    medians = np.median(errors, axis=1, keepdims=True)
    ratios = [_in_medians(of_pair, medians) for of_pair in np.split(errors, ends, axis=1)]
    number = int((np.concatenate(ratios) > GROSS).sum())
    return GrossErrors(number, sampled.count, problem.number_of_measurements) if number else None


def _stated(sampled: Sampled) -> Array:
    """The noise that was stated for each measurement (2, N), rad and m: only its ratios count."""
    rows = [(sampled.whole[pair], chosen) for pair, chosen in sampled.rows.items()]
    rotation = np.concatenate([np.sqrt(0.5 / raw.kappa[chosen]) for raw, chosen in rows])
    return np.stack([rotation, np.concatenate([raw.sigma[chosen] for raw, chosen in rows])])


def _in_medians(errors: Array, medians: Array) -> Array:
    """The larger of both errors (2, N) of each measurement (N,), in medians of the pair, or of all pairs."""
    own = np.median(errors, axis=1, keepdims=True) if errors.shape[1] >= FEWEST_ROWS else medians
    return np.asarray((errors / np.maximum(np.maximum(own, medians), 1e-12)).max(axis=0))
