"""The solution of one part: answer, residuals, identifiability and certificate put together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.errors import ScaleError
from gtsam_rwhec.identifiability.free_directions import FreeDirection, FreeKind, FreeReason
from gtsam_rwhec.identifiability.identification import identify
from gtsam_rwhec.identifiability.verdicts import Identifiability
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.solver.cause import Cause
from gtsam_rwhec.solver.certificate import Certificate, Objective
from gtsam_rwhec.solver.found import Found
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.residuals import PairPoses, Residual, costs_of_pairs, residuals_of_pairs
from gtsam_rwhec.solver.search import Search
from gtsam_rwhec.solver.variables import Answer, answer_of, as_variables

TWIN = FreeDirection(FreeKind.TWIN, FreeReason.SYMMETRY)


@dataclass(frozen=True)
class PartSolution:
    """Of one part; ``residual_cost`` is that of the measurements alone, in the physical model."""

    part: Part
    answer: Answer
    certificate: Certificate
    identifiability: Identifiability
    residuals: dict[Pair, Residual]
    residual_cost: float

    @staticmethod
    def of(search: Search, found: Found) -> PartSolution:
        """Translations and scales, residuals, identifiability, and the certificate of what a search found.

        Raises
        ------
        ScaleError
            For a scale that is not positive.
        """
        part = search.part
        with search.stages.of("identifiability"):
            answer = answer_of(part, search.form, found.R)
            _check_scale(part, answer, found.is_closed)
            poses = PairPoses.of(part, answer)
            J_t, J_R = costs_of_pairs(part, poses)
            known = identify(part, poses, J_t, J_R)
        # The bound speaks of the reduced form; the answer's cost in the unreduced one shows what reducing it lost.
        cost = max(search.forms.full.value(*as_variables(part, answer)), 0.0)
        cause, figures = found.cause, found.figures
        if not np.isfinite(found.lower_bound):
            cause, figures = Cause.NO_BOUND, {}
        elif abs(cost - found.cost) > found.tolerance:
            cause, figures = Cause.DIGITS_LOST, {"reduced_cost": found.cost}
            # Zero, as J is a sum of squares: the one bound that stays true.
            found = replace(found, cost=cost, lower_bound=0.0, tolerance=search.tolerance(cost))
        elif found.is_closed and not known.is_unique:
            cause, figures = Cause.FREE_DIRECTIONS, {"free_directions": float(len(known.free_directions))}
        elif found.is_closed and not found.is_definite and search.has_twin(found):
            cause, figures = Cause.TWIN, {}
            known = replace(known, is_unique=False, free_directions=(TWIN,))
        certificate = Certificate(
            status=cause.status,
            cause=cause,
            objective=Objective(part.kind, bool(part.priors)),
            path=found.path,
            cost=found.cost,
            lower_bound=found.lower_bound,
            float_bound=found.float_bound if found.is_definite else found.lower_bound,
            min_eigenvalue=-max(found.cost - found.lower_bound, 0.0) if found.is_definite else found.eigenvalue,
            tolerance=found.tolerance,
            is_relative=part.is_relative,
            seconds=dict(search.stages.seconds),
            figures=figures,
        )
        residuals = residuals_of_pairs(part, poses, J_t, J_R)
        return PartSolution(part, answer, certificate, known, residuals, float(J_t.sum() + J_R.sum()))


def _check_scale(part: Part, answer: Answer, proven: bool) -> None:
    scales = {"the scale": answer.scale} if part.scale == "shared" else {}
    for name, value in zip(part.free, answer.own_scale, strict=True):
        if name in part.scale_owners:
            scales[f"the scale of {name}"] = float(value)
    for what, value in scales.items():
        if not (np.isfinite(value) and value > 0.0):
            raise ScaleError(
                f"{what} is {value:.6g} at the {'optimum' if proven else 'best point found'}, which no real target "
                "has. Either the poses contradict the frame convention (is B = T_sensor_target? is A inverted?), or "
                "the motion was planar, where a mirror image fits too (turn about a second axis), or "
                "the noise drowns the scale (SolveOptions(nonnegative_scale=True) constrains a shared one)"
            )
