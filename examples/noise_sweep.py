"""How noisy may measurements be before optimality cannot be proven? Rotations 1 to 90 degrees off, three scale modes.

    python examples/noise_sweep.py [--runs 100]

Two targets seen by one sensor, 5 or 20 measurements each, rotations off by so many degrees about each axis (Langevin
noise), translations by 5 cm. For every run the table and the picture say what proved its answer optimal: the dual
certificate after the spectral start, the multipliers of the redundant constraints (small dual), a better start, or
the full relaxation; or that the relaxation is not tight, or that no scale above zero fits best.
"""

from __future__ import annotations

import warnings
from collections import Counter

import numpy as np
from figures import BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, arguments_of, save
from matplotlib.figure import Figure

import gtsam_rwhec as rw
from gtsam_rwhec.simulate import Noise, general
from gtsam_rwhec.solver import Multipliers, Start

LOOKS = {
    "dual": BLUE,
    "small dual": SKY,
    "better start": GREEN,
    "relaxation": ORANGE,
    "not tight": VERMILLION,
    "not decided": PURPLE,
    "scale <= 0": GREY,
}
SCALES = ("known", "shared", "per_target")
MEASUREMENTS = (5, 20)


def outcome(scale: rw.ScaleMode, degrees: float, measurements: int, seed: int) -> str:
    """Simulate, solve, and say what proved the answer."""
    noise = Noise(sigma_m=0.05, kappa=1.0 / (2.0 * np.radians(degrees) ** 2))
    simulation = general(2, 1, seed=seed, number_of_measurements=measurements, noise=noise, scale=scale)
    try:
        c = rw.solve(simulation.problem).certificate
    except rw.errors.ScaleError:
        return "scale <= 0"
    if c.cause is rw.Cause.MIRROR_IMAGE:  # a mirror image fits better than the best answer with a positive scale
        return "scale <= 0"
    if not c.is_optimal:
        return "not tight" if c.cause is rw.Cause.NOT_TIGHT else "not decided"
    if c.path.start is not Start.SPECTRAL:
        return "better start" if c.path.start is Start.BETTER else "relaxation"
    return "dual" if c.path.multipliers is Multipliers.KKT else "small dual"


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("--runs", type=int, default=100, help="of each combination (%(default)s)")
    parser.add_argument("--degrees", type=float, nargs="+", default=[1, 2, 5, 10, 15, 20, 30, 45, 60, 75, 90])
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", rw.errors.RwhecWarning)  # every outcome is counted

    figure = Figure(figsize=(10.5, 5.8), layout="constrained")
    panels = figure.subplots(len(MEASUREMENTS), len(SCALES), sharex=True, sharey=True)
    print(f"Share of {arguments.runs} runs, percent\n")
    print(f"{'scale':<11}{'N':>3}{'degrees':>9}" + "".join(f"{name:>14}" for name in LOOKS))
    for row, measurements in enumerate(MEASUREMENTS):
        for column, scale in enumerate(SCALES):
            bottom = np.zeros(len(arguments.degrees))
            shares = []
            for degrees in arguments.degrees:
                counts = Counter(outcome(scale, degrees, measurements, seed) for seed in range(arguments.runs))
                shares.append([100.0 * counts[name] / arguments.runs for name in LOOKS])
                cells = "".join(f"{share:>14.3g}" for share in shares[-1])
                print(f"{scale:<11}{measurements:>3}{degrees:>9g}{cells}", flush=True)
            axes = panels[row, column]
            for name, heights in zip(LOOKS, np.array(shares).T, strict=True):
                axes.bar(range(len(bottom)), heights, 0.85, bottom, color=LOOKS[name], label=name)
                bottom += heights
            axes.set_xticks(range(len(bottom)), [f"{degrees:g}" for degrees in arguments.degrees], fontsize=8)
            axes.set(ylim=(0, 100), title=f"{scale.replace('_', ' ')} scale, {measurements} measurements a pair")
            axes.title.set_size(10)
    for axes in panels[-1]:
        axes.set_xlabel("rotation noise about each axis (degrees)")
    for axes in panels[:, 0]:
        axes.set_ylabel("share of runs (%)")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=7, frameon=False)
    save(figure, arguments.save, "noise_sweep.png")


if __name__ == "__main__":
    main()
