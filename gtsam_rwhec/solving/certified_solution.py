"""``solve`` and ``certify``: a problem in, a proven calibration out."""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Mapping

import gtsam
import numpy as np

from gtsam_rwhec.errors import (
    FrameError,
    NotCertifiedWarning,
    NotUniqueWarning,
    OptionError,
    PriorError,
    ScaleError,
    WeightsWarning,
)
from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.poses import PoseLike, one_transform, to_pose3
from gtsam_rwhec.identifiability import identification as identifiability
from gtsam_rwhec.identifiability.identification import Identifiability, identify
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.priors import difference
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver import certificate as certificates
from gtsam_rwhec.solver.certificate import OBJECTIVES, Certificate, Status
from gtsam_rwhec.solver.nonnegative import run_with_nonnegative_scale
from gtsam_rwhec.solver.options import Method, SolveOptions, check_method
from gtsam_rwhec.solver.parts import Part, connected_components, parts_of
from gtsam_rwhec.solver.residuals import PairPoses, Residual, costs_of_pairs, residuals_of_pairs
from gtsam_rwhec.solver.search import Found, Search
from gtsam_rwhec.solver.variables import Answer, answer_of, as_variables, given_answer, rotations_as_variables
from gtsam_rwhec.solving.solution import Solution, SolvedPart

Poses = Mapping[str, PoseLike]
Scale = float | Mapping[str, float]

#: An answer's known frames (entries, rad and m) and scales may differ from the problem's by this much: files round.
ROUNDING = 1e-9


def solve(
    problem: Problem,
    method: Method = "auto",
    *,
    initial: tuple[Poses, Poses, Scale] | None = None,
    options: SolveOptions | None = None,
    progress: Progress | None = None,
) -> Solution:
    """Calibrate: the globally optimal poses and scale, with a proof (RWHEC paper, Algorithm 1).

    Parameters
    ----------
    problem : Problem
    method : "auto", "sdp" or "local"
        "auto" descends from a spectral start, certifies by duality, and looks further only where that does not
        suffice; "sdp" always solves the semidefinite relaxation; "local" descends from ``initial``.
    initial : (X, Y, scale), optional
        Poses by name, for "local".
    options : SolveOptions, optional
    progress : callable, optional
        Called with the name of each stage as it begins.

    Returns
    -------
    Solution
        With a warning when the measurements leave something free (``NotUniqueWarning``) or optimality is not
        proven (``NotCertifiedWarning``).

    Raises
    ------
    CountError, FrameError, PriorError, UnderdeterminedError
        For a problem that cannot be solved.
    ScaleError
        When the scale is not positive at the optimum.
    """
    check_method(method)
    _check_types(problem, options)
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
                "initial is (X, Y, scale): poses of targets and of sensors by name, and a scale (1.0 if known)"
            )
        check_against_knowledge(problem, *initial)
    results = []
    for part in parts_of(problem):
        search = Search(part, options, progress)
        if options.nonnegative_scale:
            found = run_with_nonnegative_scale(search)
        elif initial is not None:
            given = given_answer(part, *initial)
            found = search.run(method, rotations_as_variables(part, given.R))
        else:
            found = search.with_positive_scale(search.run(method, None))
        results.append(_finish(part, search, found))
    return _merge(problem, results)


def certify(
    problem: Problem,
    X: Poses,
    Y: Poses,
    scale: Scale = 1.0,
    *,
    options: SolveOptions | None = None,
    progress: Progress | None = None,
) -> Certificate:
    """Certify anybody's answer: its cost against a rigorous bound on what any answer costs.

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
        Of the answer as given. "gap" says in ``reason`` whether a better answer was found.

    Raises
    ------
    FrameError, PoseError, ScaleError
        For an answer that lacks a frame, has something that is no pose, or a scale that is none.
    PriorError, ScaleError
        For an answer that contradicts a fixed frame or a known scale.
    """
    _check_types(problem, options)
    options = options or SolveOptions()
    parts = parts_of(problem)
    check_against_knowledge(problem, X, Y, scale)
    results = []
    for part in parts:
        given = given_answer(part, X, Y, scale)
        search = Search(part, options, progress)
        found = search.run("auto", rotations_as_variables(part, given.R))
        cost = search.forms.full.value(*as_variables(part, given))
        tolerance = search.tolerance(cost)
        ours = _finish(part, search, found).certificate
        gap = cost - found.lower
        if gap < -tolerance:
            status = Status.FAILED
            reason = f"the cost as given, {cost:.8g}, is below the bound of the reduced form: {ours.reason}"
        elif gap <= tolerance and ours.is_optimal:
            status, reason = ours.status, ours.reason.replace("optimal", "optimal, as given", 1)
        elif cost - found.cost > tolerance:
            status = Status.GAP
            reason = f"a better answer exists: {found.cost:.8g} against {cost:.8g}"
        else:
            status, reason = Status.GAP, ours.reason
        # The bound is exact to the stored form's last digits; the cost of the answer as given rounds on its way there.
        results.append(
            dataclasses.replace(
                ours,
                status=status,
                reason=reason,
                cost=cost,
                lower_bound=min(ours.lower_bound, cost),
                float_bound=min(ours.float_bound, cost),
                tolerance=tolerance,
            )
        )
    return certificates.combined(results)


@dataclasses.dataclass(frozen=True)
class _Result:
    part: Part
    answer: Answer
    certificate: Certificate
    identifiability: Identifiability
    residuals: dict[Pair, Residual]
    residual_cost: float


def _finish(part: Part, search: Search, found: Found) -> _Result:
    """Translations, residuals, identifiability and the certificate's words."""
    start = time.perf_counter()
    if search.progress is not None:
        search.progress("identifiability")
    answer = answer_of(part, search.form, found.R)
    closed = found.cost - found.lower <= search.tolerance(found.cost)
    _check_scale(part, answer, closed)
    poses = PairPoses.of(part, answer)
    J_t, J_R = costs_of_pairs(part, poses)
    known = identify(part, poses, J_t, J_R)
    search.seconds["identifiability"] = time.perf_counter() - start
    reason = found.reason
    # The bound speaks of the reduced form; the answer's cost in the unreduced one shows what reducing it lost.
    cost = max(search.forms.full.value(*as_variables(part, answer)), 0.0)
    if not np.isfinite(found.lower):
        status = Status.FAILED
    elif abs(cost - found.cost) > search.tolerance(found.cost):
        status = Status.GAP
        reason = (
            f"eliminating the translations lost digits: the answer costs {cost:.8g}, and {found.cost:.8g} in the "
            "reduced form that the bound is about; the motion hardly turns for the accuracy that sigma claims"
        )
        found = dataclasses.replace(found, cost=cost, lower=0.0)  # a sum of squares: the one bound that stays true
    elif not closed:
        status = Status.GAP
    elif known.is_unique and not found.definite and search.has_twin(found):
        status = Status.CERTIFIED_NOT_UNIQUE
        known = dataclasses.replace(
            known,
            is_unique=False,
            free_directions=["another answer, elsewhere, costs the same (half turns, or a symmetric motion)"],
        )
        reason += "; but another answer, elsewhere, costs the same"
    elif known.is_unique:
        status = Status.CERTIFIED
    else:
        status = Status.CERTIFIED_NOT_UNIQUE
        more = len(known.free_directions) - 3
        reason += "; but the measurements leave the answer free: " + "; ".join(known.free_directions[:3])
        reason += f"; and {more} more (identifiability.free_directions)" if more > 0 else ""
    certificate = Certificate(
        status=status,
        reason=reason,
        objective=OBJECTIVES[part.kind] + (", and the priors" if part.priors else ""),
        path=found.path,
        cost=found.cost,
        lower_bound=found.lower,
        float_bound=found.value if found.definite else found.lower,
        min_eigenvalue=found.eigenvalue if not found.definite else -max(found.cost - found.lower, 0.0),
        tolerance=search.tolerance(found.cost),
        is_relative=part.is_relative,
        seconds=dict(search.seconds),
    )
    residuals = residuals_of_pairs(part, poses, J_t, J_R)
    return _Result(part, answer, certificate, known, residuals, float(J_t.sum() + J_R.sum()))


def _check_scale(part: Part, answer: Answer, proven: bool) -> None:
    scales = {"the scale": answer.scale} if part.scale == "shared" else {}
    for name, value in zip(part.free, answer.own_scale, strict=True):
        if name in part.scale_owners:
            scales[f"the scale of {name}"] = float(value)
    for what, value in scales.items():
        if not (np.isfinite(value) and value > 0.0):
            raise ScaleError(
                f"{what} is {value:.6g} at the {'optimum' if proven else 'best point found'}, which no real target "
                "has. Either the poses contradict the frame convention (is B = T_sensor_target? is A inverted?), or "
                "the motion was planar, where a mirror image fits too (turn about a second axis), or "
                "the noise drowns the scale (SolveOptions(nonnegative_scale=True) constrains a shared one)"
            )


def _merge(problem: Problem, results: list[_Result]) -> Solution:
    X: dict[str, gtsam.Pose3] = {}
    Y: dict[str, gtsam.Pose3] = {}
    scales: dict[str, float] = {}
    residuals: dict[Pair, Residual] = {}
    for result in results:
        part = result.part
        poses = {
            name: to_pose3(R, t + part.frame_shift(name))
            for name, R, t in zip(part.free, result.answer.R, result.answer.t, strict=True)
        }
        for name in part.fixed:
            T = problem.fixed[name]
            poses[name] = to_pose3(T[:3, :3], T[:3, 3])
        X |= {name: poses[name] for name in part.targets}
        Y |= {name: poses[name] for name in part.sensors}
        if problem.scale == "per_target":
            scales |= part.fixed_scales
            own = dict(zip(part.free, result.answer.own_scale, strict=True))
            scales |= {name: float(own[name]) for name in part.scale_owners}
        residuals |= result.residuals
    certificate = certificates.combined([result.certificate for result in results])
    _warn_of_weights(problem, results)
    components = tuple(tuple(component) for component in connected_components(problem.pairs))
    known = identifiability.combined([result.identifiability for result in results], components)
    if not known.is_unique:
        warnings.warn(
            "the measurements do not determine the answer: " + "; ".join(known.free_directions),
            NotUniqueWarning,
            stacklevel=3,
        )
    if not certificate.is_optimal:
        warnings.warn(f"not proven optimal: {certificate.reason}", NotCertifiedWarning, stacklevel=3)
    scale: float | dict[str, float] = 1.0
    if problem.scale == "per_target":
        scale = {name: scales[name] for name in dict.fromkeys(t for t, _ in problem.pairs)}
    elif problem.scale == "shared":
        scale = results[0].answer.scale
    return Solution(
        X={name: X[name] for name in problem.targets},
        Y={name: Y[name] for name in problem.sensors},
        scale=scale,
        scale_mode=problem.scale,
        cost=certificate.cost,
        is_relative=problem.is_relative,
        certificate=certificate,
        identifiability=known,
        residuals={pair: residuals[pair] for pair in problem.pairs},
        parts=tuple(SolvedPart(result.part.names, result.certificate) for result in results),
    )


#: A cost this many times what the weights predict is told: weights too small, outliers, or another convention.
UNLIKELY = 4.0


def _warn_of_weights(problem: Problem, results: list[_Result]) -> None:
    """Compare the residuals with what the weights predict: half the degrees of freedom."""
    # The form turned round weighs otherwise than the physical model: its answer is no minimum of these residuals.
    if problem.is_relative or any(result.part.kind == "inverse" for result in results):
        return
    cost = sum(result.residual_cost for result in results)
    freedom = sum(6 * r.part.number_of_measurements - r.part.number_of_unknowns for r in results)
    if freedom > 0 and cost > UNLIKELY * 0.5 * freedom:
        warnings.warn(
            f"the residuals cost {cost:.4g}, {cost / (0.5 * freedom):.3g} times what sigma and kappa predict "
            f"({0.5 * freedom:.4g}): the noise is larger than they say, some measurements are wrong, or A or B is "
            "inverted",
            WeightsWarning,
            stacklevel=4,
        )


def _check_types(problem: Problem, options: SolveOptions | None) -> None:
    if not isinstance(problem, Problem):
        raise OptionError(f"the problem is a {type(problem).__name__}; give a gtsam_rwhec.Problem")
    if options is not None and not isinstance(options, SolveOptions):
        raise OptionError(f"options is a {type(options).__name__}; give a gtsam_rwhec.SolveOptions")


def check_against_knowledge(problem: Problem, X: Poses, Y: Poses, scale: Scale) -> None:
    """Refuse an answer that is another than the problem says is known: its cost would not be that of the answer."""
    for what, poses, names in (("X", X, problem.targets), ("Y", Y, problem.sensors)):
        if not isinstance(poses, Mapping):
            raise OptionError(f"{what} is a {type(poses).__name__}; give poses by name: {{name: pose}}")
        missing = [name for name in names if name not in poses and name not in problem.fixed]
        if missing:
            raise FrameError(f"{what} has no pose of {missing[0]!r}; it has {', '.join(map(repr, poses)) or 'none'}")
        unknown = [name for name in poses if name not in names]
        if unknown:
            raise FrameError(f"{what} has {unknown[0]!r}, which the problem does not; it has {', '.join(names)}")
    if problem.scale == "known" and scale != 1.0:
        raise ScaleError(
            f"the answer's scale is {scale!r}, but this problem has scale='known', which is 1; leave it out"
        )
    if isinstance(scale, Mapping):
        for name, known in problem.fixed_scales.items():
            if name in scale and not np.isclose(scale[name], known, rtol=ROUNDING, atol=0.0):
                raise ScaleError(f"the answer's scale of {name} is {scale[name]!r}, but it is fixed at {known!r}")
    for name, T in problem.fixed.items():
        poses, what = (X, "X") if name in problem.targets else (Y, "Y")
        if name in poses:
            given = one_transform(poses[name], f"{what}[{name!r}]")
            if not np.allclose(given, T, rtol=ROUNDING, atol=ROUNDING):
                raise PriorError(
                    f"{what}[{name!r}] is not the pose at which {name} is fixed: {difference(given, T)}; leave it out, "
                    "or do not fix the frame"
                )
