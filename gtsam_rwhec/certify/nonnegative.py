"""The variant with alpha >= 0 as a constraint (RWHEC paper Section 4.3), for very noisy data.

(R, t, alpha) and (-R, -t, -alpha) cost the same, but only one of them has det R = 1, so noise can put the optimum at a
negative scale. alpha is linear in the rotations (eq. 47), h alpha quadratic in x: alpha >= 0 enters the relaxation as
one linear inequality, with one multiplier nu >= 0, and its bound is x'(Q' - Lambda - nu B)x >= gamma.
"""

from __future__ import annotations

import dataclasses

from gtsam_rwhec.certify.bound import lower_bound
from gtsam_rwhec.certify.descent import descend
from gtsam_rwhec.certify.reduced_form import ReducedForm
from gtsam_rwhec.certify.relaxation import round_to_rotations, solve_relaxation
from gtsam_rwhec.certify.search import Found, Search
from gtsam_rwhec.certify.variables import answer_of
from gtsam_rwhec.errors import OptionError, ScaleError
from gtsam_rwhec.poses import Array

#: Clarabel's cone grows with the fourth power of this.
MAX_FRAMES = 8


def scale_row(form: ReducedForm) -> Array:
    """alpha = scale_row . r for homogeneous forms (eq. 47), (9 n,)."""
    row: Array = -(form.border_factor[-1] @ form.G)[:-1]
    return row


def with_scale_multiplier(form: ReducedForm, nu: float) -> ReducedForm:
    """Q' - nu B with x'B x = h alpha: subtracts a nonnegative term from the cost wherever alpha >= 0."""
    half = 0.5 * nu * scale_row(form)
    split = 9 * form.leaves
    C, E = form.C.copy(), form.E.copy()
    C[:, :, -1] -= half[:split].reshape(-1, 9)
    E[:-1, -1] -= half[split:]
    E[-1, :-1] -= half[split:]
    return dataclasses.replace(form, C=C, E=E)


def run_with_nonnegative_scale(search: Search) -> Found:
    """Solve with alpha >= 0 as a constraint; the unconstrained optimum is the answer where it satisfies it.

    Raises
    ------
    ScaleError
        When the constraint is active at the optimum: the scale is zero, and no calibration.
    OptionError
        For more frames than the constrained relaxation takes.
    """
    found = search.run("auto", None)
    if search.part.kind != "direct":
        raise OptionError("nonnegative_scale needs the direct form: leave out priors on translations")
    if answer_of(search.part, search.form, found.R).scale > 0.0:
        return found
    if search.form.rotations > MAX_FRAMES:
        raise OptionError(
            f"nonnegative_scale solves a constrained relaxation of up to {MAX_FRAMES} frames; there are "
            f"{search.form.rotations}, and the unconstrained optimum has a negative scale"
        )
    options, form = search.options, search.form
    with search.stage("semidefinite relaxation"):
        relaxation = solve_relaxation(
            form.dense(), options.relaxation_tolerance, options.max_relaxation_iterations, scale_row(form)
        )
    with search.stage("descent"):
        ends = [descend(form, start, options.max_descent_iterations) for start in round_to_rotations(relaxation)]
    positive = [end for end in ends if answer_of(search.part, form, end.R).scale > 0.0]
    with search.stage("dual certificate"):
        nu = max(relaxation.scale_multiplier, 0.0)
        point = relaxation.X[:-1, -1] / relaxation.X[-1, -1]
        bound = lower_bound(with_scale_multiplier(form, nu), relaxation.multipliers, point)
    if not positive or (min(end.cost for end in positive) > bound.lower + 1e-3 * max(abs(bound.lower), 1.0) and nu > 0):
        raise ScaleError(
            f"with alpha >= 0 as a constraint the optimum is at scale zero (cost at least {bound.lower:.6g}; the "
            f"unconstrained optimum, {found.cost:.6g}, has a negative scale): the noise drowns the scale"
        )
    best = min(positive, key=lambda end: end.cost)
    return Found(
        best.R,
        best.cost,
        min(bound.lower, best.cost),
        bound.value,
        bound.definite,
        bound.eigenvalue,
        best.converged,
        "relaxation with alpha >= 0",
        "the unconstrained optimum has a negative scale; bounded by the relaxation with alpha >= 0",
    )
