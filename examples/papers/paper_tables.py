"""What the benchmarks of the RWHEC paper's Tables 2-5 share: its experiments, runs in parallel, the comparison.

Conventions. The errors of X in Tables 4 and 5 are of all four cameras pooled: of the two possible standard deviations
(of all errors, or of each run's mean over the cameras) only the first has the paper's size. The four errors of a run
are not independent, so the standard error of a mean is taken from the runs' means (ours), and from the paper's
standard deviation times the ratio of our two, over the root of its 100 runs (the paper's).
"""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from gtsam_rwhec.simulate import CalibrationErrors, Noise, Simulation, cameras, sphere
from gtsam_rwhec.simulate.simulated_noise import NoiseModel

PAPER_RUNS = 100
BAR = 4.0
CHUNK = 25
COLUMNS = ("t_x, mm", "r_x, deg", "t_y, mm", "r_y, deg", "scale")


@dataclass(frozen=True)
class Experiment:
    """One row of a table: four or five errors, (mean, standard deviation)."""

    table: int
    kappa: float
    sigma_m: float
    paper: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Runs:
    """Errors of some runs: (runs, frames, 2) for X and Y, in mm and degrees; (runs,) for the rest, flags by name."""

    X: NDArray[np.float64]
    Y: NDArray[np.float64]
    scale: NDArray[np.float64]
    flags: dict[str, NDArray[np.bool_]]

    @staticmethod
    def of(errors: list[CalibrationErrors], flags: dict[str, list[bool]]) -> Runs:
        """Of each run's errors."""
        return Runs(
            X=np.array([[(e.translation_mm, e.rotation_deg) for e in run.X.values()] for run in errors]),
            Y=np.array([[(e.translation_mm, e.rotation_deg) for e in run.Y.values()] for run in errors]),
            scale=np.array([run.relative_scale for run in errors], dtype=np.float64),
            flags={name: np.array(values) for name, values in flags.items()},
        )

    @staticmethod
    def joined(parts: list[Runs]) -> Runs:
        """All runs of one experiment."""
        return Runs(
            np.concatenate([p.X for p in parts]),
            np.concatenate([p.Y for p in parts]),
            np.concatenate([p.scale for p in parts]),
            {name: np.concatenate([p.flags[name] for p in parts]) for name in parts[0].flags},
        )


def simulated(experiment: Experiment, model: NoiseModel, seed: np.random.SeedSequence, *, keep: bool) -> Simulation:
    """One run's simulation; ``keep``: with its raw measurements."""
    noise = Noise(experiment.sigma_m, experiment.kappa, model)
    simulate = sphere if experiment.table in (2, 3) else cameras
    generator = np.random.default_rng(seed)
    return simulate(noise, generator, monocular=experiment.table in (3, 5), keep_measurements=keep)


def in_parallel(
    solve: Callable[[Experiment, list[np.random.SeedSequence]], Runs],
    seeds: dict[Experiment, np.random.SeedSequence],
    runs: int,
    workers: int | None,
) -> list[tuple[Experiment, Runs]]:
    """Every experiment's runs, in order, whatever the number of worker processes; ``solve`` is pickled."""
    parts: dict[Experiment, list[tuple[int, Runs]]] = {experiment: [] for experiment in seeds}
    columns = (TextColumn("solving"), BarColumn(), MofNCompleteColumn(), TextColumn("runs"), TimeRemainingColumn())
    with (
        ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool,
        Progress(*columns, console=Console(stderr=True)) as progress,
    ):
        task = progress.add_task("solving", total=runs * len(seeds))
        waiting = {}
        for experiment, seed in seeds.items():
            of_runs = seed.spawn(runs)
            for first in range(0, runs, CHUNK):
                future = pool.submit(solve, experiment, of_runs[first : first + CHUNK])
                waiting[future] = (experiment, first)
        try:
            for future in as_completed(waiting):
                experiment, first = waiting[future]
                solved = future.result()
                parts[experiment].append((first, solved))
                progress.advance(task, len(solved.scale))
        finally:
            pool.shutdown(cancel_futures=True)  # an error is shown now, not after all other runs
    return [
        (experiment, Runs.joined([solved for _, solved in sorted(of_one, key=lambda part: part[0])]))
        for experiment, of_one in parts.items()
    ]


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


def wide_console(width: int) -> Console:
    """The terminal; in a pipe, whose width is unknown, so wide that nothing of the table is cut."""
    console = Console()
    return console if console.is_terminal else Console(width=width)


def largest_difference(results: list[tuple[Experiment, Runs]]) -> float:
    """Over every number, in combined standard errors."""
    return max((abs(cell.difference) for one in results for cell in comparisons(*one)), default=0.0)


def print_table(console: Console, title: str, results: list[tuple[Experiment, Runs]]) -> None:
    """Print all comparisons, flags as shares of the runs."""
    flags = list(results[0][1].flags)
    table = Table(title=f"{title}: mean +- standard deviation, and difference in combined standard errors")
    for header in ("table", "kappa", "sigma, cm", "error", "ours", "paper", "diff.", *flags):
        table.add_column(header, justify="left" if header == "error" else "right", no_wrap=True)
    for experiment, runs in results:
        for row, (column, cell) in enumerate(zip(COLUMNS, comparisons(experiment, runs), strict=False)):
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
                *[f"{np.mean(runs.flags[flag]):.1%}" if first else "" for flag in flags],
            )
        table.add_section()
    console.print(table)
