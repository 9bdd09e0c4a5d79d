"""Figure 6 of the DQ paper: what alpha does to the errors of Dan, DQOpt and DQConvRlx, Random scenario.

    python examples/papers/dq_figure_6.py [--runs 60]

Mean errors over the samples at each alpha; first the rotation's, then the translation's, with noise of one kind varied
and the other's kept at that of Table 2. The paper does not state its noise levels; the ones here are around Table 2's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from dq_scenarios import SIGMA_M, SIGMA_RAD, Array, sample
from dq_sweep import errors
from in_processes import in_processes
from matplotlib import colormaps
from matplotlib.figure import Figure
from reports import arguments_of, markdown, plain, plain_numbers, quantity, save_picture, save_text

NAMES = ("Dan", "DQOpt", "DQConvRlx")
LEVELS_DEG, LEVELS_CM = (0.14, 0.57, 2.3, 5.7, 11.5), (0.25, 1.0, 4.0, 10.0, 20.0)
ALPHAS = np.logspace(-2.0, 1.7, 25)
CHUNK = 10
VARIED = ("translation", "rotation")
UNITS = ("degrees", "cm")


def swept(seeds: list[np.random.SeedSequence], sigma_rad: float, sigma_m: float) -> Array:
    """Errors (samples, names, alphas, 2)."""
    return np.array(
        [
            errors(sample("Random", np.random.default_rng(seed), 100, sigma_rad, sigma_m), NAMES, ALPHAS)
            for seed in seeds
        ]
    )


def noise_of(varied: str, level: int) -> tuple[float, float]:
    """Radians and metres."""
    if varied == "translation":
        return float(SIGMA_RAD), 0.01 * LEVELS_CM[level]
    return float(np.radians(LEVELS_DEG[level])), SIGMA_M


def picture(means: dict[tuple[str, int], Array]) -> Figure:
    """Rows: algorithms; columns: what is measured, and what is varied."""
    figure = Figure(figsize=(11.5, 8.0), layout="constrained")
    panels = figure.subplots(len(NAMES), 4, sharex=True, sharey="col")
    for row, name in enumerate(NAMES):
        for column in range(4):
            which, varied = divmod(column, 2)
            axes = panels[row, column]
            # Two hues as in the paper, from dark (little noise) to light.
            shades = colormaps["Purples_r" if which == 0 else "Greens_r"](np.linspace(0.0, 0.65, len(LEVELS_DEG)))
            for level, (colour, marker) in enumerate(zip(shades, "os^Dv", strict=True)):
                of_level = means[VARIED[varied], level][row, :, which]
                label = f"{LEVELS_CM[level]:g} cm" if varied == 0 else f"{LEVELS_DEG[level]:g} deg"
                axes.loglog(ALPHAS, of_level, marker=marker, markevery=6, markersize=4, color=colour, label=label)
            plain_numbers(axes.yaxis)
            axes.grid(color="0.92")
            plain(axes)
            if row == 0:
                axes.set_title(f"{VARIED[varied]} noise varied", fontsize=10)
            if row == len(NAMES) - 1:
                axes.set_xlabel(r"$\alpha$ (1/m)")
                handles, labels = axes.get_legend_handles_labels()
                axes.legend(
                    handles, labels, loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=2, fontsize=8, frameon=False
                )
            if varied == 0:
                axes.set_ylabel(f"{name}\n{('rotation', 'translation')[which]} error ({UNITS[which]})", fontsize=9)
    return figure


def main() -> None:
    arguments = arguments_of(__doc__, 60, "samples of each noise level").parse_args()
    levels = [(varied, level) for varied in VARIED for level in range(len(LEVELS_DEG))]
    calls: list[tuple[Any, ...]] = []
    places = []
    for of_level, seed in zip(levels, np.random.SeedSequence(arguments.seed).spawn(len(levels)), strict=True):
        seeds = seed.spawn(arguments.runs)
        for first in range(0, arguments.runs, CHUNK):
            calls.append((seeds[first : first + CHUNK], *noise_of(*of_level)))
            places.append(of_level)
    found = in_processes(swept, calls, arguments.workers, "samples by ten")
    means, rows = {}, []
    for varied, level in levels:
        every = np.concatenate([part for part, at in zip(found, places, strict=True) if at == (varied, level)])
        mean, error = np.nanmean(every, axis=0), np.nanstd(every, axis=0, ddof=1) / np.sqrt(len(every))
        means[varied, level] = mean
        radians, metres = noise_of(varied, level)
        for row, name in enumerate(NAMES):
            cells = [name, varied, f"{np.degrees(radians):.2f}", f"{100.0 * metres:g}"]
            for which in range(2):
                best = int(mean[row, :, which].argmin())
                cells += [f"{quantity(mean[row, best, which])} +- {quantity(error[row, best, which], 2)}"]
                cells += [quantity(float(ALPHAS[best])), quantity(float(mean[row, -1, which] / mean[row, best, which]))]
            rows.append(cells)
    headers = ["algorithm", "varied", "noise, deg", "noise, cm"]
    for unit in ("rotation, deg", "translation, cm"):
        headers += [unit, "best alpha", "at 50 / at best"]
    text = (
        "# DQ paper, Figure 6\n\n"
        f"{arguments.runs} samples of each level, seed {arguments.seed}: mean errors +- standard errors at the best "
        "alpha (1/m), and how many times larger they are at alpha = 50. The paper gives no numbers.\n\n"
        + markdown(headers, rows, left=2)
    )
    save_text(text, arguments.output, "dq_figure_6.md")
    save_picture(picture(means), arguments.output, "dq_figure_6.png")


if __name__ == "__main__":
    main()
