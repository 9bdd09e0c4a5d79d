"""``solve`` as installed, with another busy process on each core, against one BLAS thread under the same load.

    python benchmarks/busy_cores.py [--repetitions 15] [--store]

Two processes solve in turns: one has the environment that a user has, the other one thread in every library. While they
do so, as many other processes as there are cores are busy. The last rows are the same without the busy processes.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
from bars import Row, benchmark_parser, print_rows
from dataset import utias_folder
from interleaved import Times, in_words, interleaved

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver.solve_options import Method

HERE = Path(__file__).resolve()
#: As installed, to one thread.
BAR = 1.5
VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
#: What is solved, by name: the problem, and the method of ``solve``.
CASES: dict[str, tuple[str, Method]] = {
    "18 frames, 510 measurements, a fifth of them wrong": ("outliers", "auto"),
    "the real dataset, auto": ("utias", "auto"),
    "the real dataset, sdp": ("utias", "sdp"),
}


def outliers_problem() -> rw.Problem:
    """9 targets and 9 sensors, 510 measurements in all; of a fifth, B belongs to another measurement of the pair."""
    noise, rng = Noise(sigma_m=0.003, kappa=20_000.0), np.random.default_rng(0)
    clean = general(9, 9, seed=0, number_of_measurements=7, noise=noise).problem
    kept = np.sort(rng.permutation(clean.number_of_measurements)[:510])
    problem = rw.Problem()
    for first, pair in zip(range(0, clean.number_of_measurements, 7), clean.pairs, strict=True):
        measured, rows = clean.measurements(*pair), kept[(kept >= first) & (kept < first + 7)] - first
        A, B = measured.A[rows], measured.B[rows].copy()
        wrong = rng.random(len(B)) < 0.2
        B[wrong] = measured.B[rng.integers(7, size=wrong.sum())]
        if len(B):
            problem.add(*pair, A, B, noise.sigma_m, noise.kappa)
    return problem


def child(name: str, method: Method) -> None:
    """Solve once for every line of the standard input, and answer each with a line."""
    problem = outliers_problem() if name == "outliers" else rw.read_csv(utias_folder(), sigma=1.0, kappa=1.0)
    warnings.simplefilter("ignore")
    print("ready", flush=True)
    for _ in sys.stdin:
        rw.solve(problem, method=method)
        print("solved", flush=True)


class Solver:
    """A process that solves one case on demand."""

    def __init__(self, case: str, *, one_thread: bool) -> None:
        environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
        if one_thread:
            environment |= dict.fromkeys(VARIABLES, "1")
        self.process = subprocess.Popen(
            [sys.executable, str(HERE), "--child", *CASES[case]],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._answered("ready")

    def _answered(self, expected: str) -> None:
        assert self.process.stdout is not None
        line = self.process.stdout.readline().strip()
        if line != expected:
            raise SystemExit(f"a process that solves said {line!r}, not {expected!r}")

    def __call__(self) -> None:
        """Solve once."""
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        self._answered("solved")

    def __enter__(self) -> Solver:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.communicate()


@contextmanager
def busy(count: int) -> Iterator[None]:
    """This number of processes that do nothing but use a core each."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        time.sleep(0.2)
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def measured(case: str, repetitions: int, processes: int) -> Times:
    """The times of both environments, in turns."""
    with ExitStack() as stack:
        calls = {
            "as installed": stack.enter_context(Solver(case, one_thread=False)),
            "one thread": stack.enter_context(Solver(case, one_thread=True)),
        }
        stack.enter_context(busy(processes))
        return interleaved(repetitions, calls)


def rows(repetitions: int) -> list[Row]:
    """A row with a bar for each case with busy cores, and one without a bar for each on what is free of the machine."""
    cores = os.cpu_count() or 1
    result = []
    for processes, where in ((cores, f"{cores} busy processes on {cores} cores"), (0, "no busy process")):
        for case in CASES:
            times = measured(case, repetitions, processes)
            ratio = times.median("as installed") / times.median("one thread")
            figure = f"{ratio:.2f}x ({in_words(times.median('as installed'))}; "
            figure += f"one thread {in_words(times.median('one thread'))})"
            name = f"{case}: as installed over one thread, {where}"
            result.append(Row(name, figure, f"<= {BAR:g}x", ratio <= BAR) if processes else Row(name, figure))
    return result


def main() -> int:
    """Print the table."""
    if sys.argv[1:2] == ["--child"]:
        child(*sys.argv[2:4])
        return 0
    parser = benchmark_parser(__doc__)
    parser.add_argument("--repetitions", type=int, default=15, help="solves of each case in each environment")
    given = parser.parse_args()
    return print_rows("Solving beside busy cores", rows(given.repetitions), store=given.store)


if __name__ == "__main__":
    raise SystemExit(main())
