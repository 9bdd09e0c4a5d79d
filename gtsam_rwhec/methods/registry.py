"""All methods for A X = Y B by name, the call that runs one, and any answer under the certified objective."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.terminal_text import brief
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import PoseLike, one_transform
from gtsam_rwhec.methods.certified import CERTIFIED
from gtsam_rwhec.methods.closed_forms import DORNAIKA_CLOSED, DUAL_QUATERNIONS, KRONECKER, SHAH, WANG, ZHUANG
from gtsam_rwhec.methods.global_rotations import HELLER, HELLER_MATRIX, WISE
from gtsam_rwhec.methods.horn2023 import HORN
from gtsam_rwhec.methods.iterative_methods import C1, C1_SEPARABLE, C2, C2_SEPARABLE, DORNAIKA, LOM, STROBL
from gtsam_rwhec.methods.method import (
    Estimate,
    Method,
    MethodOptions,
    Outcome,
    Poses,
    Proof,
    check_problem,
    checked_options,
)
from gtsam_rwhec.methods.reprojection import EVANGELISTA, RP1
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.answers import PairPoses, Residual, costs_of_pairs, given_answer, residuals_of_pairs
from gtsam_rwhec.solver.free_directions import FreeDirection
from gtsam_rwhec.solver.identification import identify
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solver.solve_options import check_against_knowledge, check_types


@dataclass(frozen=True)
class Evaluation:
    """An answer's cost, its residuals, and its free directions.

    The cost is J (eq. 18) with priors, in the inverse form where the certified solver uses the inverse form. Larger
    residuals leave more directions free.
    """

    cost: float
    residuals: dict[Pair, Residual]
    free_directions: tuple[FreeDirection, ...]


@np.errstate(all="ignore")
def evaluate(
    problem: Problem, X: Mapping[str, PoseLike], Y: Mapping[str, PoseLike], scale: float | Mapping[str, float] = 1.0
) -> Evaluation:
    """Evaluate an answer; arguments and errors are those of ``cost_of_answer``."""
    check_types(problem, None)
    parts = parts_of(problem)
    check_against_knowledge(problem, X, Y, scale)
    cost = 0.0
    residuals: dict[Pair, Residual] = {}
    free: list[FreeDirection] = []
    for part in parts:
        answer = given_answer(part, X, Y, scale)
        cost += max(PartForm.of(part).evaluated(answer).cost, 0.0)
        poses = PairPoses.of(part, answer)
        J_t, J_R = costs_of_pairs(part, poses)
        residuals |= residuals_of_pairs(part, poses, J_t, J_R)
        free += identify(part, poses, J_t, J_R).free_directions
    return Evaluation(cost, {pair: residuals[pair] for pair in problem.pairs}, tuple(free))


def cost_of_answer(
    problem: Problem, X: Mapping[str, PoseLike], Y: Mapping[str, PoseLike], scale: float | Mapping[str, float] = 1.0
) -> float:
    """J of an answer: X = T_targetcarrier_target and Y = T_sensorcarrier_sensor by name, metres, and the scale.

    Raises
    ------
    FrameError, PoseError, PriorError, ScaleError
        When the answer lacks a frame, or contradicts what the problem fixes.
    """
    return evaluate(problem, X, Y, scale).cost


#: The cost by which all answers are compared.
COST_NAME = "J (RWHEC paper, eq. 18)"
#: All methods: closed forms, then iterations, then global methods.
METHODS: dict[str, Method[[Problem, MethodOptions]]] = {
    method.name: method
    for method in (
        ZHUANG,
        DORNAIKA_CLOSED,
        KRONECKER,
        DUAL_QUATERNIONS,
        SHAH,
        WANG,
        DORNAIKA,
        LOM,
        STROBL,
        HORN,
        C1,
        C2,
        C1_SEPARABLE,
        C2_SEPARABLE,
        RP1,
        WISE,
        HELLER,
        HELLER_MATRIX,
        EVANGELISTA,
        CERTIFIED,
    )
}  # fmt: skip


@one_blas_thread()
def run(name: str, problem: Problem, options: MethodOptions | None = None) -> Estimate[dict[str, gtsam.Pose3]]:
    """Solve a problem by a published method.

    Parameters
    ----------
    name : str
        A key of ``METHODS``.

    Raises
    ------
    OptionError
        When the name is unknown, or ``options`` is not a ``MethodOptions``.
    CountError, FrameError, MeasurementsNotKeptError, NoiseError, PriorError, ScaleError
        When the method cannot solve the problem; the message says why.
    UnderdeterminedError
        When the measurements do not determine the method's equations.
    """
    method = method_of(name)
    options = checked_options(options)
    check_problem(method, problem)
    start = time.perf_counter()
    found = method.function(problem, options)
    seconds = time.perf_counter() - start
    return estimate_of(method.name, problem, found, seconds)


def method_of(name: str) -> Method[[Problem, MethodOptions]]:
    """The method of a name; OptionError for an unknown name."""
    try:
        return METHODS[name]
    except (KeyError, TypeError):
        raise OptionError(f"method {brief(name)} is not one of {', '.join(METHODS)}") from None


def estimate_of(name: str, problem: Problem, found: Outcome[Poses], seconds: float) -> Estimate[dict[str, gtsam.Pose3]]:
    """A method's answer, evaluated under the certified objective."""
    scale = found.scale if isinstance(found.scale, float) else dict(found.scale)
    evaluation = evaluate(problem, found.X, found.Y, scale)
    proof = None
    if found.cost is not None and found.lower_bound is not None:
        proof = Proof(found.cost, found.cost_name, found.lower_bound, bool(found.is_optimal))
    return Estimate(
        method=name,
        X={name: _pose3(found.X[name], name) for name in problem.targets},
        Y={name: _pose3(found.Y[name], name) for name in problem.sensors},
        scale=scale,
        cost=evaluation.cost,
        cost_name=COST_NAME,
        proof=proof,
        residuals=evaluation.residuals,
        seconds=seconds,
        starts_from=found.starts_from,
        notes=found.notes,
        free_directions=evaluation.free_directions,
    )


def _pose3(pose: PoseLike, name: str) -> gtsam.Pose3:
    return gtsam.Pose3(one_transform(pose, name))
