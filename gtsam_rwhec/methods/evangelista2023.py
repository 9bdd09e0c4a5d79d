"""Evangelista et al. 2023: reprojection errors over the graph of cameras, targets and robot poses.

All cameras see the pattern at each robot pose; the corners' pixel errors are the graph's edges, the unknown poses of
cameras and targets its vertices. There is no Problem of poses to run it on: it takes ``reprojection.Observations``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gtsam_rwhec.errors import FrameError
from gtsam_rwhec.methods.protocol import Calibration, Method, MethodOptions, Properties
from gtsam_rwhec.problem.problem import Problem

if TYPE_CHECKING:
    from gtsam_rwhec.methods.reprojection import Observations, ReprojectionAnswer


def evangelista2023(observations: Observations, options: MethodOptions | None = None) -> ReprojectionAnswer:
    """Several cameras, one or several targets, from corners in pixels; see ``reprojection.calibrate``."""
    from gtsam_rwhec.methods.reprojection import calibrate  # brings in OpenCV

    return calibrate(observations, options)


def without_images(problem: Problem) -> None:
    """Refuse what has poses in place of images.

    Raises
    ------
    FrameError
        Always.
    """
    raise FrameError(
        f"evangelista2023 minimises reprojection errors, and this problem's {problem.number_of_measurements} "
        "measurements are poses; give corners in pixels, as gtsam_rwhec.methods.reprojection.Observations, to "
        "gtsam_rwhec.methods.evangelista2023.evangelista2023"
    )


def _refuse(problem: Problem, options: MethodOptions) -> Calibration:
    without_images(problem)
    raise AssertionError  # never reached


METHOD = Method(
    name="evangelista2023",
    properties=Properties(
        joint=True,
        probabilistic=False,
        certifiable=False,
        multiple="Xs",
        monocular=False,
        representation="SE(3)",
    ),
    source="D. Evangelista, E. Olivastri, D. Allegri, E. Menegatti and A. Pretto, A graph-based optimization framework "
    "for hand-eye calibration for multi-camera setups, ICRA 2023",
    assumes="Images: corners in pixels, alike in all of them, with cameras whose intrinsics are known; a start near "
    "the answer.",
    function=_refuse,
    check=without_images,
)
