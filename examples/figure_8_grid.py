"""Which pairs of sensor and target would do on their own: Figure 8 of the RWHEC paper, on its real dataset.

    python examples/figure_8_grid.py [FOLDER]

FOLDER (or GTSAM_RWHEC_UTIAS) has the dataset: ``gtsam-rwhec fetch utias FOLDER`` downloads it. Blue: the pair's own
measurements determine both of its frames. Red, hatched: they leave something free, yet the frames are determined, by
other pairs. White: the camera never saw the tag. The numbers are measurements.
"""

from __future__ import annotations

import os
from pathlib import Path

from figures import BLUE, VERMILLION, arguments_of, save
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

import gtsam_rwhec as rw
from gtsam_rwhec.files.terminal_text import natural_key


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=os.environ.get("GTSAM_RWHEC_UTIAS"))
    arguments = parser.parse_args()
    if arguments.folder is None:
        parser.error("no FOLDER and no GTSAM_RWHEC_UTIAS; `gtsam-rwhec fetch utias FOLDER` downloads the dataset")
    problem = rw.read_csv(arguments.folder, scale="known", sigma=1.0, kappa=1.0)
    solution = rw.solve(problem)
    known = solution.identifiability
    print(solution.certificate)
    print(f"The whole is {'' if known.is_unique else 'not '}determined. {known}")
    for (target, sensor), pair in known.pairs.items():
        if not pair.is_unique:
            free = "; ".join(map(str, pair.free_directions))
            print(f"{target}-{sensor}, {pair.number_of_measurements} measurements: {free}")

    targets = sorted(problem.targets, key=natural_key)
    sensors = sorted(problem.sensors, key=natural_key)
    figure = Figure(figsize=(8.4, 5.2), layout="constrained")
    axes = figure.subplots()
    for (target, sensor), pair in known.pairs.items():
        x, y = targets.index(target), sensors.index(sensor)
        look = {"facecolor": BLUE} if pair.is_unique else {"facecolor": VERMILLION, "hatch": "////"}
        axes.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, edgecolor="white", linewidth=1.5, **look))
        box = None if pair.is_unique else {"facecolor": VERMILLION, "edgecolor": "none", "pad": 1.0}
        axes.text(x, y, pair.number_of_measurements, color="white", ha="center", va="center", fontsize=9, bbox=box)
    axes.set(xlim=(-0.5, len(targets) - 0.5), ylim=(len(sensors) - 0.5, -0.5), aspect="equal")
    axes.set_xticks(range(len(targets)), [name.removeprefix("tag_") for name in targets])
    axes.set_yticks(range(len(sensors)), [name.removeprefix("cam_") for name in sensors])
    axes.set(xlabel="tag", ylabel="camera")
    axes.tick_params(length=0)
    unique = sum(pair.is_unique for pair in known.pairs.values())
    unseen = len(targets) * len(sensors) - len(known.pairs)
    legend = [
        Patch(facecolor=BLUE, label=f"determined on its own ({unique})"),
        Patch(facecolor=VERMILLION, hatch="////", edgecolor="white", label=f"not alone ({len(known.pairs) - unique})"),
        Patch(facecolor="white", edgecolor="0.5", label=f"not seen ({unseen})"),
    ]
    figure.legend(handles=legend, loc="outside lower center", ncols=3, frameon=False)
    save(figure, arguments.save, "figure_8_grid.png")


if __name__ == "__main__":
    main()
