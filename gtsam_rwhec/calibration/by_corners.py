"""The answer from the corners that a problem holds, and the problem again under what that answer says of its images.

The poses of boards come first: they give the certified start, the outliers among images and the noise in time and over
the configuration. They were computed by the stated intrinsics, and a flat board's pose was chosen of two: where the
answer says otherwise, they are computed again, and all is settled once more.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gtsam_rwhec.calibration.clock_stage import Answer
from gtsam_rwhec.calibration.corner_choice import thinned
from gtsam_rwhec.calibration.corner_stage import CornersFound, corners_found
from gtsam_rwhec.calibration.options import CalibrateOptions
from gtsam_rwhec.calibration.run import Run
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CountError, MeasurementsNotKeptError, OptionError, RwhecError
from gtsam_rwhec.fitting.corner_findings import is_doubtful
from gtsam_rwhec.fitting.corner_refinement import refine_corners
from gtsam_rwhec.fitting.corners_refined import RefinedIntrinsics
from gtsam_rwhec.fitting.fit_options import CornerOptions
from gtsam_rwhec.fitting.observations import Observations, check_corners_can_hold, check_corners_everywhere
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.refinement import as_stated, observed
from gtsam_rwhec.problem.nearer_poses import nearer_poses
from gtsam_rwhec.problem.problem import Problem

#: Poses of targets are computed again at most so often.
AGAIN = 2
#: Intrinsics are other ones than the stated ones where a parameter is off by so many standard deviations, and the image
#: by so many pixels (root mean square).
MOVED, MOVED_PX = 3.0, 0.5
#: So many columns and rows of the image are looked at.
GRID = 9


def check_observations(problem: Problem, options: CalibrateOptions) -> None:
    """A CountError or OptionError where corners are wanted, and the problem lacks them, or holds what they cannot."""
    if options.observations == "corners":
        check_corners_everywhere(problem)
        check_corners_can_hold(problem)


def with_better_poses(run: Run, found: Answer) -> Run | None:
    """The run again with images whose poses are those that the answer says, or None where they have them already.

    Intrinsics are looked at once, in a part of the images where they are many.
    """
    base = found.refined
    if base is None or base.free_directions or not run.problem.boards or run.times > AGAIN:
        return None
    X, Y, cameras = base.X, base.Y, dict(run.cameras)
    if run.options.observations != "poses" and not _why_not(run, base):
        observations, options = _observed(run, base, found)
        try:
            corners = refine_corners(thinned(observations), X, Y, options, run.tell)
        except RwhecError:  # then the answer is from the poses, and says why
            return None
        if is_doubtful(corners):
            return None
        X, Y = corners.X, corners.Y
        for name, one in corners.intrinsics.items():
            if name not in cameras and _have_moved(one, run.problem.cameras[name]):
                cameras[name] = one.camera
    better, changed = nearer_poses(run.problem, X, Y, cameras)
    is_new = len(cameras) > len(run.cameras)
    return run.again(better, cameras) if is_new or changed else None


def answered_by_corners(run: Run, found: Answer) -> Answer:
    """The answer from the corners, where the problem has them and they give a better one; what was chosen is noted."""
    base = found.refined
    if base is None or not run.problem.boards or run.options.observations == "poses":
        return found
    why = _why_not(run, base)
    if why:
        of_corners = CornersFound.none(why)
    else:
        observations, options = _observed(run, base, found)
        of_corners = corners_found(base.X, base.Y, observations, options, run.tell)
    run.record.choices += of_corners.choices
    run.record.findings += of_corners.findings
    if of_corners.corners is None:
        return found
    return replace(found, refined=as_stated(of_corners.refined(base, found.noise.model), base, of_corners.corners))


def _why_not(run: Run, base: Refined) -> str:
    """Why the problem's corners cannot be refined from; empty where they can."""
    try:
        check_corners_everywhere(run.problem)
        check_corners_can_hold(run.problem)
    except (CountError, OptionError, MeasurementsNotKeptError) as error:
        return str(error)
    return "the motion leaves poses free" if base.free_directions else ""


def _observed(run: Run, base: Refined, found: Answer) -> tuple[Observations, CornerOptions]:
    noise, model = run.options.carrier_noise, found.noise.model
    options = run.options.corners or CornerOptions(
        carrier_noise="estimate" if noise is None or noise.covariances is not None else noise,
        about="targetcarrier" if model is None else model.hand,
    )
    return observed(run.problem, base, options, run.options.carrier_path)


def _have_moved(found: RefinedIntrinsics, stated: Camera) -> bool:
    """Whether intrinsics are surely others than the stated ones, and by enough to move poses."""
    size = np.array([stated.width, stated.height])
    pixels = np.stack(np.meshgrid(*np.linspace(0.0, size - 1.0, GRID).T), axis=-1)
    off = np.linalg.norm(stated.pixels(found.camera.undistort(pixels)) - pixels, axis=-1)
    is_sure = bool((np.abs(found.innovation.off) > MOVED * np.array(found.standard_deviations)).any())
    return is_sure and bool(np.nanmean(off**2) > MOVED_PX**2)
