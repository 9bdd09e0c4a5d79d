"""Tables 2-5 of the RWHEC paper, rows "Ours": our mean errors against the paper's.

    python tests/benchmarks/tables_2_to_5.py --runs 1000

Simulates the paper's 16 experiments with the noise that it was really run with (``--model stated`` for the noise of its
text), solves each run with ``gtsam_rwhec.solve`` and compares mean errors in combined standard errors. The bar: every
mean within four of them, every run certified, that is proven optimal (a column of its own) and unique. Exits with 1 if
one is missed.

Conventions. The errors of X in Tables 4 and 5 are of all four cameras pooled: of the two possible standard deviations
(of all errors, or of each run's mean over the cameras) only the first has the paper's size. The four errors of a run
are not independent, so the standard error of a mean is taken from the runs' means (ours), and from the paper's
standard deviation times the ratio of our two, over the root of its 100 runs (the paper's).
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import sys
import time
import warnings
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

import gtsam_rwhec as rw
from gtsam_rwhec.certify.options import Method
from gtsam_rwhec.simulate import Noise, cameras, sphere
from gtsam_rwhec.simulate.noise import NoiseModel

PAPER_RUNS = 100
BAR = 4.0
CHUNK = 25
COLUMNS = ("t_x, mm", "r_x, deg", "t_y, mm", "r_y, deg", "scale")


@dataclass(frozen=True)
class Experiment:
    """One cell block of a table: four or five errors, (mean, standard deviation) of the paper's row "Ours"."""

    table: int
    kappa: float
    sigma_m: float
    paper: tuple[tuple[float, float], ...]


EXPERIMENTS = (
    Experiment(2, 125, 0.01, ((10.9, 5.6), (0.77, 0.36), (3.71, 2.13), (0.62, 0.36))),
    Experiment(2, 125, 0.05, ((28.4, 13.0), (1.42, 0.63), (18.5, 8.7), (1.36, 0.61))),
    Experiment(2, 12, 0.01, ((15.1, 10.0), (1.81, 0.83), (3.4, 1.8), (0.87, 0.59))),
    Experiment(2, 12, 0.05, ((47.7, 27.0), (3.12, 1.67), (18.8, 9.02), (2.68, 1.65))),
    Experiment(3, 125, 0.01, ((4.71, 2.43), (0.51, 0.22), (3.82, 1.91), (0.250, 0.113), (1.76e-3, 1.54e-3))),
    Experiment(3, 125, 0.05, ((23.8, 11.3), (1.11, 0.53), (19.0, 11.4), (1.06, 0.52), (8.41e-3, 7.02e-3))),
    Experiment(3, 12, 0.01, ((4.50, 1.99), (1.54, 0.57), (3.77, 1.88), (0.206, 0.098), (1.87e-3, 1.37e-3))),
    Experiment(3, 12, 0.05, ((24.4, 14.3), (1.99, 0.81), (19.6, 11.0), (1.25, 0.58), (9.16e-3, 7.69e-3))),
    Experiment(4, 125, 0.01, ((0.992, 0.416), (0.454, 0.189), (0.570, 0.294), (0.021, 0.010))),
    Experiment(4, 125, 0.05, ((4.56, 1.96), (0.459, 0.191), (2.69, 1.32), (0.111, 0.051))),
    Experiment(4, 12, 0.01, ((0.933, 0.370), (1.50, 0.62), (0.537, 0.262), (0.021, 0.010))),
    Experiment(4, 12, 0.05, ((4.57, 1.97), (1.48, 0.67), (2.92, 1.32), (0.103, 0.046))),
    Experiment(5, 125, 0.01, ((1.05, 0.45), (0.468, 0.185), (0.597, 0.256), (0.026, 0.012), (2.71e-4, 1.98e-4))),
    Experiment(5, 125, 0.05, ((5.21, 2.18), (0.454, 0.194), (3.03, 1.24), (0.159, 0.071), (1.37e-3, 1.03e-3))),
    Experiment(5, 12, 0.01, ((1.02, 0.44), (1.46, 0.61), (0.530, 0.284), (0.021, 0.010), (2.57e-4, 2.02e-4))),
    Experiment(5, 12, 0.05, ((5.18, 2.26), (1.44, 0.626), (3.02, 1.51), (0.144, 0.069), (1.18e-3, 8.62e-4))),
)


@dataclass(frozen=True)
class Runs:
    """Errors of some runs: (runs, frames, 2) for X and Y, in mm and degrees; (runs,) for the rest."""

    X: NDArray[np.float64]
    Y: NDArray[np.float64]
    scale: NDArray[np.float64]
    optimal: NDArray[np.bool_]
    certified: NDArray[np.bool_]


def solve_runs(experiment: Experiment, seeds: list[np.random.SeedSequence], model: NoiseModel, method: Method) -> Runs:
    """Simulate and solve one run for each seed."""
    noise = Noise(experiment.sigma_m, experiment.kappa, model)
    simulate = sphere if experiment.table in (2, 3) else cameras
    X, Y, scale, optimal, certified = [], [], [], [], []
    for seed in seeds:
        simulation = simulate(
            noise, np.random.default_rng(seed), monocular=experiment.table in (3, 5), keep_measurements=False
        )
        with warnings.catch_warnings():
            # What is not certified is counted below and fails the benchmark.
            warnings.simplefilter("ignore", rw.errors.RwhecWarning)
            solution = rw.solve(simulation.problem, method=method)
        errors = simulation.errors(solution)
        X.append([(e.translation_mm, e.rotation_deg) for e in errors.X.values()])
        Y.append([(e.translation_mm, e.rotation_deg) for e in errors.Y.values()])
        scale.append(errors.relative_scale)
        optimal.append(solution.certificate.is_optimal)
        certified.append(solution.certificate.is_certified)
    return Runs(np.array(X), np.array(Y), np.array(scale, dtype=np.float64), np.array(optimal), np.array(certified))


def joined(parts: list[Runs]) -> Runs:
    """All runs of one experiment."""
    return Runs(
        np.concatenate([p.X for p in parts]),
        np.concatenate([p.Y for p in parts]),
        np.concatenate([p.scale for p in parts]),
        np.concatenate([p.optimal for p in parts]),
        np.concatenate([p.certified for p in parts]),
    )


@dataclass(frozen=True)
class Comparison:
    """One number of the tables: ours, the paper's, and their difference in combined standard errors."""

    ours: float
    ours_std: float
    paper: float
    paper_std: float
    difference: float


def compare(errors: NDArray[np.float64], paper: tuple[float, float]) -> Comparison:
    """Compare (runs, frames) errors with the paper's mean and standard deviation over runs and frames."""
    of_runs = errors.mean(axis=1)
    pooled_std = float(errors.std(ddof=1))
    run_std = float(of_runs.std(ddof=1))
    paper_mean, paper_std = paper
    paper_error = paper_std * run_std / pooled_std / math.sqrt(PAPER_RUNS)
    our_error = run_std / math.sqrt(len(errors))
    difference = (float(errors.mean()) - paper_mean) / math.hypot(paper_error, our_error)
    return Comparison(float(errors.mean()), pooled_std, paper_mean, paper_std, difference)


def comparisons(experiment: Experiment, runs: Runs) -> list[Comparison]:
    """Every number of one experiment."""
    errors = [runs.X[:, :, 0], runs.X[:, :, 1], runs.Y[:, :, 0], runs.Y[:, :, 1], runs.scale[:, None]]
    return [compare(ours, paper) for ours, paper in zip(errors, experiment.paper, strict=False)]


def cell_of(mean: float, std: float) -> str:
    """Mean and standard deviation to three digits of the mean, aligned; scales as the paper writes them."""
    if mean < 0.015:
        return f"{mean:.2e} +- {std:.2e}"
    decimals = max(0, 2 - math.floor(math.log10(mean)))
    return f"{mean:.{decimals}f} +- {std:{4 + (decimals > 2)}.{decimals}f}"


def print_table(console: Console, results: list[tuple[Experiment, Runs]]) -> tuple[float, int]:
    """Print all comparisons; the largest difference and the number of runs that are not certified."""
    table = Table(title='Tables 2-5, "Ours": mean +- standard deviation, and difference in combined standard errors')
    for header in ("table", "kappa", "sigma, cm", "error", "ours", "paper", "diff.", "optimal", "certified"):
        table.add_column(header, justify="left" if header == "error" else "right", no_wrap=True)
    worst, failures = 0.0, 0
    for experiment, runs in results:
        failures += int(np.sum(~runs.certified))
        for row, (column, cell) in enumerate(zip(COLUMNS, comparisons(experiment, runs), strict=False)):
            worst = max(worst, abs(cell.difference))
            first = row == 0
            colour = "green" if abs(cell.difference) <= BAR else "red"
            table.add_row(
                f"{experiment.table}" if first else "",
                f"{experiment.kappa:g}" if first else "",
                f"{100.0 * experiment.sigma_m:g}" if first else "",
                column,
                cell_of(cell.ours, cell.ours_std),
                cell_of(cell.paper, cell.paper_std),
                f"[{colour}]{cell.difference:+.2f}[/{colour}]",
                f"{np.mean(runs.optimal):.1%}" if first else "",
                f"{np.mean(runs.certified):.1%}" if first else "",
            )
        table.add_section()
    console.print(table)
    return worst, failures


def main() -> int:
    """Run the benchmark; 0 if both bars are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000, help="runs of each experiment (default: 1000)")
    parser.add_argument("--tables", type=int, nargs="+", choices=(2, 3, 4, 5), default=(2, 3, 4, 5))
    parser.add_argument("--model", choices=("released", "stated"), default="released", help="noise model")
    parser.add_argument("--method", choices=("auto", "sdp"), default="auto", help="method of gtsam_rwhec.solve")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    arguments = parser.parse_args()

    if arguments.runs < 2:
        parser.error(f"--runs is {arguments.runs}; a standard deviation needs at least 2")
    experiments = [experiment for experiment in EXPERIMENTS if experiment.table in arguments.tables]
    # Seeds by place in EXPERIMENTS, so that leaving tables out changes nothing in the others.
    seeds = dict(zip(EXPERIMENTS, np.random.SeedSequence(arguments.seed).spawn(len(EXPERIMENTS)), strict=True))
    parts: dict[Experiment, list[tuple[int, Runs]]] = {experiment: [] for experiment in experiments}
    console = Console()
    if not console.is_terminal:  # in a pipe the width is unknown; nothing of the table may be cut
        console = Console(width=120)
    # Many small problems: one thread in each worker is fastest. Spawned, so that NumPy there sees the variables.
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    begin = time.perf_counter()
    columns = (TextColumn("solving"), BarColumn(), MofNCompleteColumn(), TextColumn("runs"), TimeRemainingColumn())
    with (
        ProcessPoolExecutor(arguments.workers, multiprocessing.get_context("spawn")) as pool,
        Progress(*columns, console=Console(stderr=True)) as progress,
    ):
        task = progress.add_task("solving", total=arguments.runs * len(experiments))
        waiting = {}
        for experiment in experiments:
            of_runs = seeds[experiment].spawn(arguments.runs)
            for first in range(0, arguments.runs, CHUNK):
                chunk = of_runs[first : first + CHUNK]
                future = pool.submit(solve_runs, experiment, chunk, arguments.model, arguments.method)
                waiting[future] = (experiment, first)
        try:
            for future in as_completed(waiting):
                experiment, first = waiting[future]
                runs = future.result()
                parts[experiment].append((first, runs))
                progress.advance(task, len(runs.certified))
        finally:
            pool.shutdown(cancel_futures=True)  # an error is shown now, not after all other runs

    results = [(e, joined([runs for _, runs in sorted(parts[e], key=lambda part: part[0])])) for e in experiments]
    worst, failures = print_table(console, results)
    total = arguments.runs * len(experiments)
    console.print(
        f"{total} runs ({arguments.model} noise, method {arguments.method}, seed {arguments.seed}) "
        f"in {time.perf_counter() - begin:.0f} s. Largest difference {worst:.2f} combined standard errors "
        f"(bar {BAR:g}); {failures} runs not certified (bar 0)."
    )
    return int(worst > BAR or failures > 0)


if __name__ == "__main__":
    sys.exit(main())
