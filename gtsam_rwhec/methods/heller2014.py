"""Heller, Henrion and Pajdla 2014: the cost of A X = Y B (or A Y = Y B) as a polynomial, its global minimum by an SDP.

The cost sum |A_i X - Y B_i|_F^2 is quadratic in the matrices' entries. Over quaternions it is of degree four, whose
first relaxation in Lasserre's hierarchy is that of order two (``quaternion_moments``); over rotation matrices, with all
the quadratic equations between their entries, of degree two and order one. The products of a quaternion's entries
fulfil 20 equations q_a q_b q_c q_d = q_a q_c q_b q_d, the matrix's entries 20 independent ones: but for the second
block of moments the two relaxations are one, and with it that over quaternions is tight where the other is not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.method import Method, MethodOptions, Properties, Takes
from gtsam_rwhec.methods.quaternion_moments import STEPS, solve_moments
from gtsam_rwhec.methods.unit_weights import COST, UnitForm
from gtsam_rwhec.methods.wise2020 import certified_rotations, check_frames
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.descent import descend

Parameterisation = Literal["quaternion", "matrix"]
#: The order of each one's first relaxation.
ORDERS: dict[Parameterisation, int] = {"quaternion": 2, "matrix": 1}
#: Gaps, of the cost and of a grossly wrong answer's cost, up to which a relaxation is called tight: what an
#: interior-point solver's multipliers leave.
TIGHT, ROUNDING = 1e-5, 1e-8


@dataclass(frozen=True)
class PolynomialMinimum:
    """Rotations (n, 3, 3), their cost, the relaxation's lower bound, and its order."""

    R: Array
    cost: float
    lower_bound: float
    order: int
    is_tight: bool


def heller2014(
    problem: Problem, options: MethodOptions, parameterisation: Parameterisation = "quaternion"
) -> Outcome[Poses]:
    """One X and one Y, or one sensor's motions; known scale."""
    form = UnitForm.of(problem)
    found = global_minimum(form, parameterisation)
    gap = found.cost - found.lower_bound
    order = f"order {found.order} over {'quaternions' if parameterisation == 'quaternion' else 'rotation matrices'}"
    if found.is_tight:
        note = f"the relaxation of {order} is tight: cost {found.cost:.6g}, bound {gap:.1e} below it"
    else:
        note = (
            f"the relaxation of {order} is not tight: cost {found.cost:.6g}, bound {gap:.2g} below it; the next order "
            "was not tried"
        )
    return replace(
        form.outcome(found.R, notes=(note,)),
        cost=found.cost,
        cost_name=COST,
        lower_bound=found.lower_bound,
        is_optimal=found.is_tight,
    )


def global_minimum(form: UnitForm, parameterisation: Parameterisation = "quaternion") -> PolynomialMinimum:
    """The relaxation's answer, descended from, and its bound.

    Raises
    ------
    OptionError
        For another parameterisation.
    """
    if parameterisation == "matrix":
        certified = certified_rotations(form)
        R, cost, lower = certified.R, certified.cost, certified.lower_bound
    elif parameterisation == "quaternion":
        relaxed = solve_moments(form.reduced.dense())
        ends = [descend(form.reduced, start, STEPS) for start in relaxed.starts]
        best = min(ends, key=lambda end: end.cost)
        R, cost, lower = best.R, best.cost, min(relaxed.lower_bound, best.cost)
    else:
        raise OptionError(f"heller2014: parameterisation={parameterisation!r} is not 'quaternion' or 'matrix'")
    is_tight = bool(cost - lower <= max(TIGHT * cost, ROUNDING * form.reduced.magnitude))
    return PolynomialMinimum(R, cost, lower, ORDERS[parameterisation], is_tight)


_SOURCE = (
    "J. Heller, D. Henrion and T. Pajdla, Hand-eye and robot-world calibration by global polynomial optimization, "
    "ICRA 2014"
)


def _method(name: str, parameterisation: Parameterisation, representation: str) -> Method[[Problem, MethodOptions]]:
    return Method(
        name=name,
        properties=Properties(representation, certifiable=True),
        source=_SOURCE,
        assumes="Errors alike in all measurements, a radian as bad as a metre. Proves its answer, or says that it has "
        "not.",
        function=partial(heller2014, parameterisation=parameterisation),
        takes=frozenset({Takes.MOTIONS}),
        check=check_frames,
    )


METHOD = _method("heller2014", "quaternion", "unit quaternions")
MATRIX = _method("heller2014_matrix", "matrix", "rotation matrices")
