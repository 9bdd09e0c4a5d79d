"""Tables 2-5 of the RWHEC paper, rows "LOM": its local on-manifold method from close and from random starts.

    python examples/papers/lom_tables.py --runs 300

Close starts stand 10 cm and 10 degrees, at the most, from the truth, with a scale of 1; random ones have rotations
uniform on SO(3), translations uniform in [-1, 1]^3 and a scale of 1. In Tables 2 and 4 the paper starts LOM from Wang's
closed form; these rows start close here, too (no close start ended in a wrong minimum). The runs are those of
tables_2_to_5.py. Takes 20 minutes on two busy cores, most of it for random starts.

Some of the paper's rows are not what its text says. They are printed twice: as the text has them, without a bar, and as
they seem to have been run, which was found by trying. The bar for the latter, and for the close rows of Tables 2 and 3
as the text has them: every mean within four combined standard errors.

- Random, Tables 2, 3 and 5, not 4: the rotation errors are twice the angle. Table 2 (kappa 125, 5 cm) has the
  translation errors of the row below it and twice its rotation errors; and wrong minima are half turns, of which 66 %
  make a mean of 237 degrees and a deviation of 171 (the paper: 237 +- 163) if each counts as 360.
- Random: one pair of weights served all four noise levels of a table, not each its own. With their own, Table 3
  (kappa 125, 5 cm) has a wrong minimum in 1 % of our runs, and Table 2 in 10 to 50 %; the paper's four rows of Table 3
  have as many as one another, about 65 %, and its 400 runs of Table 2 none. Table 2 takes kappa sigma^2 of 0.4 or more
  for that, and its errors fit 0.3 to 1: unit weights, say, which the paper has in Section 9. Tables 3-5 take 0.0125
  (kappa 125, 1 cm) or less; what exactly, the numbers do not tell.
- Random, monocular: translations are divided by the scale, and a scale of -1/2 in place of 1/2, where nearly half of
  Table 3's runs end, is an error of 2.
- Close, Tables 4 and 5: r_y is that of a rotation weight of 2 to 3 kappa, not Appendix C's kappa: larger than that of
  row "Ours", where kappa's would make it smaller by up to a fifth. Here: 2 kappa, which belongs to kappa.
"""

from __future__ import annotations

import argparse
import functools
import math
import os
import sys
import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from paper_tables import BAR, Experiment, Runs, in_parallel, largest_difference, print_table, simulated, wide_console
from rwhec_factors.se3 import pose

from gtsam_rwhec.methods.iterative_methods import LomOptions, LomWeights, local_on_manifold
from gtsam_rwhec.simulate import Simulation
from gtsam_rwhec.simulate.simulated_noise import random_directions, random_poses, rotations_of_vectors

Start = Literal["close", "random"]
Reading = Literal["stated", "inferred"]

ALL = (2, 3, 4, 5)
CLOSE_M = 0.1
CLOSE_RAD = math.radians(10.0)
#: As inferred: the rows' weights by start and table, (sigma_R rad, sigma_t m) where one pair served all noise levels,
#: and by what the random rows multiply the angle.
FIRST_LEVEL = (125.0**-0.5, 0.01)
INFERRED_WEIGHTS: dict[tuple[Start, int], LomWeights | tuple[float, float]] = {
    ("close", 4): "matched",
    ("close", 5): "matched",
    ("random", 2): (1.0, 1.0),
    ("random", 3): FIRST_LEVEL,
    ("random", 4): FIRST_LEVEL,
    ("random", 5): FIRST_LEVEL,
}
INFERRED_ANGLES = {2: 2.0, 3: 2.0, 4: 1.0, 5: 2.0}
WRONG_DEG = 30.0

CLOSE = (
    Experiment(2, 125, 0.01, ((11.1, 5.82), (0.78, 0.37), (3.69, 2.12), (0.63, 0.38))),
    Experiment(2, 125, 0.05, ((28.5, 13.4), (1.45, 0.62), (18.5, 8.8), (1.39, 0.62))),
    Experiment(2, 12, 0.01, ((15.2, 10.0), (1.84, 0.84), (3.4, 1.8), (0.88, 0.59))),
    Experiment(2, 12, 0.05, ((48.3, 27.3), (3.18, 1.67), (18.7, 9.04), (2.72, 1.64))),
    Experiment(3, 125, 0.01, ((4.61, 2.39), (0.51, 0.21), (3.82, 1.93), (0.22, 0.12), (1.78e-3, 1.54e-3))),
    Experiment(3, 125, 0.05, ((23.0, 11.2), (0.94, 0.44), (19.1, 11.4), (0.85, 0.40), (8.45e-3, 7.03e-3))),
    Experiment(3, 12, 0.01, ((4.52, 1.97), (1.57, 0.59), (3.78, 1.89), (0.20, 0.10), (1.88e-3, 1.37e-3))),
    Experiment(3, 12, 0.05, ((23.2, 14.1), (1.90, 0.81), (20.0, 11.0), (1.07, 0.54), (9.24e-3, 7.69e-3))),
    Experiment(4, 125, 0.01, ((0.994, 0.416), (0.454, 0.190), (0.572, 0.296), (0.022, 0.010))),
    Experiment(4, 125, 0.05, ((4.57, 1.96), (0.460, 0.191), (2.74, 1.34), (0.120, 0.056))),
    Experiment(4, 12, 0.01, ((0.933, 0.370), (1.52, 0.64), (0.537, 0.262), (0.021, 0.010))),
    Experiment(4, 12, 0.05, ((4.57, 1.97), (1.51, 0.682), (2.93, 1.34), (0.104, 0.047))),
    Experiment(5, 125, 0.01, ((1.05, 0.45), (0.469, 0.185), (0.631, 0.249), (0.030, 0.013), (2.71e-4, 1.98e-4))),
    Experiment(5, 125, 0.05, ((5.25, 2.20), (0.457, 0.195), (3.15, 1.26), (0.179, 0.079), (1.37e-3, 1.03e-3))),
    Experiment(5, 12, 0.01, ((1.02, 0.44), (1.50, 0.62), (0.530, 0.284), (0.021, 0.010), (2.58e-4, 2.02e-4))),
    Experiment(5, 12, 0.05, ((5.20, 2.27), (1.48, 0.64), (3.13, 1.56), (0.156, 0.075), (1.18e-3, 8.63e-4))),
)
RANDOM = (
    Experiment(2, 125, 0.01, ((17.4, 8.98), (2.35, 1.05), (3.72, 2.11), (2.22, 1.05))),
    Experiment(2, 125, 0.05, ((28.5, 13.3), (2.88, 1.24), (18.5, 8.72), (2.77, 1.23))),
    Experiment(2, 12, 0.01, ((56.7, 33.5), (7.45, 3.70), (4.17, 1.99), (7.35, 3.79))),
    Experiment(2, 12, 0.05, ((63.1, 38.4), (8.35, 4.15), (19.2, 8.93), (7.85, 4.22))),
    Experiment(3, 125, 0.01, ((578, 579), (237, 163), (630, 637), (237, 164), (9.86e-1, 8.82e-1))),
    Experiment(3, 125, 0.05, ((522, 538), (227, 166), (559, 595), (227, 166), (9.53e-1, 8.98e-1))),
    Experiment(3, 12, 0.01, ((482, 540), (214, 170), (528, 601), (214, 171), (9.38e-1, 8.98e-1))),
    Experiment(3, 12, 0.05, ((606, 609), (234, 163), (659, 675), (234, 164), (9.27e-1, 8.77e-1))),
    Experiment(4, 125, 0.01, ((303, 841), (21.9, 58.2), (154, 418), (21.4, 58.1))),
    Experiment(4, 125, 0.05, ((457, 995), (32.7, 68.8), (233, 494), (32.1, 68.7))),
    Experiment(4, 12, 0.01, ((177, 658), (13.9, 45.2), (90.7, 330), (12.5, 45.8))),
    Experiment(4, 12, 0.05, ((331, 870), (24.5, 59.5), (168, 430), (23.2, 60.1))),
    Experiment(5, 125, 0.01, ((1.87e3, 2.18e3), (226, 172), (2.47e3, 2.53e3), (224, 170), (8.68e-1, 6.65e-1))),
    Experiment(5, 125, 0.05, ((1.74e3, 2.22e3), (195, 178), (2.23e3, 2.56e3), (192, 176), (7.39e-1, 6.81e-1))),
    Experiment(5, 12, 0.01, ((1.81e3, 2.13e3), (217, 172), (2.39e3, 2.46e3), (213, 173), (8.26e-1, 6.74e-1))),
    Experiment(5, 12, 0.05, ((2.04e3, 2.17e3), (242, 166), (2.60e3, 2.48e3), (238, 166), (9.22e-1, 6.46e-1))),
)


def starting_poses(simulation: Simulation, start: Start, generator: np.random.Generator) -> NDArray[np.float64]:
    """Start of each X and then of each Y, (frames, 4, 4)."""
    truth = np.array([*simulation.X.values(), *simulation.Y.values()])
    count = len(truth)
    if start == "random":
        return random_poses(count, 1.0, generator)
    turns = random_directions(count, generator) * generator.uniform(0.0, CLOSE_RAD, (count, 1))
    moves = random_directions(count, generator) * generator.uniform(0.0, CLOSE_M, (count, 1))
    return pose(truth[:, :3, :3] @ rotations_of_vectors(turns), truth[:, :3, 3] + moves)


def solve_runs(experiment: Experiment, seeds: list[np.random.SeedSequence], start: Start, reading: Reading) -> Runs:
    """Simulate one run for each seed, and start LOM."""
    options = LomOptions("paper" if reading == "stated" else INFERRED_WEIGHTS[start, experiment.table])
    errors, wrong, negative = [], [], []
    for seed in seeds:
        simulation = simulated(experiment, "released", seed, keep=True)
        poses = starting_poses(simulation, start, np.random.default_rng(seed.spawn(1)[0]))
        X = dict(zip(simulation.X, poses, strict=False))
        Y = dict(zip(simulation.Y, poses[len(X) :], strict=True))
        solution = local_on_manifold(simulation.problem, X, Y, 1.0, options)
        error = simulation.errors(solution)
        errors.append(error)
        wrong.append(max(e.rotation_deg for e in [*error.X.values(), *error.Y.values()]) > WRONG_DEG)
        negative.append(solution.scale < 0.0)
    runs = Runs.of(errors, {f"> {WRONG_DEG:g} deg": wrong, "scale < 0": negative})
    if start == "random" and reading == "inferred":
        runs.X[:, :, 1] *= INFERRED_ANGLES[experiment.table]
        runs.Y[:, :, 1] *= INFERRED_ANGLES[experiment.table]
    return runs


@dataclass(frozen=True)
class Part:
    """Rows of one start, read in one way; the tables shown, and those with a bar."""

    title: str
    rows: tuple[Experiment, ...]
    start: Start
    reading: Reading
    tables: tuple[int, ...]
    with_bar: tuple[int, ...]


PARTS = (
    Part('"LOM (close)" and "(Wang)", from close starts, as the text says', CLOSE, "close", "stated", ALL, (2, 3)),
    Part('"LOM (close)" and "(Wang)", from close starts, as run', CLOSE, "close", "inferred", (4, 5), (4, 5)),
    Part('"LOM (random)" as the text says', RANDOM, "random", "stated", ALL, ()),
    Part('"LOM (random)" as it seems to have been run', RANDOM, "random", "inferred", ALL, ALL),
)


def main() -> int:
    """Run the benchmark; 0 if the bar is met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=300, help="runs of each row (default: 300)")
    parser.add_argument("--tables", type=int, nargs="+", choices=ALL, default=ALL)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    arguments = parser.parse_args()

    if arguments.runs < 2:
        parser.error(f"--runs is {arguments.runs}; a standard deviation needs at least 2")
    console = wide_console(125)
    worst = 0.0
    for part in PARTS:
        tables = set(part.tables) & set(arguments.tables)
        if not tables:
            continue
        # Seeds by place, so that leaving tables out changes nothing in the others, and all parts share their runs.
        seeds = dict(zip(part.rows, np.random.SeedSequence(arguments.seed).spawn(len(part.rows)), strict=True))
        chosen = {row: seed for row, seed in seeds.items() if row.table in tables}
        begin = time.perf_counter()
        solve = functools.partial(solve_runs, start=part.start, reading=part.reading)
        results = in_parallel(solve, chosen, arguments.runs, arguments.workers)
        print_table(console, part.title, results)
        judged = [(row, runs) for row, runs in results if row.table in part.with_bar]
        largest = largest_difference(judged)
        worst = max(worst, largest)
        verdict = f"{largest:.2f} where there is a bar ({BAR:g})" if judged else "no bar"
        console.print(
            f"{arguments.runs} runs a row (released noise, seed {arguments.seed}) in {time.perf_counter() - begin:.0f} "
            f"s. Largest difference {largest_difference(results):.2f} combined standard errors; {verdict}."
        )
    return int(worst > BAR)


if __name__ == "__main__":
    sys.exit(main())
