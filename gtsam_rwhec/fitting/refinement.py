"""``refine``: from poses, or on from there by the corners that a problem holds."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace

import gtsam
import numpy as np

from gtsam_rwhec.errors import OptionError, RwhecWarning
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.fitting.corner_refinement import refine_corners
from gtsam_rwhec.fitting.corners_as_refined import as_refined, intrinsics_of, numbers_of
from gtsam_rwhec.fitting.corners_refined import CornersRefined
from gtsam_rwhec.fitting.detector_bias import covariance_of_bias
from gtsam_rwhec.fitting.fit_options import CornerOptions, RefineOptions
from gtsam_rwhec.fitting.joint_covariance import JointCovariance
from gtsam_rwhec.fitting.noise_in_data import NoiseInData
from gtsam_rwhec.fitting.observations import (
    Observations,
    check_corners_can_hold,
    check_corners_everywhere,
    observations_of,
)
from gtsam_rwhec.fitting.refined import Refined
from gtsam_rwhec.fitting.refinement_from_poses import check_inputs
from gtsam_rwhec.fitting.refinement_from_poses import refine as refine_poses
from gtsam_rwhec.fitting.reprojection_record import SIZE, BoardShape
from gtsam_rwhec.fitting.unknowns import Unknown, UnknownKind
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.trajectory import Trajectory
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import nearer_poses
from gtsam_rwhec.solver.solution import Solution

#: Standard deviation of a size that the problem does not know, a share of that which the poses say.
SIZE_SHARE = 0.2


def refine(
    problem: Problem,
    solution: Solution | None,
    options: RefineOptions | None = None,
    *,
    corners: CornerOptions | None = None,
    progress: Progress | None = None,
) -> Refined:
    """Refine a certified solution in GTSAM under the full noise model, with covariances of all unknowns.

    Parameters
    ----------
    problem : Problem
        A problem that kept its raw measurements, unless ``residual="chordal"`` and ``robust="none"``.
    solution : Solution or None
        The start: the result of ``solve`` for this problem. With robust="gnc" it may be None, for outliers may leave
        ``solve`` without an answer (a negative scale); ``moved`` is then from the inliers' solution.
    options : RefineOptions, optional
        With ``observations="corners"`` the poses' refinement is the start of one from the corners that the problem
        holds (``problem.add_corners``), with the cameras' intrinsics and the carriers' poses as variables.
    corners : CornerOptions, optional
        The options of that. Left out: intrinsics are nominal, and A's noise is as in ``options``, or estimated.
    progress : callable, optional
        Is called with the name of each stage.

    Raises
    ------
    FrameError, ScaleError, PriorError
        If the solution is of another problem.
    MeasurementsNotKeptError
        If raw measurements are needed and the problem did not keep them.
    NoiseError, OptionError, CountError
        If the noise cannot be estimated or used, or options contradict each other; if the problem has no corners, not
        of every measurement, or states what a refinement from corners does not hold.
    OutlierError
        With robust="gnc", if too few measurements agree with each other; if corners do not belong to their poses.
    CameraError, UnderdeterminedError
        From corners, as ``refine_corners``.

    Warns
    -----
    NotUniqueWarning
        If the measurements leave directions free, by name; variances are infinite there.
    WeightsWarning
        If the residuals show that the given noise is too small, or measurements share A's noise and
        ``carrier_model="propagated"`` does not treat it so.
    NotConvergedWarning
        If iterations ended at their limit.
    """
    if not isinstance(options, RefineOptions) or options.observations == "poses":
        if corners is not None:
            raise OptionError("corners= has no use without RefineOptions(observations='corners'); give both")
        return refine_poses(problem, solution, options, progress=progress)
    if corners is not None and not isinstance(corners, CornerOptions):
        raise OptionError(f"corners={brief(corners)} are not CornerOptions; give rw.CornerOptions(...), or None")
    poses = replace(options, observations="poses")
    check_inputs(problem, solution, poses)
    check_corners_everywhere(problem)
    check_corners_can_hold(problem)
    if solution is not None:
        problem, _ = nearer_poses(problem, solution.X, solution.Y)
    # of poses, whose noise is not that of the answer
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):
        base = refine_poses(problem, solution, poses, progress=progress)
    refined = from_corners(problem, base, corners or _like(options), progress or silent)
    return replace(refined, options=options)


def _like(options: RefineOptions) -> CornerOptions:
    """Options of a refinement from corners that say what those of the poses say of A's noise."""
    noise = options.carrier_noise
    return CornerOptions(carrier_noise="estimate" if noise is None or noise.covariances is not None else noise)


@one_blas_thread()
def from_corners(problem: Problem, base: Refined, options: CornerOptions, tell: Progress) -> Refined:
    """Refine on from an answer from poses, by the corners of the images that agree with it."""
    observations, options = observed(problem, base, options, base.options.carrier_path)
    tell("refining from corners")
    found = refine_corners(observations, base.X, base.Y, options, tell)
    stated = {name: options.stated_of(options.camera_of(name)) for name in found.Y}
    refined = as_refined(base, found, numbers_of(observations, found, options), intrinsics_of(found, stated))
    return as_stated(refined, base, found)


def observed(
    problem: Problem, base: Refined, options: CornerOptions, carrier_path: Trajectory | None
) -> tuple[Observations, CornerOptions]:
    """The corners of the images that agree with an answer, with boards of the sizes that it says, and what is free."""
    late = base.time_offsets_s
    observations = observations_of(problem, scale=base.scale, time_offsets_s=late, carrier_path=carrier_path)
    if base.inliers:
        kept = {
            pair: view.selected(mask)
            for pair, view in observations.views.items()
            if (mask := base.inliers[Pair(*pair)]).any()
        }
        observations = replace(observations, views=kept)
    if late and not options.time_offsets:
        options = replace(options, time_offsets=tuple(name for name in late if name in observations.sensors))
    gone = set(problem.sensors) - set(observations.sensors)  # all their images are left out
    groups = [tuple(name for name in group if name not in gone) for group in options.shared]
    options = replace(options, shared=tuple(group for group in groups if len(group) > 1))
    if problem.scale == "per_target" and not options.size_share:
        free = [name for name in problem.targets if name not in problem.fixed_scales]
        options = replace(options, size_share=dict.fromkeys(free, SIZE_SHARE))
    return observations, options


def as_stated(refined: Refined, base: Refined, found: CornersRefined) -> Refined:
    """The answer whose scales and sizes are over those that were stated, and time offsets over the stamps.

    It was refined with boards of the sizes that `base` says, and A at its offsets.
    """
    late = {name: base.time_offsets_s.get(name, 0.0) + more for name, more in found.time_offsets_s.items()}
    refined = replace(refined, time_offsets_s=base.time_offsets_s | late)
    if not isinstance(base.scale, Mapping) or not isinstance(refined.scale, Mapping):
        return refined
    free = {unknown.owner for unknown in refined.joint.slots if unknown.kind is UnknownKind.SCALE}
    sizes = {name: value for name, value in base.scale.items() if name in free}
    factor = np.ones(len(refined.joint.unit))
    for name, value in sizes.items():
        factor[refined.joint.slots[Unknown(UnknownKind.SCALE, name)]] = value
    joint = refined.joint
    assert refined.reprojection is not None
    boards = {
        name: _of_stated_size(board, sizes[name]) if name in sizes else board
        for name, board in refined.reprojection.boards.items()
    }
    return replace(
        refined,
        scale={name: value * sizes.get(name, 1.0) for name, value in refined.scale.items()},
        joint=JointCovariance(joint.slots, joint.finite * np.outer(factor, factor), joint.free, joint.unit),
        reprojection=replace(refined.reprojection, boards=boards),
    )


def _of_stated_size(board: BoardShape, scale: float) -> BoardShape:
    """A board's numbers where its size is over the stated one, which is `scale` times what it was taken to be."""
    values = [(1.0 + v) / scale - 1.0 if n == SIZE else v for n, v in zip(board.names, board.values, strict=True)]
    deviations = [d / scale if n == SIZE else d for n, d in zip(board.names, board.standard_deviations, strict=True)]
    return replace(board, values=tuple(values), standard_deviations=tuple(deviations))


def beyond_independent_errors(
    corners: CornersRefined, found: NoiseInData | None, wider: Mapping[tuple[str, str], float]
) -> Array:
    """The covariance (d, d) to add to that of the corners' unknowns.

    Parameters
    ----------
    found : NoiseInData or None
        What the poses say of their noise. Where A counts as exact its errors are in intrinsics and boards too: these
        widen as the poses do.
    wider : dict of (letter, name) to float
        By how much the deviations of each unknown of `corners` are widened, since images that were left out show that
        the model lacks something that nothing else tells of.
    """
    size = len(corners.joint)
    scale = np.ones(size)
    for slot, factor in wider.items():
        scale[corners.slots[slot]] = max(factor, 1.0)
    if found is not None:
        letters = "xyt" if corners.noise.carrier is not None else "xytkbp"
        of_poses = np.sqrt(max(found.instants / max(found.worth, 1e-300), 1.0))
        for (letter, _), rows in corners.slots.items():
            if letter in letters:  # both see errors that neighbours share
                scale[rows] = np.maximum(scale[rows], of_poses)
    more: Array = corners.joint * (np.outer(scale, scale) - 1.0) + covariance_of_bias(corners)
    if found is None:
        return more
    carriers: tuple[tuple[str, dict[str, gtsam.Pose3]], ...] = (("x", corners.X), ("y", corners.Y))
    for (letter, poses), deviations in zip(carriers, found.constant_deviations, strict=True):
        shift = np.zeros((size, 6))
        for name, pose in poses.items():
            shift[corners.slots[letter, name]] = pose.inverse().AdjointMap() * np.array(deviations)
        more = more + shift @ shift.T
    return more
