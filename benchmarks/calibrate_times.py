"""The time of `rw.calibrate`, as installed: the first call of a process, and the next ones.

    python benchmarks/calibrate_times.py [--runs 5]

Thirty stations of an arm with a camera, a stream of 200 keyframes, and a dense log of 1,700 frames (`dense_logs.py`),
each in a process of its own. Exits with 1 if a bar is missed.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass

import dense_logs
import numpy as np
from bars import Row, alone, at_most, run_script

import gtsam_rwhec as rw
from gtsam_rwhec.errors import RwhecWarning

MOST_MORE_S = 2.0


@dataclass(frozen=True)
class Case:
    """Frames recorded, every so many of them kept, and the most that a second call may take, seconds."""

    recorded: int
    every: int
    bar_s: float


CASES = {
    "30 stations": Case(3000, 100, 0.3),
    "a stream of 200 keyframes": Case(2000, 10, 1.5),
    "a dense log of 1,700 frames": Case(1700, 1, 5.0),
}


def seconds_of_calls(case: Case, calls: int) -> list[float]:
    """How long each of some calls took, each of another problem (the first log's noise must not decide)."""
    found = []
    for number in range(calls):
        log = dense_logs.simulate(case.recorded, np.random.default_rng(number))
        problem = log.problem(slice(0, None, case.every))
        begin = time.perf_counter()
        with warnings.catch_warnings(action="ignore", category=RwhecWarning):
            rw.calibrate(problem)
        found.append(time.perf_counter() - begin)
    return found


def rows(runs: int) -> list[Row]:
    """The times against the bars: of the calls after the first, the median."""
    result = []
    for name, case in CASES.items():
        first, *later = alone(seconds_of_calls, case, runs + 1)
        second = float(np.median(later))
        most = f" (most {max(later):.2f} s of {len(later)})"
        result.append(at_most(f"rw.calibrate, {name}: a call after the first", second, case.bar_s, " s", ".2f", most))
        result.append(at_most("    the first takes longer by", first - second, MOST_MORE_S, " s", ".2f"))
    return result


if __name__ == "__main__":
    run_script("Time of rw.calibrate", rows, runs=5)
