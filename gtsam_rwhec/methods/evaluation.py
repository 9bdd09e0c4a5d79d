"""Anybody's answer under the certified objective: J, each pair's residuals, what is free; all from moments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from gtsam_rwhec.geometry.poses import PoseLike
from gtsam_rwhec.identifiability.free_directions import FreeDirection
from gtsam_rwhec.identifiability.identification import identify
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.full_form import full_forms
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solver.residuals import PairPoses, Residual, costs_of_pairs, residuals_of_pairs
from gtsam_rwhec.solver.variables import as_variables, given_answer
from gtsam_rwhec.solving.arguments import check_against_knowledge


@dataclass(frozen=True)
class Evaluation:
    """What an answer costs and how well it fits.

    Attributes
    ----------
    cost : float
        J (eq. 18), priors included; of the inverted equation where the certified solver inverts it.
    residuals : dict of (target, sensor) to Residual
    free_directions : tuple of FreeDirection
        What the measurements leave undetermined, judged by this answer's residuals: where they are far larger
        than the noise, more counts as free.
    """

    cost: float
    residuals: dict[Pair, Residual]
    free_directions: tuple[FreeDirection, ...]


def evaluate(
    problem: Problem, X: Mapping[str, PoseLike], Y: Mapping[str, PoseLike], scale: float | Mapping[str, float] = 1.0
) -> Evaluation:
    """Evaluate an answer.

    Parameters
    ----------
    problem : Problem
    X, Y : dict of str to pose
        T_targetcarrier_target and T_sensorcarrier_sensor, metres.
    scale : float or dict of str to float

    Raises
    ------
    FrameError, PoseError, PriorError, ScaleError
        When the answer lacks a frame, or contradicts what the problem fixes.
    """
    parts = parts_of(problem)
    check_against_knowledge(problem, X, Y, scale)
    cost = 0.0
    residuals: dict[Pair, Residual] = {}
    free: list[FreeDirection] = []
    for part in parts:
        answer = given_answer(part, X, Y, scale)
        full, _ = full_forms(part)
        cost += max(full.value(*as_variables(part, answer)), 0.0)
        poses = PairPoses.of(part, answer)
        J_t, J_R = costs_of_pairs(part, poses)
        residuals |= residuals_of_pairs(part, poses, J_t, J_R)
        free += identify(part, poses, J_t, J_R).free_directions
    return Evaluation(cost, {pair: residuals[pair] for pair in problem.pairs}, tuple(free))


def cost_of_answer(
    problem: Problem, X: Mapping[str, PoseLike], Y: Mapping[str, PoseLike], scale: float | Mapping[str, float] = 1.0
) -> float:
    """J of an answer; see ``evaluate``."""
    return evaluate(problem, X, Y, scale).cost
