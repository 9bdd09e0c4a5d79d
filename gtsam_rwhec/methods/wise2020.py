"""Wise, Giamou, Khoubyarian, Grebe and Kelly 2020: one sensor, certified by the Kronecker form's own relaxation.

The paper solves A Y = Y B, one sensor's motions (hand-eye calibration); the same method solves A X = Y B of one X and
one Y. The cost is quadratic in vec R_X and vec R_Y by Kronecker products, without translations and the monocular scale.
Each rotation has 21 quadratic constraints. The semidefinite relaxation's dual is a lower bound on every answer's cost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.method import UNWEIGHTED, Method, MethodOptions, Properties, Takes
from gtsam_rwhec.methods.unit_weights import COST, UnitForm
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.answers import answer_of, as_point
from gtsam_rwhec.solver.bound import lower_bound
from gtsam_rwhec.solver.descent import descend
from gtsam_rwhec.solver.relaxation import Relaxation, round_to_rotations, solve_by_clarabel
from gtsam_rwhec.solver.rotations import CONSTRAINTS, kkt_multipliers
from gtsam_rwhec.solver.small_dual import scatter

#: The interior-point solver stops at this relative gap and infeasibility.
TOLERANCE = 1e-10
#: The interior-point solver takes at most this many steps, and so does the descent.
STEPS = 200
#: Below this second eigenvalue over the first, the solution has rank one, and the relaxation is tight.
RANK_ONE = 1e-5


@dataclass(frozen=True)
class CertifiedRotations:
    """Rotations (n, 3, 3) of the lowest cost, a lower bound on every answer's cost, and how tight the relaxation is.

    ``eigenvalue_ratio`` is the relaxation's second eigenvalue over its first.
    """

    R: Array
    cost: float
    lower_bound: float
    eigenvalue_ratio: float

    @property
    def gap(self) -> float:
        """Cost minus bound, relative to the cost; it says nothing of exact data, whose cost is rounding error."""
        return (self.cost - self.lower_bound) / max(self.cost, 1e-300)


def wise2020(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """Solve for one X and one Y, or one sensor's motions; known or shared scale."""
    form = UnitForm.of(problem)
    found = certified_rotations(form)
    is_tight = found.eigenvalue_ratio < RANK_ONE
    proof = "the relaxation is tight"
    if not is_tight:
        proof = f"the relaxation is not tight (eigenvalues' ratio {found.eigenvalue_ratio:.1e}): nothing is proven"
    return replace(
        form.outcome(found.R, notes=(f"{proof}; relative gap {found.gap:.1e}",)),
        cost=found.cost,
        cost_name=COST,
        lower_bound=found.lower_bound,
        is_optimal=is_tight,
    )


def certified_rotations(form: UnitForm) -> CertifiedRotations:
    """Solve the relaxation by Clarabel, descend from its rotations, and take the best of three lower bounds."""
    reduced = form.reduced
    Q = reduced.Q
    relaxation = solve_by_clarabel(Q, TOLERANCE, STEPS)
    ends = [descend(reduced, R, STEPS) for R in round_to_rotations(relaxation)]
    best = min(ends, key=lambda end: end.cost)
    whole = form.forms
    point = as_point(form.part, answer_of(form.part, reduced, best.R))
    evaluation = whole.cost.at(point)
    of_answer = kkt_multipliers(best.R, evaluation.gradient[:-1].reshape(-1, 13)[:, 4:])
    bounds = [
        lower_bound(whole, evaluation, multipliers).lower_bound for multipliers in (relaxation.multipliers, of_answer)
    ]
    bounds.append(_relaxation_bound(Q, relaxation))
    values = np.linalg.eigvalsh(relaxation.X)
    return CertifiedRotations(best.R, best.cost, max(bounds), float(max(values[-2], 0.0) / values[-1]))


def _relaxation_bound(Q: Array, relaxation: Relaxation) -> float:
    """gamma + (3 n + 1) min(0, lambda_min(Z)), as x'x = 3 n + 1: the best bound where the relaxation is not tight."""
    Z = Q - scatter(np.einsum("nk,kij->nij", relaxation.multipliers, CONSTRAINTS))
    Z[-1, -1] -= relaxation.dual
    trace = (len(Q) - 1) / 3.0 + 1.0
    return relaxation.dual + trace * min(0.0, float(np.linalg.eigvalsh(Z)[0]))


METHOD = Method(
    name="wise2020",
    properties=Properties("SE(3)", certifiable=True, monocular=True),
    source="E. Wise, M. Giamou, S. Khoubyarian, A. Grebe and J. Kelly, Certifiably optimal monocular hand-eye "
    "calibration, IEEE MFI 2020",
    assumes=f"{UNWEIGHTED} The answer says whether it is proven optimal.",
    function=wise2020,
    takes=frozenset({Takes.SHARED_SCALE, Takes.MOTIONS}),
)
