"""Clocks that run at another rate than the carriers': whose rate is unknown, and what was found of it.

A sensor's stamp t is the carriers' t + offset + rate (t - t_mean). The residual's derivative by the rate is that by the
offset times t - t_mean. A rate has a prior of quartz clocks, so that it takes nothing from logs that are short or slow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.files.terminal_text import rounded
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.unknowns import State, Unknown, UnknownKind
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.problem.problem import Problem

#: Before the data a rate has this standard deviation: clocks are off by 10 to 100 parts in a million, stamps that a
#: driver makes of a frame rate by a few hundred.
RATE = 2e-4
#: Of fewer stamps no rate is estimated.
FEWEST_STAMPS = 100
#: A rate of more standard deviations than this is named.
SURELY = 4.0


@dataclass(frozen=True)
class ClockRate:
    """By how much a sensor's clock is too slow (negative: too fast), and the standard deviation; ``str()`` says it."""

    sensor: str
    rate: float
    deviation: float

    @property
    def is_sure(self) -> bool:
        """Whether it is clearly not zero."""
        return abs(self.rate) > SURELY * self.deviation

    def __str__(self) -> str:
        how = "slow" if self.rate > 0.0 else "fast"
        ppm, deviation = rounded(1e6 * abs(self.rate)), rounded(1e6 * self.deviation)
        return f"The clock of {self.sensor} runs {ppm} +- {deviation} parts in a million too {how}"


def clocks_with_rate(problem: Problem, sensors: tuple[str, ...], path: Trajectory | None) -> dict[str, int]:
    """Of sensors with a time offset along a path, those with enough stamps for a rate; and their mean stamp, ns."""
    found = {}
    for name in sensors if path is not None else ():
        of_pairs = [problem.measurements(*pair).stamps_ns for pair in problem.pairs if pair.sensor == name]
        stamps = np.unique(np.concatenate([own for own in of_pairs if own is not None]))
        if len(stamps) >= FEWEST_STAMPS:
            found[name] = int(stamps[0] + (stamps - stamps[0]).mean())
    return found


def rates_found(joint: JointCovariance, state: State) -> dict[Unknown, ClockRate]:
    """What is known of each rate, from the covariance of all unknowns."""
    found = {}
    for name, rate in state.rates.items():
        unknown = Unknown(UnknownKind.CLOCK_RATE, name)
        place = joint.slots[unknown]
        found[unknown] = ClockRate(name, rate, math.sqrt(float(joint.finite[place, place][0, 0])))
    return found
