"""From a folder of measurements to a calibration that is proven optimal, and a picture of it.

    python examples/certify_a_rig.py

Three cameras on a hand-held rig saw four tags in a room. The folder is the one that the repository ships; yours looks
alike: ``tag_0_cam_0_A.csv`` has the rig's poses, ``tag_0_cam_0_B.csv`` what camera 0 measured of tag 0.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from figures import BLUE, GREEN, GREY, VERMILLION, arguments_of, plain, save
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import gtsam_rwhec as rw
from gtsam_rwhec.report import print_solution

FOLDER = Path(__file__).resolve().parents[1] / "data" / "demo"
#: Standard deviations of its measurements: 5 mm, and 0.5 degrees as a concentration.
SIGMA_M, KAPPA = 0.005, 0.5 / np.radians(0.5) ** 2


def draw_from_above(axes: Axes, name: str, T: np.ndarray, length_m: float) -> None:
    """A frame's axes as seen along z, and its name on the other side of where they point."""
    start = T[:2, 3]
    for column, colour in enumerate((VERMILLION, GREEN, BLUE)):
        if np.linalg.norm(T[:2, column]) < 0.3:
            continue  # it points at the viewer, or away
        axes.annotate(
            "",
            start + length_m * T[:2, column],
            start,
            arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 2.0, "shrinkA": 0.0, "shrinkB": 0.0},
        )
    away = -T[:2, :3].sum(axis=1) / np.linalg.norm(T[:2, :3].sum(axis=1))
    axes.annotate(name, start, away * (26.0, 16.0), textcoords="offset points", ha="center", va="center", fontsize=9)


def main() -> None:
    arguments = arguments_of(__doc__).parse_args()
    problem = rw.read_csv(FOLDER, scale="known", sigma=SIGMA_M, kappa=KAPPA)
    solution = rw.solve(problem)
    print_solution(solution)

    figure = Figure(figsize=(9.6, 5.2), layout="constrained")
    rig, room = figure.subplots(1, 2)
    draw_from_above(rig, "rig", np.eye(4), 0.05)
    for name, pose in solution.Y.items():
        draw_from_above(rig, name, pose.matrix(), 0.05)
    rig.set(xlim=(-0.06, 0.22), ylim=(-0.22, 0.22), title="The rig from above: Y = T_rig_cam")

    positions = np.concatenate([np.linalg.inv(problem.measurements(*pair).A)[:, :2, 3] for pair in problem.pairs])
    room.scatter(*positions.T, color=GREY, s=8)
    for name, pose in solution.X.items():
        draw_from_above(room, name, pose.matrix(), 0.6)
    room.set(xlim=(-1.4, 3.2), ylim=(-1.9, 2.7), title="The room from above: X = T_room_tag")
    for axes in (rig, room):
        axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
        axes.grid(color="0.92")
        plain(axes)
    for label, colour in (("x axis", VERMILLION), ("y axis", GREEN), ("z axis: where a camera looks", BLUE)):
        rig.plot([], [], color=colour, linewidth=2.0, label=label)
    rig.plot([], [], "o", color=GREY, markersize=3, label="rig when it saw a tag")
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    save(figure, arguments.save, "certify_a_rig.png")


if __name__ == "__main__":
    main()
