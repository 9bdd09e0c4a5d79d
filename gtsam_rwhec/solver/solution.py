"""The solution of a problem: poses, scale, cost, certificate, identifiability, residuals."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np
from scipy.special import chdtr, chdtrc

from gtsam_rwhec.errors import NotCertifiedWarning, NotUniqueWarning, OptionError, ScaleError, WeightsWarning
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.files.terminal_text import counted
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array, to_pose3
from gtsam_rwhec.problem.knowledge import ScaleMode, checked_scale
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.answers import (
    Answer,
    PairPoses,
    Residual,
    as_point,
    costs_of_pairs,
    given_answer,
    given_poses,
    poses_of,
    residuals_of_pairs,
    rotations_as_variables,
    scales_of,
)
from gtsam_rwhec.solver.certificate import Basis, Cause, Certificate, Objective
from gtsam_rwhec.solver.free_directions import FreeDirection, FreeKind, FreeReason
from gtsam_rwhec.solver.identification import Identifiability, identify
from gtsam_rwhec.solver.nonnegative import run_with_nonnegative_scale
from gtsam_rwhec.solver.parts import Part, connected_components, parts_of
from gtsam_rwhec.solver.region import scale_ratio
from gtsam_rwhec.solver.search import Search, Searched
from gtsam_rwhec.solver.solve_options import (
    Method,
    Poses,
    Scale,
    SolveOptions,
    check_against_knowledge,
    check_method,
    check_types,
)


@dataclass(frozen=True)
class SolvedPart:
    """The names of the frames of one unconnected part, and the certificate of this part."""

    names: tuple[str, ...]
    certificate: Certificate


@dataclass(frozen=True)
class Solution:
    """A calibration; ``str()`` is a few lines: what is proven, the counts, and the scale."""

    #: T_targetcarrier_target of each target and T_sensorcarrier_sensor of each sensor, metres
    X: dict[str, gtsam.Pose3]
    Y: dict[str, gtsam.Pose3]
    #: t_B = scale * true length. It is 1 when known and one number when shared. Else it is one number for each target
    #: (and for each sensor with motions of its own).
    scale: float | dict[str, float]
    scale_mode: ScaleMode
    #: J; half a chi-square when the weights are true. ``is_relative``: all weights are 1, and it has no such meaning.
    cost: float
    is_relative: bool
    certificate: Certificate
    identifiability: Identifiability
    residuals: dict[Pair, Residual]
    #: The unconnected parts, which were solved separately; one part when all frames are connected
    parts: tuple[SolvedPart, ...]

    @property
    def counts(self) -> str:
        """The size of the problem: "16 targets, 8 sensors, 73 pairs, 3230 measurements"."""
        of_pairs = [residual.number_of_measurements for residual in self.residuals.values()]
        counts = {"target": len(self.X), "sensor": len(self.Y), "pair": len(of_pairs), "measurement": sum(of_pairs)}
        return ", ".join(counted(number, word) for word, number in counts.items())

    def __str__(self) -> str:
        if isinstance(self.scale, dict):
            scale = ", ".join(f"{name} {value:.6g}" for name, value in self.scale.items())
        else:
            scale = f"{self.scale:.6g}"
        return f"{self.certificate}\n{self.counts}\nscale ({self.scale_mode}): {scale}"


#: Residuals may cost this many times what the weights predict. The noise is then larger by the root, 1.4 times.
UNLIKELY = 2.0
#: Residuals may cost this share of what the weights predict. The noise is then smaller by the root, half as large.
FAR_SMALLER = 0.25
#: With few degrees of freedom, chance often makes such a cost. Its probability must be smaller than this.
CHANCE = 1e-3


def contradicted_by(cost: float, degrees_of_freedom: int) -> float | None:
    """The cost over its expectation with true weights. It is None where the cost is not surely too large.

    With true weights, twice the cost is a chi-square with ``degrees_of_freedom``, equations minus unknowns.
    """
    ratio = 2.0 * cost / max(degrees_of_freedom, 1)
    is_sure = degrees_of_freedom > 0 and chdtrc(degrees_of_freedom, 2.0 * cost) < CHANCE
    return ratio if is_sure and ratio > UNLIKELY else None


def overstated_by(cost: float, degrees_of_freedom: int) -> float | None:
    """The cost over its expectation, where it is surely far too small: the noise that was stated is too large."""
    ratio = 2.0 * cost / max(degrees_of_freedom, 1)
    is_sure = degrees_of_freedom > 0 and chdtr(degrees_of_freedom, 2.0 * cost) < CHANCE
    return ratio if is_sure and ratio < FAR_SMALLER else None


TWIN = FreeDirection(FreeKind.TWIN, FreeReason.SYMMETRY)


@dataclass(frozen=True)
class PartSolution:
    """One solved part; ``residual_cost`` is the cost of its measurements alone, in the physical model."""

    part: Part
    answer: Answer
    poses: dict[str, Array]
    certificate: Certificate
    identifiability: Identifiability
    residuals: dict[Pair, Residual]
    residual_cost: float

    @staticmethod
    def of(searched: Searched) -> PartSolution:
        """Complete what a search found."""
        part, found = searched.part, searched.found
        with searched.stages.of("identifiability"):
            answer = found.answer
            poses = PairPoses.of(part, answer)
            J_t, J_R = costs_of_pairs(part, poses)
            known = identify(part, poses, J_t, J_R, searched.order)
        bound = found.bound
        if not (np.isfinite(bound.lower_bound) and np.isfinite(found.cost)):
            found = replace(found, cause=Cause.NO_BOUND, figures={})
        elif found.is_closed and not known.is_unique:
            number = float(len(known.free_directions))
            found = replace(found, cause=Cause.FREE_DIRECTIONS, figures={"free_directions": number})
        elif found.is_closed and not bound.definite and searched.has_twin:
            found = replace(found, cause=Cause.TWIN, figures={})
            known = replace(known, is_unique=False, free_directions=(TWIN,))
        certificate = Certificate(
            status=found.cause.status,
            cause=found.cause,
            objective=Objective.of(part),
            basis=Basis.MOMENTS if part.given is None else Basis.MEASUREMENTS,
            region=bound.region,
            path=found.path,
            cost=found.cost,
            lower_bound=bound.lower_bound,
            float_bound=bound.value if bound.definite else bound.lower_bound,
            min_eigenvalue=-max(found.cost - bound.lower_bound, 0.0) if bound.definite else bound.eigenvalue,
            tolerance=found.tolerance,
            is_relative=part.is_relative,
            seconds=dict(searched.stages.seconds),
            figures=found.figures,
        )
        residuals = residuals_of_pairs(part, poses, J_t, J_R)
        cost = float(J_t.sum() + J_R.sum())
        return PartSolution(part, answer, searched.poses, certificate, known, residuals, cost)


def _check_scale(part: Part, answer: Answer, proven: bool) -> None:
    of_frame = scales_of(part, answer)
    scales = {"the scale": answer.scale} if part.scale == "shared" else {}
    scales |= {f"the scale of {name}": of_frame[name] for name in part.free if name in part.scale_owners}
    for what, value in scales.items():
        if not (np.isfinite(value) and value > 0.0):
            raise ScaleError(
                f"{what} is {value:.6g} at the {'optimum' if proven else 'best point found'}, which no real target "
                "has. Either the poses contradict the frame convention (is B = T_sensor_target? is A inverted?), or "
                "the motion was planar, where a mirror image fits too (turn about a second axis), or the "
                "noise is too large to find the scale (SolveOptions(nonnegative_scale=True) constrains a shared one)"
            )


#: Images contradict A where their poses are farther off than any arm or tracker is: rad, m.
ARM_RAD, ARM_M = np.radians(1.0), 0.01


def solve(
    problem: Problem,
    method: Method = "auto",
    *,
    initial: tuple[Poses, Poses, Scale] | None = None,
    options: SolveOptions | None = None,
    progress: Progress | None = None,
) -> Solution:
    """Find the globally optimal poses and scale, with a proof (RWHEC paper, Algorithm 1).

    Parameters
    ----------
    problem : Problem
    method : "auto", "sdp" or "local"
        "auto" descends from a spectral start, certifies by duality, and searches further only if this does not prove
        the answer. "sdp" always solves the semidefinite relaxation. "local" descends from ``initial``.
    initial : (X, Y, scale), optional
        Poses by name, for "local".
    options : SolveOptions, optional
    progress : callable, optional
        Called with the name of each stage as it begins.

    Returns
    -------
    Solution
        A warning says when the measurements leave a direction free (``NotUniqueWarning``), when the answer is not
        proven optimal (``NotCertifiedWarning``), or when the residuals contradict the weights (``WeightsWarning``).

    Raises
    ------
    CountError, FrameError, PriorError, UnderdeterminedError
        For a problem that cannot be solved.
    ScaleError
        When a scale is not positive at the optimum.
    """
    check_method(method)
    check_types(problem, options, progress)
    options = options or SolveOptions()
    if method == "local" and initial is None:
        raise OptionError("method='local' needs initial=(X, Y, scale): poses by name to descend from")
    if method != "local" and initial is not None:
        raise OptionError(f"initial= is for method='local'; method={method!r} makes its own start")
    if options.nonnegative_scale and problem.scale != "shared":
        raise OptionError(f"nonnegative_scale constrains a shared scale; this problem has scale={problem.scale!r}")
    if initial is not None:
        if not (isinstance(initial, tuple) and len(initial) == 3):
            raise OptionError(
                "initial is (X, Y, scale): poses of targets and of sensors by name, and 1.0 if it is known"
            )
        check_against_knowledge(problem, *initial)
    with one_blas_thread(), np.errstate(all="ignore"):
        about = None if initial is None or not problem.directed else poses_of(*initial[:2])
        scale = (
            1.0
            if initial is None or about is None or problem.scale != "shared"
            else checked_scale(initial[2], "the start's scale")
        )
        searched = partial(_searched, method=method, initial=initial, options=options, progress=progress)
        found: Iterable[Searched] = map(searched, parts_of(problem, about, scale))
        if problem.directed:
            rounds, cost = list(found), np.inf
            # Directions of translations are those of an answer: they are taken there again until the answer stays.
            for _ in range(MOST_ROUNDS):
                before, cost = cost, sum(each.found.cost for each in rounds)
                if abs(cost - before) <= STILL * max(cost, 1.0):
                    break
                about = {name: T for each in rounds for name, T in each.poses.items()}
                rounds = [searched(part) for part in parts_of(problem, about, rounds[0].found.answer.scale)]
            found = rounds
        results = [PartSolution.of(each) for each in found]
    return _merge(problem, results)


#: Rounds about the answer of the round before; four to seven are usual.
MOST_ROUNDS = 20
#: An answer stays where a round changes its cost by no more than this part of it, or of 1: it moved by less than a
#: thousandth of a standard deviation.
STILL = 1e-8


def _searched(
    part: Part,
    method: Method,
    initial: tuple[Poses, Poses, Scale] | None,
    options: SolveOptions,
    progress: Progress | None,
) -> Searched:
    """What a search found, but for its forms, which large parts need no more; a ``ScaleError`` for a scale below 0."""
    search = Search.of(part, options, progress)
    if options.nonnegative_scale:
        found = run_with_nonnegative_scale(search)
    elif initial is not None:
        found = search.run(method, rotations_as_variables(part, given_answer(part, *initial).R))
    else:
        found = search.with_positive_scale(search.run(method, None))
    _check_scale(part, found.answer, found.is_closed)
    return search.ended(found)


@one_blas_thread()
@np.errstate(all="ignore")
def certify(
    problem: Problem,
    X: Poses,
    Y: Poses,
    scale: Scale = 1.0,
    *,
    options: SolveOptions | None = None,
    progress: Progress | None = None,
) -> Certificate:
    """Certify a given answer: compare its cost with a rigorous lower bound on the cost of every answer.

    Parameters
    ----------
    problem : Problem
    X, Y : dict of str to pose
        T_targetcarrier_target and T_sensorcarrier_sensor.
    scale : float or dict of str to float
        One number, or one for each target with scale="per_target".
    options : SolveOptions, optional
    progress : callable, optional

    Returns
    -------
    Certificate
        It is about the answer as given. ``Cause.BETTER_ANSWER`` means that the search found a better answer.
        ``Cause.NO_BOUND`` means that it found no finite lower bound, whether it found a better answer or not.

    Raises
    ------
    FrameError, PoseError, ScaleError
        For an answer that lacks a frame, or has an invalid pose or scale.
    PriorError, ScaleError
        For an answer that contradicts a fixed frame or a known scale.
    """
    check_types(problem, options, progress)
    options = options or SolveOptions()
    parts = parts_of(problem)
    check_against_knowledge(problem, X, Y, scale)
    if problem.directed:
        shared = checked_scale(scale, "the answer's scale of all targets") if problem.scale == "shared" else 1.0
        parts = parts_of(problem, poses_of(X, Y), shared)
    certificates = []
    for part in parts:
        given = given_answer(part, X, Y, scale)
        search = Search.of(part, options, progress, contains=given)
        found = search.run("auto", rotations_as_variables(part, given.R))
        evaluation = search.whole.evaluated(given, given_poses(part, X, Y)[:, :3, 3])
        cost = evaluation.upper
        if not np.isfinite(cost):
            raise ScaleError("the cost of the answer overflows; are its translations in metres, and its scale right?")
        tolerance = search.tolerance(cost)
        _check_scale(part, found.answer, found.is_closed)
        best = PartSolution.of(search.ended(found)).certificate
        gap = cost - found.bound.lower_bound
        cause, figures = best.cause, best.figures
        if best.cause is not Cause.NO_BOUND and (
            cost - found.cost > tolerance or (gap > tolerance and best.is_optimal)
        ):
            cause, figures = Cause.BETTER_ANSWER, {"better_cost": found.cost}
        lower, floating = min(best.lower_bound, cost), min(best.float_bound, cost)
        region = best.region and best.region.around(*_distance(part, found.answer, given))
        best = replace(best, cost=cost, lower_bound=lower, float_bound=floating, tolerance=tolerance, region=region)
        certificates.append(replace(best, status=cause.status, cause=cause, figures=figures))
    return Certificate.merged(certificates)


def _distance(part: Part, first: Answer, second: Answer) -> tuple[float, float]:
    """How far apart the translations of two answers are at most, in metres, and the largest ratio of their scales."""
    distance = float(np.linalg.norm(first.t - second.t, axis=1).max(initial=0.0))
    return distance * (1.0 + 1e-9), scale_ratio(as_point(part, first), as_point(part, second))


def _merge(problem: Problem, results: list[PartSolution]) -> Solution:
    """One solution of all parts, with the warnings."""
    poses = {name: to_pose3(T[:3, :3], T[:3, 3]) for name, T in problem.fixed.items()}
    scales: dict[str, float] = {}
    residuals: dict[Pair, Residual] = {}
    for result in results:
        part, answer = result.part, result.answer
        poses |= {name: to_pose3(T[:3, :3], T[:3, 3]) for name, T in result.poses.items()}
        scales |= scales_of(part, answer)
        residuals |= result.residuals
    certificate = Certificate.merged([result.certificate for result in results])
    _warn_of_weights(problem, results)
    # Only a shared scale joins components that no measurement connects into one part.
    components = tuple(result.part.names for result in results)
    if problem.scale == "shared":
        components = tuple(tuple(component) for component in connected_components(problem.pairs))
    known = Identifiability.merged([result.identifiability for result in results], components)
    if not known.is_unique:
        directions = "; ".join(map(str, known.free_directions))
        warnings.warn(f"the measurements do not determine the answer: {directions}", NotUniqueWarning, stacklevel=3)
    if not certificate.is_optimal:
        warnings.warn(f"not proven optimal: {certificate.reason}", NotCertifiedWarning, stacklevel=3)
    scale: float | dict[str, float] = 1.0
    if problem.scale == "per_target":
        scale = {name: scales[name] for name in dict.fromkeys(t for t, _ in problem.pairs)}
    elif problem.scale == "shared":
        scale = results[0].answer.scale
    return Solution(
        X={name: poses[name] for name in problem.targets},
        Y={name: poses[name] for name in problem.sensors},
        scale=scale,
        scale_mode=problem.scale,
        cost=certificate.cost,
        is_relative=problem.is_relative,
        certificate=certificate,
        identifiability=known,
        residuals={pair: residuals[pair] for pair in problem.pairs},
        parts=tuple(SolvedPart(result.part.names, result.certificate) for result in results),
    )


def _warn_of_weights(problem: Problem, results: list[PartSolution]) -> None:
    """Warn where the residuals contradict the weights."""
    # The inverse equation weights residuals otherwise than the physical model, so its cost says nothing about the
    # noise.
    # Of clouds the points' noise is stated alone, and every arm has more.
    if problem.is_relative or problem.is_of_registrations or any(r.part.kind == "inverse" for r in results):
        return
    cost = sum(result.residual_cost for result in results)
    degrees_of_freedom = int(sum(r.part.equations.sum() - r.part.number_of_unknowns for r in results))
    ratio = contradicted_by(cost, degrees_of_freedom)
    if ratio is None:
        return
    # What add_corners made has a noise that nobody stated.
    if all(pair.target in problem.boards and pair.sensor in problem.cameras for pair in problem.pairs):
        _warn_of_images(results)
        return
    warnings.warn(
        f"the residuals cost {cost:.4g}, {ratio:.3g} times what sigma and kappa predict ({cost / ratio:.4g}): the "
        "noise is larger than they say, some measurements are wrong, or A or B is inverted",
        WeightsWarning,
        stacklevel=4,
    )


def _warn_of_images(results: list[PartSolution]) -> None:
    """Warn where images contradict A by more than any arm is off.

    B's covariance is that of the corners' noise alone: errors of A and of intrinsics, which every rig has, are not in
    it, so a cost above the expected one is normal.
    """
    found = {pair: residual for result in results for pair, residual in result.residuals.items()}
    size = {pair: max(of.rotation_rms_rad / ARM_RAD, of.translation_rms_m / ARM_M) for pair, of in found.items()}
    pair = max(size, key=size.__getitem__)
    worst = found[pair]
    if size[pair] > 1.0:
        warnings.warn(
            f"the target's poses by the corners of {pair} are off by {np.degrees(worst.rotation_rms_rad):.2g} degrees "
            f"and {1e3 * worst.translation_rms_m:.3g} mm (rms) from what A and the answer predict, more than an arm or "
            "a tracker is: A is inverted, in another unit or of other images, the board's size is wrong, intrinsics "
            "are far off, or some images are misread (refine with robust='gnc')",
            WeightsWarning,
            stacklevel=5,
        )
