"""This library's own method behind the same call: the certified global optimum (RWHEC paper, Algorithm 1)."""

from __future__ import annotations

import warnings

from gtsam_rwhec.errors import NotCertifiedWarning, NotUniqueWarning, WeightsWarning
from gtsam_rwhec.methods.protocol import Calibration, Method, MethodOptions, Properties
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.options import SolveOptions
from gtsam_rwhec.solving.certified_solution import solve
from gtsam_rwhec.solving.solution import Solution


def certified(problem: Problem, options: MethodOptions) -> Calibration:
    """``gtsam_rwhec.solve``; what it would warn of is in the notes."""
    return calibration_of(quiet_solution(problem, options))


def quiet_solution(problem: Problem, options: MethodOptions) -> Solution:
    """``gtsam_rwhec.solve`` without its warnings: what they say is in the solution."""
    with warnings.catch_warnings():
        for category in (NotUniqueWarning, NotCertifiedWarning, WeightsWarning):
            warnings.simplefilter("ignore", category)
        return solve(problem, options=SolveOptions(seed=options.seed))


def calibration_of(solution: Solution) -> Calibration:
    """A solution as a method's answer."""
    notes = () if solution.certificate.is_certified else (str(solution.certificate),)
    return Calibration(solution.X, solution.Y, solution.scale, notes=notes)


METHOD = Method(
    name="certified",
    properties=Properties(
        joint=True,
        probabilistic=True,
        certifiable=True,
        multiple="Xs and Ys",
        monocular=True,
        representation="SE(3)",
    ),
    source="E. Wise et al., A certifiably correct algorithm for generalized robot-world and hand-eye calibration, "
    "arXiv 2507.23045",
    assumes="Isotropic noise on B, exact A. A proof says so when another answer could be better.",
    function=certified,
    scales=("known", "shared", "per_target"),
    takes_motions=True,
    takes_priors=True,
    takes_moments=True,
)
