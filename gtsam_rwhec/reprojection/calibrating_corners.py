"""From corners and carriers' poses alone to everything: intrinsics, certified poses, refinement from the corners."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.errors import RwhecWarning
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.refinement.options import RefineOptions
from gtsam_rwhec.refinement.refined import Refined
from gtsam_rwhec.refinement.refining import refine
from gtsam_rwhec.reprojection.chosen_poses import solved_with_chosen_poses
from gtsam_rwhec.reprojection.determined import check_arguments
from gtsam_rwhec.reprojection.first_intrinsics import first_intrinsics
from gtsam_rwhec.reprojection.observations import Observations
from gtsam_rwhec.reprojection.options import CornerOptions
from gtsam_rwhec.reprojection.rays import findings_of_images_left_out
from gtsam_rwhec.reprojection.refined import CornersRefined
from gtsam_rwhec.reprojection.refining_corners import refine_corners
from gtsam_rwhec.solving.certified_solution import solve
from gtsam_rwhec.solving.solution import Solution


@dataclass(frozen=True, eq=False)
class CornersCalibrated:
    """A calibration from corners.

    Attributes
    ----------
    solution : Solution
        The certified solution of the images' poses.
    refined : CornersRefined
        The answer.
    inliers : dict of (target, sensor) to (V,) booleans
        Images whose pose agrees with the others.
    observations : Observations
        What was refined from: the inliers, with first intrinsics in the place of unknown ones.
    """

    solution: Solution
    refined: CornersRefined
    inliers: dict[Pair, np.ndarray]
    observations: Observations

    def __str__(self) -> str:
        """The answer, and how many images it is from, in a few sentences."""
        left_out = sum(int((~mask).sum()) for mask in self.inliers.values())
        proof = "certified" if self.solution.certificate.is_certified else "not certified"
        return f"{self.refined} The start was {proof}; {left_out} images disagree with the others and are left out."

    def __repr__(self) -> str:
        return f"<CornersCalibrated: {self}>"


@one_blas_thread()
def calibrate_corners(
    observations: Observations, options: CornerOptions | None = None, progress: Progress | None = None
) -> CornersCalibrated:
    """Calibrate from corners: certified poses first, then all together.

    Cameras whose intrinsics are "unknown" in the options (`CornerOptions.stated`) are first calibrated by themselves;
    of what observations state for them only the size of images and the lens model count.

    Parameters
    ----------
    observations : Observations
    options : CornerOptions, optional
    progress : callable, optional

    Raises
    ------
    CameraError
        Unknown intrinsics cannot be estimated, or an image has no pose.
    OptionError
        An argument is of another type.
    TargetError
        A target is not flat.
    RwhecError
        As ``solve``, ``refine`` and ``refine_corners`` do.
    """
    check_arguments(observations, options)
    options, tell = options or CornerOptions(), progress or silent
    cameras = dict(observations.cameras)
    for sensor in observations.sensors:
        if options.stated_of(options.camera_of(sensor)) == "unknown":
            tell(f"estimating the intrinsics of {sensor}")
            cameras[sensor] = first_intrinsics(observations, sensor)
    observations = replace(observations, cameras=cameras)
    robust = RefineOptions(noise="estimate", robust="gnc")
    refined = solved_with_chosen_poses(
        observations, lambda problem: _refined(problem, robust, tell), lambda answer: (answer.X, answer.Y)
    )
    views = {
        pair: view.selected(good)
        for pair, view in observations.views.items()
        if (good := refined.inliers[Pair(*pair)]).any()
    }
    kept = replace(observations, views=views)
    answer = refine_corners(kept, refined.X, refined.Y, options, tell)
    lenses = findings_of_images_left_out(observations, refined.inliers)
    answer = replace(answer, findings=(*answer.findings, *lenses))
    return CornersCalibrated(refined.solution, answer, dict(refined.inliers), kept)


def _refined(problem: Problem, options: RefineOptions, tell: Progress) -> Refined:
    """Poses of the images, refined: a start. What they warn of, the answer's residuals show."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RwhecWarning)
        return refine(problem, solve(problem, progress=tell), options, progress=tell)
