"""50 targets and 50 sensors, each pair measured, against one ``numpy.linalg.eigh`` of a 901 x 901 matrix.

    python benchmarks/many_frames.py [--repetitions 7] [--plot FOLDER]

901 = 9 * 100 + 1 is the size of Q'. With --plot FOLDER the time against the number of frames goes to
FOLDER/time_against_frames.png: as many targets as sensors, all connected, and stars either way.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from bars import Row, benchmark_parser, print_rows
from interleaved import in_words, interleaved

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, general

NOISE = Noise(sigma_m=0.01, kappa=125.0)
MEASUREMENTS = 20
COMPLETE = (2, 4, 8, 16, 32, 64, 100, 128)
STARS = (2, 4, 8, 16, 32, 64, 128, 256, 512)


def problem_of(targets: int, sensors: int) -> rw.Problem:
    """Every sensor sees every target."""
    return general(
        targets, sensors, seed=1, number_of_measurements=MEASUREMENTS, noise=NOISE, keep_measurements=False
    ).problem


def rows(repetitions: int) -> list[Row]:
    """The 100 frames against eigh."""
    problem = problem_of(50, 50)
    matrix = np.random.default_rng(0).standard_normal((901, 901))
    matrix = matrix + matrix.T
    times = interleaved(
        repetitions, {"eigh": lambda: np.linalg.eigh(matrix), "solve": lambda: rw.solve(problem, method="auto")}
    )
    c = rw.solve(problem).certificate
    ratio = times.ratio("solve", "eigh")
    return [
        Row(
            "50 targets x 50 sensors: solve over eigh of 901 x 901",
            f"{ratio:.1f}x ({in_words(times.median('solve'))}; eigh {in_words(times.median('eigh'))})",
            "<= 30x",
            ratio <= 30.0,
        ),
        Row("    status, relative gap", f"{c.status}, {c.relative_gap:.1e}", "certified", c.is_certified),
        Row("    stages", ", ".join(f"{stage} {in_words(seconds)}" for stage, seconds in c.seconds.items())),
    ]


def plot(folder: Path, repetitions: int) -> Path:
    """Time of solve against the number of frames."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    axes = figure.subplots()
    families = (
        ("half targets, half sensors, all connected", "#0072B2", "o", [(n // 2, n - n // 2) for n in COMPLETE]),
        ("one target, many sensors", "#D55E00", "s", [(1, n - 1) for n in STARS]),
        ("many targets, one sensor", "#009E73", "^", [(n - 1, 1) for n in STARS]),
    )
    for label, colour, marker, sizes in families:
        milliseconds = []
        for targets, sensors in sizes:
            problem = problem_of(targets, sensors)
            times = interleaved(repetitions, {"solve": lambda problem=problem: rw.solve(problem)})
            milliseconds.append(1e3 * times.median("solve"))
        axes.loglog([j + k for j, k in sizes], milliseconds, color=colour, marker=marker, label=label)
    axes.set_xlabel("number of frames (targets and sensors)")
    axes.set_ylabel("solve, moments to certificate and identifiability (ms)")
    axes.set_title(f"Time to certify; {MEASUREMENTS} measurements a pair", loc="left")
    axes.grid(True, which="major", color="0.9")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "time_against_frames.png"
    figure.savefig(path, dpi=110)
    return path


def main() -> int:
    """Print the table; plot if asked to."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--repetitions", type=int, default=7)
    parser.add_argument("--plot", type=Path, metavar="FOLDER", help="write time_against_frames.png there")
    arguments = parser.parse_args()
    status = print_rows("Many frames", rows(arguments.repetitions), store=arguments.store)
    if arguments.plot is not None:
        print(f"Written to {plot(arguments.plot, min(arguments.repetitions, 5))}.")
    return status


if __name__ == "__main__":
    raise SystemExit(main())
