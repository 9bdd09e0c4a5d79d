"""``refine``: GTSAM's poses and covariances under the full noise model, from the certified solution."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import gtsam
import numpy as np

from gtsam_rwhec.errors import (
    FrameError,
    NotConvergedWarning,
    NotUniqueWarning,
    OptionError,
    RwhecWarning,
    ScaleError,
    WeightsWarning,
)
from gtsam_rwhec.files.progress import Progress, check_progress, silent
from gtsam_rwhec.fitting.admission import inlier_threshold
from gtsam_rwhec.fitting.fit_options import NoiseGroups, RefineOptions
from gtsam_rwhec.fitting.joint_covariance import FreeSpace, JointCovariance, free_space_of
from gtsam_rwhec.fitting.pair_data import FactorsByPair, Group, PairData, group_of, local_paths, residual_covariance
from gtsam_rwhec.fitting.pose_fit import ChordalModel, GeodesicModel, Model, SettledFit, fit, linearized
from gtsam_rwhec.fitting.refined import FactorGraph, Movement, PairNoise, Refined
from gtsam_rwhec.fitting.robust_solution import Inliers, robust_solution
from gtsam_rwhec.fitting.unknowns import State, Unknown, UnknownKind, Variables
from gtsam_rwhec.fitting.weighted_fit import as_of_six
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.geometry.real_numbers import check_kind
from gtsam_rwhec.geometry.trajectory import WINDOW_S
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.selection import AS_STATED, VarianceFactors, aligned_at, selected
from gtsam_rwhec.solver.answers import parts_about
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solver.solution import Solution, contradicted_by, solve
from gtsam_rwhec.solver.solve_options import check_against_knowledge

#: The inliers are chosen again under the full noise at most this many times; two or three are usual.
MAX_CHOICES = 10


@one_blas_thread()
def refine(
    problem: Problem,
    solution: Solution | None,
    options: RefineOptions | None = None,
    *,
    progress: Progress | None = None,
    near: Refined | None = None,
) -> Refined:
    """The part of ``rw.refine`` that is from poses: `gtsam_rwhec.fitting.refinement.refine` describes it.

    Where the noise is estimated, that of ``near``, an answer of nearly the same measurements, is the start.
    Warnings point to the caller of that function, one frame above this one's.
    """
    options = RefineOptions() if options is None else options
    check_progress(progress)
    tell = progress or silent
    check_inputs(problem, solution, options)
    if problem.directed:
        about = solution or _any_inliers(problem, options, tell)
        problem = aligned_at(problem, about.X, about.Y, about.scale)
    estimates = options.noise == "estimate" or (options.noise == "auto" and problem.is_relative)
    everything = Variables.of(problem, sensors_with_offset(problem, options))
    data = data_of(problem, everything, options)
    inliers: Inliers = {}
    factors: FactorsByPair = {}
    start, whole, judged = solution, problem, problem
    if options.robust == "gnc":
        tell("rejecting outliers")
        if data and (problem.has_covariances or options.carrier_noise is not None or everything.offsets):
            guess = everything.start(solution or _any_inliers(problem, options, tell))
            if everything.offsets:  # a clock offset makes outliers wherever the carrier moves
                first = GeodesicModel.of(data, everything, replace(options, robust="huber"))
                tell("a first estimate of the time offsets")
                rough = fit(problem, first, everything, guess, options, estimates, tell)
                guess = everything.state(rough.optimum.values)
            judged = under_worst_axis(problem, data, everything, guess)
        found = robust_solution(
            judged,
            confidence=options.inlier_confidence,
            noise_scale="estimate" if estimates else "given",
            progress=progress,
        )
        start, inliers = found.solution, found.inliers
        factors = dict.fromkeys(problem.pairs, found.variance_factors) if estimates else {}
    assert start is not None
    before = solution or start
    if judged is not whole:
        start, inliers, factors = _chosen_under_full_noise(whole, data, start, inliers, options, estimates, tell)
    if inliers:
        problem = selected(whole, inliers)
    variables = _variables(whole, problem, options)
    kept = _kept(problem, data, inliers)
    model = GeodesicModel.of(kept, variables, options) if kept else ChordalModel(parts_of(problem), variables)
    if near is not None and estimates and not factors:
        factors = _factors_of(near, model, options.noise_groups)
    tell("refining")
    settled = fit(problem, model, variables, variables.start(start), options, estimates, tell, factors)
    state = variables.state(settled.optimum.values)
    tell("covariances")
    parts = parts_about(problem, state.X, state.Y, scale_of(problem, state))
    space = free_space_of(parts, variables, state, kept, None if options.robust in ("none", "gnc") else settled.factors)
    if space.directions:
        warnings.warn(
            "the measurements leave directions free, along which variances are infinite: "
            + "; ".join(map(str, space.directions)),
            NotUniqueWarning,
            stacklevel=4,
        )
    if not estimates:
        _warn_of_weights(problem, variables, settled, options)
    joint = JointCovariance.of(variables.unknowns, settled.information, space.basis, space.unit)
    _warn_of_offsets(space, joint, state)
    keys = {str(unknown): key for unknown, key in variables.keys.items()}
    return Refined(
        X=state.X,
        Y=state.Y,
        scale=scale_of(problem, state),
        scale_mode=problem.scale,
        time_offsets_s=state.offsets_s,
        factor_graph=partial(FactorGraph, settled.graph, settled.optimum.values, keys),
        noise_source="estimated" if estimates else "given",
        noise=_noise(model, settled, options, estimates),
        cost=settled.optimum.cost,
        initial_cost=settled.graph.error(model.values(variables.start(before))),
        iterations=settled.iterations,
        moved=movements(before, state.X, state.Y),
        inlier_counts={pair: (int(kept.sum()), len(kept)) for pair, kept in inliers.items()},
        inliers=inliers,
        free_directions=space.directions,
        solution=start,
        options=options,
        joint=joint,
    )


def _factors_of(near: Refined, model: Model, groups: NoiseGroups) -> FactorsByPair:
    """The variance factors of an answer's noise, one of each group of pairs."""
    given, found = model.given_noise, dict[Group, VarianceFactors]()
    for pair in filter(near.noise.__contains__, given):
        of, (rotation, translation) = near.noise[pair], given[pair]
        if rotation and translation:
            factors = VarianceFactors((of.rotation_rad / rotation) ** 2, (of.translation_m / translation) ** 2)
            found.setdefault(group_of(pair, groups), factors)
    return {pair: found[group] for pair in given if (group := group_of(pair, groups)) in found}


def _variables(whole: Problem, problem: Problem, options: RefineOptions) -> Variables:
    offsets = tuple(name for name in sensors_with_offset(whole, options) if name in problem.sensors)
    return Variables.of(problem, offsets)


def _kept(problem: Problem, data: list[PairData], inliers: Inliers) -> list[PairData]:
    return [item.selected(inliers[item.pair]) if inliers else item for item in data if item.pair in problem.pairs]


def _chosen_under_full_noise(
    whole: Problem,
    data: list[PairData],
    start: Solution,
    inliers: Inliers,
    options: RefineOptions,
    estimates: bool,
    tell: Progress,
) -> tuple[Solution, Inliers, FactorsByPair]:
    """The inliers chosen again under the full noise until they stay, their certified solution, and the noise found.

    A's noise is propagated here: to judge single measurements needs no variable for each carrier pose, of which a log
    has thousands.
    """
    single = replace(options, carrier_model="propagated")
    threshold = inlier_threshold(options.inlier_confidence, whole.number_of_measurements)
    factors: FactorsByPair = {}
    solution, chosen = start, inliers
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):  # the last fit has its own
        for step in range(1, MAX_CHOICES + 1):
            tell(f"choosing the inliers under the full noise, step {step} of at most {MAX_CHOICES}")
            problem = selected(whole, chosen)
            solution = start if step == 1 else solve(problem)
            variables = _variables(whole, problem, options)
            model = GeodesicModel.of(_kept(problem, data, chosen), variables, single)
            settled = fit(problem, model, variables, variables.start(solution), single, estimates, tell, factors)
            factors = settled.factors
            state = variables.state(settled.optimum.values)
            again = inliers_of(data, variables, state, factors, threshold)
            if step == MAX_CHOICES or all(np.array_equal(again[pair], mask) for pair, mask in chosen.items()):
                break
            chosen = again
    return solution, chosen, factors


def _any_inliers(problem: Problem, options: RefineOptions, tell: Progress) -> Solution:
    """A start from the measurements that agree under isotropic noise, whatever its size."""
    # the inliers are chosen again under the full noise
    with warnings.catch_warnings(action="ignore", category=RwhecWarning):
        return robust_solution(
            problem, confidence=options.inlier_confidence, noise_scale="estimate", progress=tell
        ).solution


def _warn_of_weights(problem: Problem, variables: Variables, settled: SettledFit, options: RefineOptions) -> None:
    """Warn if the residuals contradict the given noise: covariances are then too small."""
    if options.robust not in ("none", "gnc"):  # a loss changes the cost
        return
    beliefs = [p for name, priors in problem.priors.items() if name not in problem.fixed for p in priors]
    equations = problem.number_of_equations + sum(
        3 * (p.sigma is not None) + 3 * (p.kappa is not None) for p in beliefs
    )
    cost = settled.optimum.cost
    ratio = contradicted_by(cost, equations - sum(unknown.dimension for unknown in variables.unknowns))
    if ratio is not None:
        warnings.warn(
            f"the residuals cost {cost:.4g}, {ratio:.3g} times the cost that the given noise predicts "
            f"({cost / ratio:.4g}): standard deviations are too small by about {math.sqrt(ratio):.2g}; "
            "take noise='estimate', robust='gnc' if some measurements are wrong, or carrier_noise if A is not exact",
            WeightsWarning,
            stacklevel=5,
        )


def _warn_of_offsets(space: FreeSpace, joint: JointCovariance, state: State) -> None:
    """Warn if a time offset is larger than ``WINDOW_S``, or if its bias exceeds half its standard deviation."""
    for sensor, part in space.shrinkage.items():
        offset_s, what = abs(state.offsets_s[sensor]), f"the time offset of {sensor}"
        unknown = Unknown(UnknownKind.TIME_OFFSET, sensor)
        if offset_s > WINDOW_S:
            warnings.warn(
                f"{what} is {offset_s:.3g} s, but the carriers' motion is known only within {WINDOW_S:g} s of each "
                "stamp; shift the stamps first (cleaning.estimate_time_offset finds the shift)",
                NotConvergedWarning,
                stacklevel=5,
            )
        elif part * offset_s > 0.5 * math.sqrt(joint.covariance_of(joint.selector((unknown,)))[0, 0]):
            warnings.warn(
                f"{what}: {100.0 * part:.2g} % of the carriers' velocity is noise, which pulls the offset towards zero "
                f"by about {1e3 * part * offset_s:.2g} ms. This is more than half of its standard deviation; move "
                "faster, or log poses more often",
                WeightsWarning,
                stacklevel=5,
            )


def data_of(problem: Problem, variables: Variables, options: RefineOptions) -> list[PairData]:
    """The raw data of every pair; empty for the chordal residual, which takes moments."""
    if options.residual == "chordal":
        if problem.has_covariances:
            raise OptionError(
                "some measurements have full covariances, which the chordal residual cannot hold; take "
                "residual='geodesic', or add the measurements with sigma and kappa"
            )
        return []
    problem.require_raw_measurements("residual='geodesic' (unlike residual='chordal')")
    paths = local_paths(problem, tuple(variables.offsets), options.carrier_path)
    return [PairData.of(problem, pair, options, paths.get(pair)) for pair in problem.pairs]


def scale_of(problem: Problem, state: State) -> float | dict[str, float]:
    """The scale of a problem at an estimate, as ``Refined.scale`` has it."""
    if problem.scale == "known":
        return 1.0
    found = {unknown.owner: value for unknown, value in state.scales.items()}
    if problem.scale == "shared":
        return found[""]
    names = dict.fromkeys(pair.target for pair in problem.pairs)
    return {name: (problem.fixed_scales | found)[name] for name in names}


def _noise(model: Model, settled: SettledFit, options: RefineOptions, estimates: bool) -> dict[Pair, PairNoise]:
    result = {}
    for pair, (rotation, translation) in model.given_noise.items():
        factors = settled.factors[pair]
        rotation, translation = rotation * math.sqrt(factors.rotation), translation * math.sqrt(factors.translation)
        degrees_of_freedom = (np.inf, np.inf)
        if estimates:
            group = group_of(pair, options.noise_groups)
            degrees_of_freedom = (
                settled.degrees_of_freedom[group, "rotation"],
                settled.degrees_of_freedom[group, "translation"],
            )
        result[pair] = PairNoise(rotation, translation, degrees_of_freedom)
    return result


def movements(start: Solution, X: Mapping[str, gtsam.Pose3], Y: Mapping[str, gtsam.Pose3]) -> dict[str, Movement]:
    """How far each frame moved from a certified solution."""
    moved = {}
    for before, after in ((start.X, X), (start.Y, Y)):
        for name, pose in after.items():
            difference = before[name].between(pose)
            angle = float(np.linalg.norm(gtsam.Rot3.Logmap(difference.rotation())))
            moved[name] = Movement(1e3 * float(np.linalg.norm(difference.translation())), float(np.degrees(angle)))
    return moved


def under_worst_axis(problem: Problem, data: list[PairData], variables: Variables, state: State) -> Problem:
    """The problem with isotropic noise: the noise of B and A together along its worst axis.

    ``state`` gives the lever arms of A's noise, and the carriers' poses when a sensor's clock is off.
    """
    at = linearized(data, variables, state)
    edges = {}
    for item in data:
        C = residual_covariance(item, at[item.pair], AS_STATED)
        scale = problem.fixed_scales.get(item.pair.target, 1.0)  # the data are in true metres
        A = item.residuals.A
        if item.paths is not None:
            A = A @ item.paths.motion(state.offsets_s[item.pair.sensor])
        raw = problem.measurements(*item.pair)
        if item.slides is not None:  # what weighs by direction keeps its directions
            unit = np.repeat([1.0, scale], 3)
            edges[item.pair] = replace(raw, A=A, covariances=C * unit[:, None] * unit)
            continue
        edges[item.pair] = replace(
            raw,
            A=A,
            sigma=scale * np.sqrt(np.linalg.eigvalsh(C[:, 3:, 3:])[:, -1]),
            kappa=0.5 / np.linalg.eigvalsh(C[:, :3, :3])[:, -1],
            covariances=None,
        )
    return problem.with_measurements(edges)


def inliers_of(
    data: list[PairData], variables: Variables, state: State, factors: FactorsByPair, threshold: float
) -> Inliers:
    """By pair, (N,) booleans: r' C^-1 r is within the threshold. False where the estimate lacks a frame."""
    known = set(state.X) | set(state.Y)
    present = [item for item in data if known.issuperset(item.pair)]
    at = linearized(present, variables, state)
    result = {item.pair: np.zeros(item.count, dtype=bool) for item in data}
    everywhere = next(iter(factors.values()))
    for item in present:
        r = at[item.pair].residual
        C = residual_covariance(item, at[item.pair], factors.get(item.pair, everywhere))
        square: Array = np.einsum("ni,ni->n", r, np.linalg.solve(C, r[:, :, None])[:, :, 0])
        result[item.pair] = as_of_six(square, item.told) <= threshold
    return result


def check_inputs(problem: Problem, solution: Solution | None, options: RefineOptions) -> None:
    """Refuse a problem that cannot be refined from this solution with these options; ``refine`` lists the errors."""
    check_kind(problem, Problem, "the problem", "a gtsam_rwhec.Problem")
    if not isinstance(solution, Solution) and (solution is not None or getattr(options, "robust", "") != "gnc"):
        raise OptionError(
            f"the solution is a {type(solution).__name__}; give what gtsam_rwhec.solve returned (or None with "
            "robust='gnc')"
        )
    check_kind(options, RefineOptions, "options", "a gtsam_rwhec.RefineOptions")
    if options.observations == "corners":
        raise OptionError("observations='corners': call gtsam_rwhec.refine, which refines on from here by the corners")
    problem.require_pairs()
    if solution is not None:
        _check_solution(problem, solution)
    if options.noise == "given" and problem.is_relative:
        raise OptionError(
            "noise='given', but some measurements were added without sigma or kappa; take noise='estimate', or add "
            "sigma and kappa"
        )
    if options.robust == "gnc":
        problem.require_raw_measurements("robust='gnc'")


def _check_solution(problem: Problem, solution: Solution) -> None:
    if solution.scale_mode != problem.scale:
        raise ScaleError(
            f"the solution is of a problem with scale={solution.scale_mode!r}, but this problem has "
            f"scale={problem.scale!r}; solve this problem first"
        )
    try:
        check_against_knowledge(problem, solution.X, solution.Y, solution.scale)
    except FrameError as error:
        raise FrameError(f"the solution is of another problem; solve this problem first ({error})") from error


def sensors_with_offset(problem: Problem, options: RefineOptions) -> tuple[str, ...]:
    """The sensors whose time offsets are to be estimated."""
    if isinstance(options.time_offsets, bool):
        return problem.sensors if options.time_offsets else ()
    for name in options.time_offsets:
        if name not in problem.sensors:
            raise FrameError(
                f"RefineOptions.time_offsets names {name!r}, which is not a sensor; give any of "
                f"{', '.join(problem.sensors)}"
            )
    return tuple(options.time_offsets)
