"""What a new log says about an old answer: its own estimate, found from the old poses on, under its own noise.

Nothing is solved anew: the noise of the new log and one linear model about the old poses, settled in a few steps, give
the estimate and its covariance. Directions that a short log leaves free are free in it.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.calibration.moved_frames import residual_twists
from gtsam_rwhec.errors import CountError, RwhecWarning
from gtsam_rwhec.files.progress import Progress, silent
from gtsam_rwhec.fitting.block_agreement import scatter_of_blocks, too_much
from gtsam_rwhec.fitting.component_posterior import FEWEST, mixture_of
from gtsam_rwhec.fitting.fit_options import NoiseOptions, RefineOptions
from gtsam_rwhec.fitting.joint_covariance import JointCovariance, free_space_of
from gtsam_rwhec.fitting.noise_in_data import is_drift_doubted, settled
from gtsam_rwhec.fitting.noise_refinement import SPARE_EQUATIONS, agreeing
from gtsam_rwhec.fitting.noise_rows import Instants
from gtsam_rwhec.fitting.noise_search import Settled, Task, moved, thinned
from gtsam_rwhec.fitting.refined import RefinedPoses
from gtsam_rwhec.fitting.refinement_from_poses import data_of, scale_of, sensors_with_offset
from gtsam_rwhec.fitting.unknowns import State, Unknown, UnknownKind, Variables
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import selected
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solver.solution import solve

#: A measurement that is farther off than this many times the median, as seen from either end, is a gross error.
GROSS = 10.0
#: Gross errors are no smaller than this, rad and m.
SMALLEST_GROSS = np.radians(0.5), 0.005
#: Outliers are chosen again at most this many times.
MAX_CHOICES = 4


@dataclass(frozen=True)
class NearAnswer:
    """What a new log says near an old answer."""

    #: The old answer with the poses, scales, clocks and covariance of the new log; its noise and cost are the old ones
    refined: RefinedPoses
    degrees_of_freedom: float  #: Of this covariance
    inliers: dict[Pair, np.ndarray]  #: (N,) booleans: the measurements that agree with one another
    free: tuple[str, ...]  #: Directions that the new log leaves free, in words


def near(
    old: RefinedPoses, problem: Problem, how: RefineOptions, noise: NoiseOptions, progress: Progress | None = None
) -> NearAnswer:
    """The estimate of a problem's measurements near an old answer that has all its frames.

    Raises
    ------
    CountError
        There are too few measurements to tell their noise.
    UnderdeterminedError
        There are fewer equations than unknowns.
    """
    tell = progress or silent
    inliers = without_gross_errors(old, problem)
    task, found = _settled(old, selected(problem, inliers), how, noise, tell)
    for _ in range(MAX_CHOICES):
        tell("judging outliers")
        again = agreeing(problem, inliers, task, found, how)
        is_settled = all(np.array_equal(mask, inliers[pair]) for pair, mask in again.items())
        if is_settled or not all(mask.any() for mask in again.values()):  # frames of an empty pair could not be tested
            break
        inliers = again
        task, found = _settled(old, selected(problem, inliers), how, noise, tell)
    tell("covariances")
    mixture = mixture_of(thinned(found.model), found.fit, found.model)
    basis = found.model.basis
    state = moved(found.state, task.variables, task.layout, basis @ mixture.step)
    worst = too_much(scatter_of_blocks(task, found), is_drift_doubted=is_drift_doubted(task, found))
    finite = basis @ mixture.covariance @ basis.T * (1.0 if worst is None else worst.ratio)
    frames = [
        rows
        for unknown, rows in task.layout.slots.items()
        if unknown.kind is UnknownKind.FRAME and not task.layout.free[rows].any()
    ]
    freedom = min((mixture.degrees_of_freedom(basis[rows]) for rows in frames), default=float(np.inf))
    spare = 6 * task.problem.number_of_measurements - len(task.layout.unit)
    found_poses = replace(
        old,
        X=state.X,
        Y=state.Y,
        scale=scale_of(task.problem, state),
        time_offsets_s=state.offsets_s,
        joint=replace(task.layout, finite=finite),
        intrinsics={},
    )
    return NearAnswer(
        found_poses,
        degrees_of_freedom=min(freedom, max(0.5 * spare, FEWEST), np.inf if worst is None else worst.freedom),
        inliers=inliers,
        free=tuple(map(str, task.free_directions)),
    )


def _settled(
    old: RefinedPoses, problem: Problem, how: RefineOptions, noise: NoiseOptions, tell: Progress
) -> tuple[Task, Settled]:
    """The noise and the estimate of some measurements, from the old answer on."""
    offsets = sensors_with_offset(problem, how)
    variables = Variables.of(problem, offsets)
    unknowns = sum(unknown.dimension for unknown in variables.unknowns)
    spare = 6 * problem.number_of_measurements - unknowns
    if spare < SPARE_EQUATIONS:
        raise CountError(
            f"{problem.number_of_measurements} measurements of {len(problem.targets)} targets by "
            f"{len(problem.sensors)} sensors are too few to tell their noise, and so whether the old calibration "
            f"holds; measure from {-(-(SPARE_EQUATIONS - spare) // 6)} more poses at least"
        )
    data = data_of(problem, variables, how)
    state, parts = _start(old, variables), parts_of(problem)
    space = free_space_of(parts, variables, state, data)
    if space.directions:  # the motion is poor; or residuals are so large that it looks so, and another start is needed
        with warnings.catch_warnings(action="ignore", category=RwhecWarning):
            there = variables.start(solve(problem))
        other = free_space_of(parts, variables, there, data)
        if len(other.directions) < len(space.directions):
            state, space = there, other
    layout = JointCovariance.of(variables.unknowns, np.eye(len(space.unit)), space.basis, space.unit)
    task = Task(problem, data, variables, layout, Instants.of(data), noise, space.directions, tell).cut_at_jumps(state)
    task, found = task.without_false_jumps(settled(task, state, tell))
    return task.without_noise(found)


def _start(old: RefinedPoses, variables: Variables) -> State:
    scale = old.scale
    return State(
        {name: old.X[name] for name in variables.targets},
        {name: old.Y[name] for name in variables.sensors},
        {unknown: scale[unknown.owner] if isinstance(scale, dict) else scale for unknown in variables.scales},
        dict.fromkeys(variables.offsets, 0.0),
    )


def stated_as(old: RefinedPoses, problem: Problem) -> Problem:
    """The measurements of frames that the old answer has, with what was known of these: fixed frames, sizes."""
    stated = Problem(old.scale_mode)
    for pair in problem.pairs:
        if pair.is_motion or pair.target not in old.X or pair.sensor not in old.Y:
            continue
        one = problem.measurements(*pair)
        weights = {"covariances": one.covariances} if one.covariances is not None else {}
        if not weights and not problem.is_relative:
            weights = {"sigma": one.sigma, "kappa": one.kappa}
        stated.add(*pair, one.A, one.B, stamps_ns=one.stamps_ns, **weights)  # type: ignore[arg-type]
    for poses, names in ((old.X, stated.targets), (old.Y, stated.sensors)):
        for name in names:
            if Unknown(UnknownKind.FRAME, name) not in old.joint.slots:
                stated.fix(name, poses[name])
    if isinstance(old.scale, dict):
        for name in stated.targets:
            if Unknown(UnknownKind.SCALE, name) not in old.joint.slots:
                stated.fix_scale(name, old.scale[name])
    return stated


def without_gross_errors(old: RefinedPoses, problem: Problem) -> dict[Pair, np.ndarray]:
    """Masks (N,) of measurements that are not far off, as seen from the sensor or from the target.

    A sensor that moved changes all B alike by a motion on the left, a target that moved by one on the right. A
    measurement that is far from the median of the others in both ways is a gross error.
    """
    result = {}
    for pair in problem.pairs:
        one = problem.measurements(*pair)
        of_target, of_sensor = residual_twists(old, pair, one.A, one.B)
        result[pair] = ~(_far_off(of_target) & _far_off(of_sensor))
    return result


def _far_off(xi: Array) -> np.ndarray:
    """Which twists (N, 6) are far from the median, in rotation or in translation."""
    away = xi - np.median(xi, axis=0)
    sizes = np.linalg.norm(away.reshape(-1, 2, 3), axis=2)
    limit = np.maximum(GROSS * np.median(sizes, axis=0), SMALLEST_GROSS)
    far: np.ndarray = (sizes > limit).any(axis=1)
    return far
