"""This library's own method as one of the methods: the certified global optimum (RWHEC paper, Algorithm 1)."""

from __future__ import annotations

import warnings

from gtsam_rwhec.errors import NotCertifiedWarning, NotUniqueWarning, WeightsWarning
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.method import Method, MethodOptions, Properties, Takes
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.certified_solution import solve
from gtsam_rwhec.solver.solution import Solution
from gtsam_rwhec.solver.solve_options import SolveOptions

SOURCE = (
    "E. Wise et al., A certifiably correct algorithm for generalized robot-world and hand-eye calibration, "
    "arXiv 2507.23045"
)


def certified(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """Solve by ``gtsam_rwhec.solve``; the notes give the certificate if it does not prove the answer."""
    return outcome_of(quiet_solution(problem, options))


def quiet_solution(problem: Problem, options: MethodOptions) -> Solution:
    """Solve by ``gtsam_rwhec.solve`` without its warnings: the solution states the same facts."""
    with warnings.catch_warnings():
        for category in (NotUniqueWarning, NotCertifiedWarning, WeightsWarning):
            warnings.simplefilter("ignore", category)
        return solve(problem, options=SolveOptions(seed=options.seed))


def outcome_of(solution: Solution) -> Outcome[Poses]:
    """A solution as a method's answer."""
    notes = () if solution.certificate.is_certified else (str(solution.certificate),)
    return Outcome(
        solution.X,
        solution.Y,
        solution.scale,
        cost=solution.cost,
        cost_name=str(solution.certificate.objective),
        lower_bound=solution.certificate.lower_bound,
        is_optimal=solution.certificate.is_certified,
        notes=notes,
    )


METHOD = Method(
    name="certified",
    properties=Properties("SE(3)", probabilistic=True, certifiable=True, multiple="Xs and Ys", monocular=True),
    source=SOURCE,
    assumes="Isotropic noise on B, exact A. The answer says whether it is proven optimal.",
    function=certified,
    takes=frozenset({Takes.SHARED_SCALE, Takes.SCALE_PER_TARGET, Takes.MOTIONS, Takes.PRIORS, Takes.MOMENTS}),
)
