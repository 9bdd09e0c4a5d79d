"""The variant with alpha >= 0 as a constraint (RWHEC paper Section 4.3), for very noisy data.

(R, t, alpha) and (-R, -t, -alpha) cost the same, but only one of them has det R = 1, so noise can put the optimum at a
negative scale. alpha >= 0 enters the relaxation as one linear inequality on h alpha, with one multiplier nu >= 0. For
any nu, J - nu alpha is at most J wherever alpha >= 0, and ``bound`` bounds it in the same way (``of_scale``).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gtsam_rwhec.errors import OptionError, ScaleError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.answers import Point, answer_of
from gtsam_rwhec.solver.bound import Bound, lower_bound
from gtsam_rwhec.solver.certificate import Cause, Multipliers, SearchPath, Start
from gtsam_rwhec.solver.descent import Descent, descend, homogeneous
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.relaxation import Relaxation, round_to_rotations, solve_with_scale
from gtsam_rwhec.solver.rotations import vec
from gtsam_rwhec.solver.search import Found, Search
from gtsam_rwhec.solver.small_dual import stationary_multipliers

#: Up to this many frames the relaxation is solved: the size of Clarabel's cone grows with the fourth power.
MAX_FRAMES = 8


def scale_row(form: ReducedForm) -> Array:
    """The row (9 n,) with best scale alpha = row . r, for homogeneous forms (eq. 47)."""
    row: Array = -(form.factor[-1] @ form.G)[:-1]
    return row


def scale_spread(form: ReducedForm) -> float:
    """s: a scale at a distance d from the best scale costs d^2 / s more."""
    return float(form.factor[-1] @ form.factor[-1])


def run_with_nonnegative_scale(search: Search) -> Found:
    """Solve with alpha >= 0 as a constraint; the answer is the unconstrained optimum where that has a positive scale.

    Raises `ScaleError` when scale zero costs less than every positive scale that was found, and `OptionError` for more
    than ``MAX_FRAMES`` frames.
    """
    found = search.run("auto", None)
    if search.part.kind != "direct":
        raise OptionError("nonnegative_scale needs the direct form: leave out priors on translations")
    if found.answer.scale > 0.0:
        return found
    if search.form.rotations > MAX_FRAMES:
        raise OptionError(
            f"nonnegative_scale solves a constrained relaxation of up to {MAX_FRAMES} frames; there are "
            f"{search.form.rotations}, and the unconstrained optimum has a negative scale"
        )
    options, form = search.options, search.whole.reduced
    with search.stages.of("semidefinite relaxation"):
        relaxation = solve_with_scale(
            form.Q, scale_row(form), scale_spread(form), options.relaxation_tolerance, options.max_relaxation_iterations
        )
    with search.stages.of("descent"):
        starts = round_to_rotations(relaxation) + search.random_starts(options.random_starts)
        at_zero = _descend(without_scale(form), starts, options.max_descent_iterations)
        # From an optimum with the scale held at zero, the cost may still fall towards positive scales.
        ends = _descend(form, starts + [end.R for end in at_zero], options.max_descent_iterations)
    positive = [end for end in ends if answer_of(search.part, form, end.R).scale > 0.0]
    with search.stages.of("dual certificate"):
        bounds = _bounds(search, relaxation, at_zero[0].R, positive[0].R if positive else None)
    # A lower bound without the constraint alpha >= 0 is also one with the constraint.
    bound = max([*bounds, found.bound], key=lambda each: each.lower_bound)
    lower = bound.lower_bound
    if not positive or positive[0].cost > at_zero[0].cost:
        proven = at_zero[0].cost - lower <= search.tolerance(at_zero[0].cost)
        raise ScaleError(
            f"with alpha >= 0 as a constraint the {'optimum' if proven else 'best point found'} is at scale zero (cost "
            f"{at_zero[0].cost:.6g}, no answer below {lower:.6g}; the unconstrained optimum, {found.cost:.6g}, has a "
            "negative scale): the noise is too large to find the scale"
        )
    answer, evaluation = search.whole.answer_near(positive[0].R)
    lowest = evaluation.cost - 2.0 * evaluation.cost_error
    constrained = Found(
        answer=answer,
        R=evaluation.point.rotations,
        cost=evaluation.upper,
        bound=bound.at_most(lowest),
        tolerance=search.tolerance(evaluation.upper),
        is_known=found.is_known,
        path=SearchPath(Start.NONNEGATIVE_SCALE, Multipliers.RELAXATION),
        cause=Cause.NOT_TIGHT,
        figures={"relaxation_cost": relaxation.dual},
    )
    if constrained.is_closed:
        return dataclasses.replace(constrained, cause=Cause.PROVEN_WITH_NONNEGATIVE_SCALE, figures={})
    return constrained


def without_scale(form: ReducedForm) -> ReducedForm:
    """Q' with the scale held at zero: the term that the elimination of the scale subtracted is added again."""
    of_scale = form.factor[-1] / np.linalg.norm(form.factor[-1])
    row = of_scale @ form.G
    return dataclasses.replace(form, Q=form.Q + np.outer(row, row), G=form.G - np.outer(of_scale, row))


def _descend(form: ReducedForm, starts: list[Array], max_iterations: int) -> list[Descent]:
    """The ends of the descents, the lowest first."""
    return sorted((descend(form, start, max_iterations) for start in starts), key=lambda end: end.cost)


def _bounds(search: Search, relaxation: Relaxation, at_zero: Array, positive: Array | None) -> list[Bound]:
    """Bounds from the relaxation's multipliers, about the best answer, and about the best point of scale zero."""
    whole, form = search.whole, search.whole.reduced
    numbers = np.c_[without_scale(form).recover(homogeneous(at_zero))[0], vec(at_zero)]
    zero = whole.cost.at(Point(numbers, 0.0))
    # At scale zero the multiplier of the scale is the slope of the cost.
    of_slope = max(2.0 * float(zero.gradient[-1]), 0.0)
    gradient = zero.gradient[:-1].reshape(-1, 13)[:, 4:]
    tries = [
        (zero, of_slope, stationary_multipliers(gradient, at_zero, relaxation.multipliers)),
        (zero, max(relaxation.scale_multiplier, 0.0), relaxation.multipliers),
    ]
    if positive is not None:
        tries.append((whole.answer_near(positive)[1], max(relaxation.scale_multiplier, 0.0), relaxation.multipliers))
    return [lower_bound(whole, at, multipliers, of_scale=nu) for at, nu, multipliers in tries]
