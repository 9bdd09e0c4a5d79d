"""The records of methods that minimise reprojection errors: Evangelista et al. 2023, Tabb and Ahmad Yousef's rp1 2017.

They take corners in pixels, not measured poses, so they cannot solve a ``Problem``. ``rw.Observations`` holds the
corners, ``reprojection.run`` solves for the poses by a method's name, and ``reprojection.compare`` by all of them.
"""

from __future__ import annotations

from typing import NoReturn

from gtsam_rwhec.errors import FrameError
from gtsam_rwhec.methods.method import Method, MethodOptions, Properties
from gtsam_rwhec.methods.tabb2017 import SOURCE
from gtsam_rwhec.problem.problem import Problem


def refuse_poses(problem: Problem, options: MethodOptions | None = None) -> NoReturn:
    """Refuse a problem of poses: always raises FrameError."""
    raise FrameError(
        f"this method minimises reprojection errors, and the problem's {problem.number_of_measurements} measurements "
        "are poses; give corners in pixels, as rw.Observations, to gtsam_rwhec.methods.reprojection.run or compare"
    )


EVANGELISTA = Method(
    name="evangelista2023",
    function=refuse_poses,
    properties=Properties("SE(3)", multiple="Xs"),
    source="D. Evangelista, E. Olivastri, D. Allegri, E. Menegatti and A. Pretto, A graph-based optimization framework "
    "for hand-eye calibration for multi-camera setups, ICRA 2023",
    assumes="Corners in pixels, equally accurate, of cameras whose intrinsics are known. Deviations of the robot's "
    "poses: by default a metre and two radians for each pixel. A start near the answer.",
    check=refuse_poses,
)
RP1 = Method(
    name="tabb2017_rp1",
    function=refuse_poses,
    properties=Properties("Euler angles, rotation vectors or quaternions", multiple="Xs or Ys"),
    source=SOURCE,
    assumes="Corners in pixels, of cameras whose intrinsics are known. A start near the answer.",
    check=refuse_poses,
)
