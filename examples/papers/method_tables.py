"""Tables 2 and 4 of the RWHEC paper, rows of the other methods: our implementations' mean errors against its.

    python examples/papers/method_tables.py --runs 1000

The runs are those of tables_2_to_5.py (``released`` noise), each solved by every method of ``gtsam_rwhec.methods`` that
has a row. Some rows are not what the paper's text says. They are printed twice: as the text has them, without a bar,
and as they seem to have been run. The bar for the latter: every mean within four combined standard errors.

- Table 2, all rows but LOM and "Ours": t_y is that of Y's inverse, T_target_base in place of T_base_target. Y's own is
  too small by 12 to 15 standard errors at 1 cm (Shah, kappa 125: 3.9 mm against the paper's 9.9; kappa 12: 5.6 against
  31.8) while all other columns agree; the inverse's agrees within one at every noise level and for every method. An
  error of the rotation moves the inverse's origin by the lever arm |t_Y| = 0.5 m. X is not inverted: in Table 4, where
  the cameras stand a metre away, its inverse's t_x would be four times the paper's. Y's there does not tell (0.1 m).
- LOM (Wang), Table 4: rotation weights are 2 kappa, as in lom_tables.py (the text's fit too, not as well).
- Horn: the residual is x - a* y b, not a x - y b, whose norm differs, as dual quaternions do not preserve it (Table 2,
  kappa 12, 1 cm: t_x is 188 mm with the latter, 48 with the former, 45 in the paper). In Table 4 t_x is that of X's
  inverse (12 mm against 5; the paper: 12.1).
- Horn, Table 4: the collapse is a decimal point. From the second row on, rotation errors are ten times the angle:
  at kappa 125 the first row has 0.455 and 0.165 degrees and the second 4.55 and 1.76, standard deviations alike, with
  the same rotation noise and no more translation error. Divided by ten, means and deviations of the two rows of kappa
  12 (24.6 +- 94.4 degrees, 69 +- 121 mm ...) are those of one to two runs of 100 that ended about 90 degrees and a
  metre away beside others as good as ours: signs that did not fit, say. With signs that fit there is no such run.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import os
import sys
import time
from collections.abc import Mapping
from typing import Literal, get_args

import gtsam
import numpy as np
from numpy.typing import NDArray
from paper_tables import BAR, Experiment, Runs, in_parallel, largest_difference, print_table, simulated, wide_console
from tables_2_to_5 import EXPERIMENTS

from gtsam_rwhec.geometry.poses import to_pose3
from gtsam_rwhec.methods import METHODS, MethodOptions, run
from gtsam_rwhec.methods.closed_forms import start_of
from gtsam_rwhec.methods.horn2023 import solve_dual_quaternions
from gtsam_rwhec.methods.iterative_methods import LomOptions, local_on_manifold
from gtsam_rwhec.methods.linear_systems import Stack
from gtsam_rwhec.simulate import CalibrationErrors, FrameDistance, Simulation, frame_distance
from gtsam_rwhec.simulate.simulation import PosesAndScale

#: The paper's rows by method, each in the order of the noise levels of its tables.
SHAH_AND_WANG = (
    Experiment(2, 125, 0.01, ((20.6, 10.5), (1.37, 0.55), (9.9, 4.8), (1.34, 0.57))),
    Experiment(2, 125, 0.05, ((31.2, 15.0), (1.61, 0.64), (21.2, 10.0), (1.57, 0.66))),
    Experiment(2, 12, 0.01, ((65.5, 38.3), (4.34, 1.95), (31.8, 17.2), (4.41, 1.98))),
    Experiment(2, 12, 0.05, ((71.9, 44.7), (4.74, 2.13), (37.8, 19.3), (4.63, 2.21))),
)
ROWS: dict[str, tuple[Experiment, ...]] = {
    "shah2013": SHAH_AND_WANG,
    "wang2022": (
        *SHAH_AND_WANG,
        Experiment(4, 125, 0.01, ((2.32, 1.56), (0.469, 0.200), (2.71, 1.37), (0.273, 0.120))),
        Experiment(4, 125, 0.05, ((4.95, 2.20), (0.470, 0.196), (3.52, 1.57), (0.260, 0.115))),
        Experiment(4, 12, 0.01, ((6.05, 4.84), (1.54, 0.63), (7.63, 4.04), (0.812, 0.364))),
        Experiment(4, 12, 0.05, ((7.85, 4.34), (1.52, 0.70), (9.58, 4.46), (0.868, 0.340))),
    ),
    "dornaika1998": (
        Experiment(2, 125, 0.01, ((19.9, 10.2), (1.25, 0.53), (8.8, 4.3), (1.20, 0.54))),
        Experiment(2, 125, 0.05, ((30.6, 14.5), (1.49, 0.62), (20.4, 9.7), (1.44, 0.63))),
        Experiment(2, 12, 0.01, ((63.4, 37.3), (3.92, 1.87), (27.4, 16.2), (3.92, 1.90))),
        Experiment(2, 12, 0.05, ((69.9, 43.1), (4.33, 2.08), (33.9, 17.9), (4.13, 2.14))),
    ),
    "lom": (
        Experiment(2, 125, 0.01, ((11.1, 5.82), (0.78, 0.37), (3.69, 2.12), (0.63, 0.38))),
        Experiment(2, 125, 0.05, ((28.5, 13.4), (1.45, 0.62), (18.5, 8.8), (1.39, 0.62))),
        Experiment(2, 12, 0.01, ((15.2, 10.0), (1.84, 0.84), (3.4, 1.8), (0.88, 0.59))),
        Experiment(2, 12, 0.05, ((48.3, 27.3), (3.18, 1.67), (18.7, 9.04), (2.72, 1.64))),
        Experiment(4, 125, 0.01, ((0.994, 0.416), (0.454, 0.190), (0.572, 0.296), (0.022, 0.010))),
        Experiment(4, 125, 0.05, ((4.57, 1.96), (0.460, 0.191), (2.74, 1.34), (0.120, 0.056))),
        Experiment(4, 12, 0.01, ((0.933, 0.370), (1.52, 0.64), (0.537, 0.262), (0.021, 0.010))),
        Experiment(4, 12, 0.05, ((4.57, 1.97), (1.51, 0.682), (2.93, 1.34), (0.104, 0.047))),
    ),
    "horn2023": (
        Experiment(2, 125, 0.01, ((18.5, 9.4), (1.16, 0.51), (8.4, 4.2), (1.10, 0.51))),
        Experiment(2, 125, 0.05, ((29.1, 13.6), (1.42, 0.60), (19.9, 9.2), (1.36, 0.59))),
        Experiment(2, 12, 0.01, ((45.0, 24.8), (3.30, 1.69), (25.8, 14.1), (3.19, 1.55))),
        Experiment(2, 12, 0.05, ((50.6, 28.4), (3.69, 1.72), (31.0, 16.2), (3.40, 1.72))),
        Experiment(4, 125, 0.01, ((12.11, 6.49), (0.455, 0.191), (5.43, 2.04), (0.165, 0.067))),
        Experiment(4, 125, 0.05, ((12.4, 6.4), (4.55, 1.91), (5.42, 2.33), (1.76, 0.69))),
        Experiment(4, 12, 0.01, ((69, 121), (24.6, 94.4), (48.5, 82.5), (13.0, 76.8))),
        Experiment(4, 12, 0.05, ((77, 146), (26, 106), (57, 110), (14.8, 83.9))),
    ),
}


Reading = Literal["stated", "inferred"]
#: Rows of Table 2 whose t_y is that of Y's inverse.
INVERTED = ("shah2013", "wang2022", "dornaika1998", "horn2023")
#: Rows whose rotation errors are ten times the angle.
TENFOLD = ROWS["horn2023"][5:]


@dataclasses.dataclass(frozen=True)
class Found:
    """Poses of known scale."""

    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    scale: float = 1.0


def solved(simulation: Simulation, experiment: Experiment, method: str, reading: Reading) -> PosesAndScale:
    """One run's answer."""
    if method == "lom" and experiment.table == 4 and reading == "inferred":
        X, Y, scale, _ = start_of(simulation.problem, MethodOptions())
        return local_on_manifold(simulation.problem, X, Y, scale, LomOptions("matched"))
    if method == "horn2023" and reading == "inferred":
        stack = Stack.of(simulation.problem)
        found = solve_dual_quaternions(stack, residual="x - a* y b")
        poses = [to_pose3(R, t) for R, t in zip(found.R, found.t, strict=True)]
        X = dict(zip(stack.targets, poses, strict=False))
        return Found(X, dict(zip(stack.sensors, poses[len(X) :], strict=True)))
    return run(method, simulation.problem)


def of_inverses(
    answer: Mapping[str, gtsam.Pose3], truth: Mapping[str, NDArray[np.float64]]
) -> dict[str, FrameDistance]:
    """Errors of frames' inverses."""
    return {name: frame_distance(answer[name].inverse().matrix(), np.linalg.inv(T)) for name, T in truth.items()}


def errors_as_run(
    simulation: Simulation, experiment: Experiment, method: str, answer: PosesAndScale
) -> CalibrationErrors:
    """An answer's errors as the paper's row has them."""
    errors = simulation.errors(answer)
    if experiment.table == 2 and method in INVERTED:
        errors = dataclasses.replace(errors, Y=of_inverses(answer.Y, simulation.Y))
    if experiment.table == 4 and method == "horn2023":
        errors = dataclasses.replace(errors, X=of_inverses(answer.X, simulation.X))
    return errors


def solve_runs(experiment: Experiment, seeds: list[np.random.SeedSequence], method: str, reading: Reading) -> Runs:
    """Simulate and solve one run for each seed."""
    errors = []
    for seed in seeds:
        simulation = simulated(experiment, "released", seed, keep=True)
        answer = solved(simulation, experiment, method, reading)
        stated = reading == "stated"
        errors.append(simulation.errors(answer) if stated else errors_as_run(simulation, experiment, method, answer))
    runs = Runs.of(errors, {})
    if reading == "inferred" and method == "horn2023" and experiment in TENFOLD:
        runs.X[:, :, 1] *= 10.0
        runs.Y[:, :, 1] *= 10.0
    return runs


def chosen_seeds(rows: tuple[Experiment, ...], seed: int) -> dict[Experiment, np.random.SeedSequence]:
    """The seeds of tables_2_to_5.py, so that all methods and "Ours" share their runs; fresh: spawning changes them."""
    of_levels = np.random.SeedSequence(seed).spawn(len(EXPERIMENTS))
    levels = {(e.table, e.kappa, e.sigma_m): one for e, one in zip(EXPERIMENTS, of_levels, strict=True)}
    return {row: levels[row.table, row.kappa, row.sigma_m] for row in rows}


def main() -> int:
    """Run the benchmark; 0 if the bar is met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000, help="runs of each row (default: 1000)")
    known = tuple(method for method in ROWS if method in METHODS)
    parser.add_argument("--methods", nargs="+", choices=known, default=known)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    arguments = parser.parse_args()

    if arguments.runs < 2:
        parser.error(f"--runs is {arguments.runs}; a standard deviation needs at least 2")
    console = wide_console(120)
    worst = 0.0
    for method in arguments.methods:
        for reading in get_args(Reading):
            begin = time.perf_counter()
            solve = functools.partial(solve_runs, method=method, reading=reading)
            results = in_parallel(solve, chosen_seeds(ROWS[method], arguments.seed), arguments.runs, arguments.workers)
            words = "as the text says" if reading == "stated" else "as it seems to have been run"
            print_table(console, f"{method}, {words}", results)
            largest = largest_difference(results)
            if reading == "inferred":
                worst = max(worst, largest)
            console.print(
                f"{arguments.runs} runs a row (released noise, seed {arguments.seed}) in "
                f"{time.perf_counter() - begin:.0f} s. Largest difference {largest:.2f} combined standard errors; "
                + (f"bar {BAR:g}." if reading == "inferred" else "no bar.")
            )
    return int(worst > BAR)


if __name__ == "__main__":
    sys.exit(main())
