"""Wise, Giamou, Khoubyarian, Grebe and Kelly 2020: one sensor, certified by the Kronecker form's own relaxation.

A X = Y B of one X and one Y, or A Y = Y B of a sensor's motions (hand-eye calibration, as the paper has it), as a
quadratic cost of vec R_X and vec R_Y by Kronecker products, translations and the monocular scale eliminated; 21
quadratic constraints a rotation, solved as a semidefinite program. Its dual is a lower bound on what any answer costs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.errors import FrameError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods.estimate import Outcome, Poses
from gtsam_rwhec.methods.method import Method, MethodOptions, Properties, Takes
from gtsam_rwhec.methods.unit_weights import COST, UnitForm
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.solver.bound import lower_bound
from gtsam_rwhec.solver.descent import descend
from gtsam_rwhec.solver.interior_point import Relaxation
from gtsam_rwhec.solver.local_blocks import scatter
from gtsam_rwhec.solver.relaxation import round_to_rotations, solve_by_clarabel
from gtsam_rwhec.solver.rotations import CONSTRAINTS, kkt_multipliers, vec

TOLERANCE = 1e-10
STEPS = 200
#: Second over first eigenvalue of the solution below which it has rank one, and the relaxation is tight.
RANK_ONE = 1e-5


@dataclass(frozen=True)
class CertifiedRotations:
    """Rotations (n, 3, 3) of least cost and the proof.

    ``lower_bound`` holds for every answer; ``eigenvalue_ratio`` is the solution's second over its first.
    """

    R: Array
    cost: float
    lower_bound: float
    eigenvalue_ratio: float

    @property
    def gap(self) -> float:
        """Relative to the cost; for exact data, whose cost is rounding, it says nothing."""
        return (self.cost - self.lower_bound) / max(self.cost, 1e-300)


def wise2020(problem: Problem, options: MethodOptions) -> Outcome[Poses]:
    """One X and one Y, or one sensor's motions; known or shared scale."""
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
    """Solve the relaxation by Clarabel, descend from its rotations, and bound by the better of both multipliers."""
    reduced = form.reduced
    Q = reduced.dense()
    relaxation = solve_by_clarabel(Q, TOLERANCE, STEPS)
    ends = [descend(reduced, R, STEPS) for R in round_to_rotations(relaxation)]
    best = min(ends, key=lambda end: end.cost)
    r = vec(best.R).ravel()
    of_answer = kkt_multipliers(best.R, reduced.apply(np.append(r, 1.0))[:-1].reshape(-1, 9))
    bounds = [lower_bound(reduced, multipliers, r).lower_bound for multipliers in (relaxation.multipliers, of_answer)]
    bounds.append(_relaxation_bound(Q, relaxation))
    values = np.linalg.eigvalsh(relaxation.X)
    return CertifiedRotations(best.R, best.cost, max(bounds), float(max(values[-2], 0.0) / values[-1]))


def _relaxation_bound(Q: Array, relaxation: Relaxation) -> float:
    """gamma + (3 n + 1) min(0, lambda_min(Z)), as x'x = 3 n + 1: the better one where the relaxation is not tight."""
    Z = Q - scatter(np.einsum("nk,kij->nij", relaxation.multipliers, CONSTRAINTS))
    Z[-1, -1] -= relaxation.dual
    trace = (len(Q) - 1) / 3.0 + 1.0
    return relaxation.dual + trace * min(0.0, float(np.linalg.eigvalsh(Z)[0]))


def check_frames(problem: Problem) -> None:
    """One pair of frames, or one sensor's motions alone.

    Raises
    ------
    FrameError
    """
    if len(problem.pairs) > 1:
        raise FrameError(
            f"one target and one sensor, or one sensor's motions, and here are {len(problem.pairs)} pairs of frames: "
            f"{', '.join(map(str, problem.pairs))}"
        )


METHOD = Method(
    name="wise2020",
    properties=Properties("SE(3)", certifiable=True, monocular=True),
    source="E. Wise, M. Giamou, S. Khoubyarian, A. Grebe and J. Kelly, Certifiably optimal monocular hand-eye "
    "calibration, IEEE MFI 2020",
    assumes="Errors alike in all measurements, a radian as bad as a metre. Proves its answer, or says that it has not.",
    function=wise2020,
    takes=frozenset({Takes.SHARED_SCALE, Takes.MOTIONS}),
    check=check_frames,
)
