"""AX = XB by the library's certified solver: the chordal cost, with a known or an unknown scale.

This module serves the call that all AX = XB methods share, with one sensor. ``Problem.add_motion`` and ``solve`` take
any number of sensors, with priors and with targets in the same problem.
"""

from __future__ import annotations

import warnings

import numpy as np

from gtsam_rwhec.errors import NotCertifiedWarning, NotUniqueWarning
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.handeye.request import Request
from gtsam_rwhec.methods.estimate import Outcome
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.certified_solution import solve


def certified(request: Request) -> Outcome[Array]:
    """Certified minimum of sum |R_C R - R R_H|^2 + alpha^2 |(R_C - 1) T - R T_H + T_C|^2 (eq. 30, first).

    The library's cost J is this cost when a motion of weight w has 1 / sigma^2 = 2 alpha^2 w and kappa = 2 w. An
    unknown scale has t_C = scale * (true length). The equation is then inverted, H X^-1 = X^-1 C, so that the measured
    side has the scale: the cost is that of X^-1. Raises ScaleError when the scale at the optimum is not positive.
    """
    w = np.ones(len(request.motions)) if request.weights is None else request.weights
    used = w > 0.0
    C, H, w = request.motions.C[used], request.motions.H[used], w[used]
    sigma, kappa = 1.0 / (request.alpha * np.sqrt(2.0 * w)), 2.0 * w
    known = request.scale == "known"
    problem = Problem(scale="known" if known else "shared", keep_measurements=False)
    name = "h" if known else "c"  # whose pose the problem is about
    problem.add_motion(name, *((C, H) if known else (H, C)), sigma, kappa)
    with warnings.catch_warnings():  # the answer holds both facts: free directions and bound
        warnings.simplefilter("ignore", NotUniqueWarning)
        warnings.simplefilter("ignore", NotCertifiedWarning)
        solution = solve(problem)
    Y, scale = solution.Y[name], solution.scale
    if isinstance(scale, dict):
        scale = scale[name]
    return Outcome(
        X=(Y if known else Y.inverse()).matrix(),
        cost=solution.cost,
        cost_name="eq. 30, chordal" if known else "eq. 30, chordal, of X^-1 with t_C / scale",
        lower_bound=solution.certificate.lower_bound,
        free_directions=solution.identifiability.free_directions,
        scale=scale,
    )
