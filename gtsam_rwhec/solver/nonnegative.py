"""The variant with alpha >= 0 as a constraint (RWHEC paper Section 4.3), for very noisy data.

(R, t, alpha) and (-R, -t, -alpha) cost the same, but only one of them has det R = 1, so noise can put the optimum at a
negative scale. With all but rotations and scale eliminated, the cost is x'Q'x + (alpha - a)^2 / s, where a = row . r is
the best scale for the rotations (eq. 47) and s = ``scale_spread``. alpha >= 0 enters the relaxation as one linear
inequality on h alpha, with one multiplier nu >= 0. For any nu, the elimination of the scale from cost - nu h alpha
gives, on alpha >= 0::

    cost >= x'Q'x - nu h a - nu^2 s h^2 / 4

The right side is a form like Q', and ``bound`` bounds it in the same way.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from gtsam_rwhec.errors import OptionError, ScaleError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.bound import Bound, lower_bound
from gtsam_rwhec.solver.cause import Cause, Multipliers, SearchPath, Start
from gtsam_rwhec.solver.descent import Descent, descend
from gtsam_rwhec.solver.interior_point import Relaxation
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.relaxation import round_to_rotations, solve_with_scale
from gtsam_rwhec.solver.rotations import vec
from gtsam_rwhec.solver.search import Found, Search
from gtsam_rwhec.solver.small_dual import stationary_multipliers
from gtsam_rwhec.solver.variables import answer_of
from gtsam_rwhec.solver.verified import gamma

#: Up to this many frames the relaxation is solved: the size of Clarabel's cone grows with the fourth power.
MAX_FRAMES = 8


def scale_row(form: ReducedForm) -> Array:
    """The row (9 n,) with best scale alpha = row . r, for homogeneous forms (eq. 47)."""
    row: Array = -(form.border_factor[-1] @ form.G)[:-1]
    return row


def scale_spread(form: ReducedForm) -> float:
    """s: a scale that is d away from the best scale costs d^2 / s more."""
    return float(form.border_factor[-1] @ form.border_factor[-1])


def with_scale_multiplier(form: ReducedForm, nu: float) -> ReducedForm:
    """A form whose cost is at most the true cost wherever alpha >= 0."""
    half = 0.5 * nu * scale_row(form)
    split = 9 * form.leaves
    C, E = form.C.copy(), form.E.copy()
    C[:, :, -1] -= half[:split].reshape(-1, 9)
    E[:-1, -1] -= half[split:]
    E[-1, :-1] -= half[split:]
    E[-1, -1] -= 0.25 * nu * nu * scale_spread(form)
    return dataclasses.replace(form, C=C, E=E)


def run_with_nonnegative_scale(search: Search) -> Found:
    """Solve with alpha >= 0 as a constraint; the answer is the unconstrained optimum where that has a positive scale.

    Raises `ScaleError` when scale zero costs less than every positive scale that was found, and `OptionError` for more
    than ``MAX_FRAMES`` frames.
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
    with search.stages.of("semidefinite relaxation"):
        relaxation = solve_with_scale(
            form.dense(),
            scale_row(form),
            scale_spread(form),
            options.relaxation_tolerance,
            options.max_relaxation_iterations,
        )
    with search.stages.of("descent"):
        starts = round_to_rotations(relaxation) + search.random_starts(options.random_starts)
        at_zero = _descend(without_scale(form), starts, options.max_descent_iterations)
        # From a scale held at zero the cost may fall towards positive scales.
        ends = _descend(form, starts + [end.R for end in at_zero], options.max_descent_iterations)
    positive = [end for end in ends if answer_of(search.part, form, end.R).scale > 0.0]
    with search.stages.of("dual certificate"):
        bound = max(_bounds(form, relaxation, at_zero[0].R), key=lambda each: each.lower_bound)
    lower = max(bound.lower_bound, found.bound.lower_bound)  # a bound without the constraint holds with it
    if not positive or positive[0].cost > at_zero[0].cost:
        proven = at_zero[0].cost - lower <= search.tolerance(at_zero[0].cost)
        raise ScaleError(
            f"with alpha >= 0 as a constraint the {'optimum' if proven else 'best point found'} is at scale zero (cost "
            f"{at_zero[0].cost:.6g}, no answer below {lower:.6g}; the unconstrained optimum, {found.cost:.6g}, has a "
            "negative scale): the noise is too large to find the scale"
        )
    best = positive[0]
    constrained = Found(
        R=best.R,
        cost=best.cost,
        bound=dataclasses.replace(bound, lower_bound=min(lower, best.cost)),
        tolerance=search.tolerance(best.cost),
        path=SearchPath(Start.NONNEGATIVE_SCALE, Multipliers.RELAXATION),
        cause=Cause.NOT_TIGHT,
        figures={"relaxation_cost": relaxation.dual},
    )
    if constrained.is_closed:
        return dataclasses.replace(constrained, cause=Cause.PROVEN_WITH_NONNEGATIVE_SCALE, figures={})
    return constrained


def without_scale(form: ReducedForm) -> ReducedForm:
    """Q' with the scale held at zero: the row of G from the elimination of the scale is taken out."""
    of_scale = form.border_factor[-1] / np.linalg.norm(form.border_factor[-1])
    return dataclasses.replace(form, G=form.G - np.outer(of_scale, of_scale @ form.G))


def _descend(form: ReducedForm, starts: list[Array], max_iterations: int) -> list[Descent]:
    """The ends of the descents, the lowest first."""
    return sorted((descend(form, start, max_iterations) for start in starts), key=lambda end: end.cost)


def _bounds(form: ReducedForm, relaxation: Relaxation, at_zero: Array) -> list[Bound]:
    """Bounds from the relaxation's multipliers: at the relaxation's own point, and at the best point of scale zero."""
    r = vec(at_zero).ravel()
    # At scale zero the multiplier of the scale is the slope of the cost.
    of_slope = max(-2.0 * float(scale_row(form) @ r) / scale_spread(form), 0.0)
    bounds = []
    for nu, point in (
        (max(relaxation.scale_multiplier, 0.0), relaxation.X[:-1, -1] / relaxation.X[-1, -1]),
        (of_slope, r),
    ):
        held = with_scale_multiplier(form, nu)
        multipliers = relaxation.multipliers
        if point is r:
            multipliers = stationary_multipliers(held, at_zero, multipliers)
        bound = lower_bound(held, multipliers, point)
        bounds.append(dataclasses.replace(bound, lower_bound=bound.lower_bound - _rounding(form, nu)))
    return bounds


def _rounding(form: ReducedForm, nu: float) -> float:
    """A bound on the rounding in ``with_scale_multiplier`` at any rotations: their entries are at most 1."""
    of_row = np.abs(form.border_factor[-1]) @ np.abs(form.G)
    linear = nu * float(of_row.sum()) + 2.0 * float(np.abs(form.C[:, :, -1]).sum() + np.abs(form.E[:-1, -1]).sum())
    constant = nu * nu * scale_spread(form) + abs(float(form.E[-1, -1]))
    return gamma(len(form.G) + 10) * (linear + constant)
