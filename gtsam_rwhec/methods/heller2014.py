"""Heller, Henrion and Pajdla 2014: the cost of A X = Y B (or A Y = Y B) as a polynomial, its global minimum by an SDP.

The cost sum |A_i X - Y B_i|_F^2 is quadratic in the matrices' entries. Over quaternions it has degree four, so
Lasserre's first relaxation has order two (``quaternion_moments``). Over rotation matrices, with all quadratic equations
between their entries, it has degree two, and the relaxation has order one. The products of a quaternion's entries
fulfil 20 equations q_a q_b q_c q_d = q_a q_c q_b q_d; the matrix's entries fulfil 20 independent equations. The
relaxations differ by the second block of moments alone, with which quaternions are tight where matrices are not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.method import UNWEIGHTED, Method, MethodOptions, Properties, Takes
from gtsam_rwhec.methods.quaternion_moments import STEPS, solve_moments
from gtsam_rwhec.methods.unit_weights import COST, UnitForm
from gtsam_rwhec.methods.wise2020 import certified_rotations
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.descent import descend

Parameterisation = Literal["quaternion", "matrix"]
#: Each parameterisation's first relaxation, in words.
RELAXATIONS: dict[Parameterisation, str] = {
    "quaternion": "order 2 over quaternions",
    "matrix": "order 1 over rotation matrices",
}
#: A relaxation counts as tight up to this gap, relative to the cost: the solver's multipliers leave as much.
TIGHT = 1e-5
#: For exact data the gap counts relative to the cost of a grossly wrong answer; this is its limit.
ROUNDING = 1e-8


@dataclass(frozen=True)
class PolynomialMinimum:
    """Rotations (n, 3, 3), their cost, the relaxation's lower bound, and whether the bound proves the answer."""

    R: Array
    cost: float
    lower_bound: float
    is_tight: bool


def heller2014(
    problem: Problem, options: MethodOptions, parameterisation: Parameterisation = "quaternion"
) -> Outcome[Poses]:
    """Solve for one X and one Y, or one sensor's motions, of known scale."""
    form = UnitForm.of(problem)
    found = global_minimum(form, parameterisation)
    note = (
        f"the relaxation of {RELAXATIONS[parameterisation]} is {'tight' if found.is_tight else 'not tight'}: cost "
        f"{found.cost:.6g}, bound {found.cost - found.lower_bound:.1e} below it"
    )
    if not found.is_tight:
        note += "; the next order was not tried"
    return replace(
        form.outcome(found.R, notes=(note,)),
        cost=found.cost,
        cost_name=COST,
        lower_bound=found.lower_bound,
        is_optimal=found.is_tight,
    )


def global_minimum(form: UnitForm, parameterisation: Parameterisation = "quaternion") -> PolynomialMinimum:
    """Solve the relaxation, descend from its answer, and bound the cost; OptionError for another parameterisation."""
    if parameterisation == "matrix":
        certified = certified_rotations(form)
        R, cost, lower = certified.R, certified.cost, certified.lower_bound
    elif parameterisation == "quaternion":
        relaxed = solve_moments(form.reduced.Q)
        best = min((descend(form.reduced, start, STEPS) for start in relaxed.starts), key=lambda end: end.cost)
        R, cost, lower = best.R, best.cost, min(relaxed.lower_bound, best.cost)
    else:
        raise OptionError(f"heller2014: parameterisation={parameterisation!r} is not 'quaternion' or 'matrix'")
    is_tight = bool(cost - lower <= max(TIGHT * cost, ROUNDING * form.reduced.magnitude))
    return PolynomialMinimum(R, cost, lower, is_tight)


_SOURCE = (
    "J. Heller, D. Henrion and T. Pajdla, Hand-eye and robot-world calibration by global polynomial optimization, "
    "ICRA 2014"
)


def _method(name: str, parameterisation: Parameterisation, representation: str) -> Method[[Problem, MethodOptions]]:
    return Method(
        name=name,
        properties=Properties(representation, certifiable=True),
        source=_SOURCE,
        assumes=f"{UNWEIGHTED} The answer says whether it is proven optimal.",
        function=partial(heller2014, parameterisation=parameterisation),
        takes=frozenset({Takes.MOTIONS}),
    )


METHOD = _method("heller2014", "quaternion", "unit quaternions")
MATRIX = _method("heller2014_matrix", "matrix", "rotation matrices")
