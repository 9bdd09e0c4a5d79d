"""The time of `rw.calibrate`, as installed: the first call of a process, and the next ones.

    python benchmarks/calibrate_times.py [--runs 5]

Thirty stations of an arm with a camera, a stream of 200 keyframes, and a dense log of 1,700 frames (`dense_logs.py`),
each in a process of its own. Exits with 1 if a bar is missed.
"""

from __future__ import annotations

import multiprocessing
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import dense_logs
import numpy as np
from bars import Row, benchmark_parser, print_rows

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
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RwhecWarning)
            rw.calibrate(problem)
        found.append(time.perf_counter() - begin)
    return found


def rows(runs: int) -> list[Row]:
    """The times against the bars: of the calls after the first, the median."""
    result = []
    for name, case in CASES.items():
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            first, *later = pool.submit(seconds_of_calls, case, runs + 1).result()
        second = float(np.median(later))
        result.append(
            Row(
                f"rw.calibrate, {name}: a call after the first",
                f"{second:.2f} s (most {max(later):.2f} s of {len(later)})",
                f"<= {case.bar_s:g} s",
                second <= case.bar_s,
            )
        )
        more = first - second
        result.append(
            Row("    the first takes longer by", f"{more:.2f} s", f"<= {MOST_MORE_S:g} s", more <= MOST_MORE_S)
        )
    return result


def main() -> int:
    """Run it; 0 if the bars are met."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--runs", type=int, default=5, help="calls after the first (default: 5)")
    arguments = parser.parse_args()
    return print_rows("Time of rw.calibrate", rows(arguments.runs))


if __name__ == "__main__":
    raise SystemExit(main())
