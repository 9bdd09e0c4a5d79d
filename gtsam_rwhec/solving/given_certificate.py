"""``certify``: the certificate of an answer, whoever found it."""

from __future__ import annotations

import dataclasses

from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.cause import Cause
from gtsam_rwhec.solver.certificate import Certificate
from gtsam_rwhec.solver.options import SolveOptions
from gtsam_rwhec.solver.parts import parts_of
from gtsam_rwhec.solver.search import Search
from gtsam_rwhec.solver.variables import as_variables, given_answer, rotations_as_variables
from gtsam_rwhec.solving.arguments import Poses, Scale, check_against_knowledge, check_types
from gtsam_rwhec.solving.part_solution import PartSolution


def certify(
    problem: Problem,
    X: Poses,
    Y: Poses,
    scale: Scale = 1.0,
    *,
    options: SolveOptions | None = None,
    progress: Progress | None = None,
) -> Certificate:
    """Certify a given answer: its cost against a rigorous bound on what any answer costs.

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
        Of the answer as given. ``Cause.BETTER_ANSWER`` says that the search found a better one.

    Raises
    ------
    FrameError, PoseError, ScaleError
        For an answer that lacks a frame, or has an invalid pose or scale.
    PriorError, ScaleError
        For an answer that contradicts a fixed frame or a known scale.
    """
    check_types(problem, options)
    options = options or SolveOptions()
    parts = parts_of(problem)
    check_against_knowledge(problem, X, Y, scale)
    results = []
    for part in parts:
        given = given_answer(part, X, Y, scale)
        search = Search.of(part, options, progress)
        found = search.run("auto", rotations_as_variables(part, given.R))
        cost = search.forms.full.value(*as_variables(part, given))
        tolerance = search.tolerance(cost)
        best = PartSolution.of(search, found).certificate
        gap = cost - found.lower_bound
        cause, figures = best.cause, best.figures
        if gap < -tolerance:
            cause, figures = Cause.BELOW_BOUND, {"reduced_bound": found.lower_bound}
        elif cost - found.cost > tolerance or (gap > tolerance and best.is_optimal):
            cause, figures = Cause.BETTER_ANSWER, {"better_cost": found.cost}
        # The bound is exact to the stored form's last digits; the cost of the answer as given rounds on its way there.
        results.append(
            dataclasses.replace(
                best,
                status=cause.status,
                cause=cause,
                figures=figures,
                cost=cost,
                lower_bound=min(best.lower_bound, cost),
                float_bound=min(best.float_bound, cost),
                tolerance=tolerance,
            )
        )
    return Certificate.merged(results)
