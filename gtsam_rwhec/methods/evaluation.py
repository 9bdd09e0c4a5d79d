"""Any answer under the certified objective: J, each pair's residuals and the free directions, from moments alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import PoseLike
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
    """What an answer costs, how well it fits, and what it leaves free.

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
