"""How well is every camera of a rig known? The same rig driven two ways: freely, and on a flat floor.

    python examples/covariance_report.py

A vehicle on a floor only turns about its vertical axis, so nothing that it sees says how high its cameras are mounted:
their standard deviation along the vertical, which is each camera's own y here, is infinite. Where the cameras are
relative to one another is as well known as ever.
"""

from __future__ import annotations

import warnings

import gtsam
import numpy as np
from figures import BLUE, ORANGE, VERMILLION, arguments_of, plain, save
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import gtsam_rwhec as rw
from gtsam_rwhec.report import print_refined
from gtsam_rwhec.simulate import Motion, Noise, carrier_poses, perturb

NOISE = Noise(sigma_m=0.005, kappa=0.5 / np.radians(0.3) ** 2)
FORWARD = gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))  # z to the front, y down
CAMERAS = {
    f"cam_{k}": gtsam.Pose3(gtsam.Rot3.Rz(heading) * FORWARD, np.array(position))
    for k, (heading, position) in enumerate([(0.0, (0.4, 0.0, 0.9)), (1.2, (0.2, 0.3, 0.9)), (-1.2, (0.2, -0.3, 0.9))])
}
TAGS = {
    "tag_0": gtsam.Pose3(gtsam.Rot3.RzRyRx(1.5, 0.1, -1.4), np.array([3.0, 0.5, 1.2])),
    "tag_1": gtsam.Pose3(gtsam.Rot3.RzRyRx(1.6, 0.0, 0.2), np.array([0.5, 3.0, 0.8])),
}


def measured(motion: Motion) -> rw.Problem:
    """What the cameras see on a drive; every camera sees every tag in this simplest of rooms."""
    problem = rw.Problem()
    A = np.linalg.inv(carrier_poses(motion, 60, seed=1))  # T_rig_room
    for i, (tag, T_room_tag) in enumerate(TAGS.items()):
        for k, (cam, T_rig_cam) in enumerate(CAMERAS.items()):
            B = perturb(T_rig_cam.inverse().matrix() @ A @ T_room_tag.matrix(), NOISE, seed=10 * i + k)
            problem.add(tag, cam, A, B, sigma=NOISE.sigma_m, kappa=NOISE.kappa)
    return problem


def draw(axes: Axes, deviations: dict[str, np.ndarray], colour: str, top: float) -> None:
    """Three bars for each camera, along its x, y and z; a hatched one as high as the picture where free."""
    ticks = []
    for group, name in enumerate(CAMERAS):
        axes.text(4 * group + 1, -0.1 * top, name, ha="center", va="top")
        for axis, value in enumerate(deviations.get(name, ())):
            at = 4 * group + axis
            ticks.append((at, "xyz"[axis]))
            if np.isfinite(value):
                axes.bar(at, value, width=0.8, color=colour)
                axes.text(at, value + 0.02 * top, f"{value:.2f}", ha="center", fontsize=9)
            else:
                axes.bar(at, top, width=0.8, color="white", edgecolor=VERMILLION, hatch="//", linewidth=1.2)
                box = {"facecolor": "white", "edgecolor": "none", "pad": 2.0}
                axes.text(at, 0.5 * top, "free", color=VERMILLION, ha="center", va="center", rotation=90, bbox=box)
        if name not in deviations:
            axes.text(4 * group + 1, 0.5 * top, "0,\nby definition", ha="center", va="center", color="0.4")
    axes.set(xlim=(-0.8, 10.8), ylim=(0.0, top))
    axes.set_xticks(*zip(*ticks, strict=True))
    axes.tick_params(axis="x", length=0)
    axes.grid(axis="y", color="0.92")
    plain(axes)


def main() -> None:
    arguments = arguments_of(__doc__).parse_args()
    warnings.simplefilter("ignore", rw.errors.NotUniqueWarning)  # the report says it too, and the picture
    figure = Figure(figsize=(9.6, 6.4), layout="constrained")
    panels = figure.subplots(2, 2, sharey=True)
    for column, motion in enumerate((Motion("general"), Motion("planar"))):
        problem = measured(motion)
        refined = rw.refine(problem, rw.solve(problem), rw.RefineOptions(noise="estimate"))
        print_refined(refined)
        on_rig = {name: refined.standard_deviations(name)[1] for name in CAMERAS}
        relative = {
            name: rw.pose_covariances.standard_deviations(refined.relative("cam_0", name)[1])[1]
            for name in ("cam_1", "cam_2")
        }
        draw(panels[0, column], on_rig, BLUE, top=0.8)
        draw(panels[1, column], relative, ORANGE, top=0.8)
        panels[0, column].set_title(("Turning about every axis", "On a flat floor")[column])
    panels[0, 0].set_ylabel("cameras on the rig\n± mm, one standard deviation")
    panels[1, 0].set_ylabel("as seen from cam_0\n± mm, one standard deviation")
    save(figure, arguments.save, "covariance_report.png")


if __name__ == "__main__":
    main()
