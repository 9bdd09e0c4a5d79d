"""The records of methods that minimise reprojection errors: Evangelista et al. 2023, Tabb and Ahmad Yousef's rp1 2017.

They take corners in pixels, not measured poses: of a ``Problem`` whose measurements were added by ``add_corners``, so
that they stand beside the methods on poses; or as ``rw.Observations``, by ``reprojection.run`` and
``reprojection.compare``. Here they solve for all targets and sensors, although their papers have fewer.
"""

from __future__ import annotations

from functools import partial

from gtsam_rwhec.errors import FrameError
from gtsam_rwhec.fitting.observations import check_corners_everywhere, observations_of
from gtsam_rwhec.methods import reprojection
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.method import Method, MethodOptions, Properties, Takes
from gtsam_rwhec.methods.tabb2017 import SOURCE
from gtsam_rwhec.problem.problem import Problem


def check_corners(problem: Problem) -> None:
    """Refuse a problem of poses: FrameError without any corners, CountError where measurements have none."""
    if not problem.boards:
        raise FrameError(
            f"this method minimises reprojection errors, and the problem's {problem.number_of_measurements} "
            "measurements are poses; give corners in pixels, by problem.add_corners, or as rw.Observations to "
            "gtsam_rwhec.methods.reprojection.run or compare"
        )
    check_corners_everywhere(problem)


def by_corners(problem: Problem, options: MethodOptions, name: str) -> Outcome[Poses]:
    """The answer for the corners that a problem holds."""
    answer = reprojection.run(name, observations_of(problem), options)
    notes = () if answer.converged else (f"not converged after {answer.iterations} steps",)
    return Outcome(
        answer.X,
        answer.Y,
        starts_from=answer.starts_from,
        notes=(f"{answer.rms_px:.3g} px rms by the measured A", *notes),
    )


def _method(name: str, properties: Properties, source: str, assumes: str) -> Method[[Problem, MethodOptions]]:
    return Method(
        name=name,
        function=partial(by_corners, name=name),
        properties=properties,
        source=source,
        assumes=assumes,
        takes=frozenset({Takes.CORNERS}),
        check=check_corners,
    )


EVANGELISTA = _method(
    "evangelista2023",
    Properties("SE(3)", multiple="Xs"),
    "D. Evangelista, E. Olivastri, D. Allegri, E. Menegatti and A. Pretto, A graph-based optimization framework for "
    "hand-eye calibration for multi-camera setups, ICRA 2023",
    "Corners in pixels, equally accurate, of cameras whose intrinsics are known. Deviations of the robot's poses: by "
    "default a metre and two radians for each pixel. A start near the answer.",
)
RP1 = _method(
    "tabb2017_rp1",
    Properties("Euler angles, rotation vectors or quaternions", multiple="Xs or Ys"),
    SOURCE,
    "Corners in pixels, of cameras whose intrinsics are known. A start near the answer.",
)
