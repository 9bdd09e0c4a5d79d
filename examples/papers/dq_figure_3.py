"""Figure 3 of the DQ paper: DQOpt's errors beside Dan's as both noises grow, three motions.

    python examples/papers/dq_figure_3.py [--runs 60] [--dan rows]

Maps of the mean over the samples of log(DQOpt's error / Dan's), each at its best alpha (the one of smallest mean error)
and, in the last column, at alpha = 1/m. Blue: DQOpt is better, e^value times. The paper does not state its noise
levels, nor which motion its last column is: Random here. ``--dan rows``: Dan with alpha on rows alone, as the paper
seems to have run it (dq_sweep.py).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from dq_scenarios import Array, sample
from dq_sweep import errors
from in_processes import in_processes
from matplotlib.figure import Figure
from reports import arguments_of, markdown, save_picture, save_text

COLUMNS = (("Linear", False), ("Circular", False), ("Random", False), ("Random", True))
LEVELS_DEG, LEVELS_CM = (0.1, 0.3, 0.57, 1.1, 2.3), (0.2, 0.5, 1.0, 2.0, 4.0)
ALPHAS = np.logspace(-2.0, 1.7, 16)


def cell(seeds: list[np.random.SeedSequence], scenario: str, dan: str, degrees: float, cm: float) -> Array:
    """Mean and standard error of log(DQOpt / Dan) (best alpha or alpha = 1, mean or its error, rotation or not)."""
    alphas = np.append(ALPHAS, 1.0)
    found = np.array(
        [
            errors(
                sample(scenario, np.random.default_rng(s), 100, np.radians(degrees), 0.01 * cm), ("DQOpt", dan), alphas
            )
            for s in seeds
        ]
    )
    result = np.empty((2, 2, 2))
    for which in range(2):
        best = found[:, :, :-1, which].mean(axis=0).argmin(axis=1)
        for at_one, (ours, dans) in enumerate((best, (-1, -1))):
            logs = np.log(found[:, 0, ours, which] / found[:, 1, dans, which])
            result[at_one, :, which] = logs.mean(), logs.std(ddof=1) / np.sqrt(len(logs))
    return result


def picture(maps: Array) -> Figure:
    """``maps``: (columns, degrees, cm, mean or error, rotation or translation)."""
    figure = Figure(figsize=(12.0, 6.0), layout="constrained")
    panels = figure.subplots(2, len(COLUMNS), sharex=True, sharey=True)
    for row, what in enumerate(("rotation", "translation")):
        limit = float(np.abs(maps[:, :, :, 0, row]).max())
        for column, (scenario, at_one) in enumerate(COLUMNS):
            axes, values = panels[row, column], maps[column, :, :, 0, row]
            # Blue and red of equal lightness differ for every form of colour blindness; the numbers say it too.
            shown = axes.imshow(values, cmap="RdBu_r", vmin=-limit, vmax=limit, origin="lower", aspect="auto")
            for (y, x), value in np.ndenumerate(values):
                colour = "white" if abs(value) > 0.55 * limit else "black"
                axes.text(x, y, f"{value:.2f}", ha="center", va="center", fontsize=8, color=colour)
            axes.set_xticks(range(len(LEVELS_CM)), [f"{v:g}" for v in LEVELS_CM])
            axes.set_yticks(range(len(LEVELS_DEG)), [f"{v:g}" for v in LEVELS_DEG])
            if row == 0:
                which_alpha = r"$\alpha$ = 1/m" if at_one else r"best $\alpha$"
                axes.set_title(f"{scenario}, {which_alpha}", fontsize=10)
            else:
                axes.set_xlabel("translation noise (cm)")
        panels[row, 0].set_ylabel(f"{what} error\nrotation noise (degrees)")
        figure.colorbar(shown, ax=panels[row], label="mean log(DQOpt / Dan)")
    return figure


def main() -> None:
    parser = arguments_of(__doc__, 60, "samples of each cell")
    parser.add_argument("--dan", choices=("stated", "rows"), default="stated", help="which Dan (%(default)s)")
    arguments = parser.parse_args()
    dan = "Dan" if arguments.dan == "stated" else "Dan, rows"
    scenarios = tuple(dict.fromkeys(scenario for scenario, _ in COLUMNS))
    calls: list[tuple[Any, ...]] = []
    for scenario, seed in zip(scenarios, np.random.SeedSequence(arguments.seed).spawn(len(scenarios)), strict=True):
        cells = [(degrees, cm) for degrees in LEVELS_DEG for cm in LEVELS_CM]
        for noise, of_cell in zip(cells, seed.spawn(len(cells)), strict=True):
            calls.append((of_cell.spawn(arguments.runs), scenario, dan, *noise))
    found = np.array(in_processes(cell, calls, arguments.workers, "cells"))
    found = found.reshape(len(scenarios), len(LEVELS_DEG), len(LEVELS_CM), 2, 2, 2)
    maps = np.array([found[scenarios.index(scenario), :, :, int(at_one)] for scenario, at_one in COLUMNS])
    rows = []
    for (scenario, at_one), of_map in zip(COLUMNS, maps, strict=True):
        for which, what in enumerate(("rotation", "translation")):
            values, largest = of_map[:, :, 0, which], float(of_map[:, :, 1, which].max())
            words = [scenario, "1" if at_one else "best", what]
            rows.append([*words, *[f"{v:+.2f}" for v in (values.min(), values.mean(), values.max(), largest)]])
            rows[-1].append(f"{np.exp(-values.mean()):.3g}")
    text = (
        f"# DQ paper, Figure 3\n\nMean log(DQOpt's error / Dan's, {arguments.dan}) over {arguments.runs} samples in "
        f"each of {len(LEVELS_DEG) * len(LEVELS_CM)} cells of noise, seed {arguments.seed}; below zero: DQOpt is "
        "better. The paper gives a picture without numbers.\n\n"
        + markdown(["motion", "alpha", "error", "least", "mean", "most", "largest s.e.", "Dan / DQOpt"], rows, left=3)
    )
    save_text(text, arguments.output, "dq_figure_3.md")
    save_picture(picture(maps), arguments.output, "dq_figure_3.png")


if __name__ == "__main__":
    main()
