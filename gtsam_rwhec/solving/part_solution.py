"""The solution of one part: its answer, residuals, identifiability and certificate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.errors import ScaleError
from gtsam_rwhec.identifiability.free_directions import FreeDirection, FreeKind, FreeReason
from gtsam_rwhec.identifiability.identification import identify
from gtsam_rwhec.identifiability.verdicts import Identifiability
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.solver.cause import Cause
from gtsam_rwhec.solver.certificate import Basis, Certificate, Objective
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.residuals import PairPoses, Residual, costs_of_pairs, residuals_of_pairs
from gtsam_rwhec.solver.search import Searched
from gtsam_rwhec.solver.variables import Answer, scales_of

TWIN = FreeDirection(FreeKind.TWIN, FreeReason.SYMMETRY)


@dataclass(frozen=True)
class PartSolution:
    """One solved part; ``residual_cost`` is the cost of its measurements alone, in the physical model."""

    part: Part
    answer: Answer
    certificate: Certificate
    identifiability: Identifiability
    residuals: dict[Pair, Residual]
    residual_cost: float

    @staticmethod
    def of(searched: Searched) -> PartSolution:
        """Complete what a search found; a ``ScaleError`` for a scale that is not positive."""
        part, found = searched.part, searched.found
        with searched.stages.of("identifiability"):
            answer = found.answer
            _check_scale(part, answer, found.is_closed)
            poses = PairPoses.of(part, answer)
            J_t, J_R = costs_of_pairs(part, poses)
            known = identify(part, poses, J_t, J_R, searched.order)
        bound = found.bound
        if not (np.isfinite(bound.lower_bound) and np.isfinite(found.cost)):
            found = replace(found, cause=Cause.NO_BOUND, figures={})
        elif found.is_closed and not known.is_unique:
            number = float(len(known.free_directions))
            found = replace(found, cause=Cause.FREE_DIRECTIONS, figures={"free_directions": number})
        elif found.is_closed and not bound.definite and searched.has_twin:
            found = replace(found, cause=Cause.TWIN, figures={})
            known = replace(known, is_unique=False, free_directions=(TWIN,))
        certificate = Certificate(
            status=found.cause.status,
            cause=found.cause,
            objective=Objective.of(part),
            basis=Basis.MOMENTS if part.given is None else Basis.MEASUREMENTS,
            region=bound.region,
            path=found.path,
            cost=found.cost,
            lower_bound=bound.lower_bound,
            float_bound=bound.value if bound.definite else bound.lower_bound,
            min_eigenvalue=-max(found.cost - bound.lower_bound, 0.0) if bound.definite else bound.eigenvalue,
            tolerance=found.tolerance,
            is_relative=part.is_relative,
            seconds=dict(searched.stages.seconds),
            figures=found.figures,
        )
        residuals = residuals_of_pairs(part, poses, J_t, J_R)
        return PartSolution(part, answer, certificate, known, residuals, float(J_t.sum() + J_R.sum()))


def _check_scale(part: Part, answer: Answer, proven: bool) -> None:
    of_frame = scales_of(part, answer)
    scales = {"the scale": answer.scale} if part.scale == "shared" else {}
    scales |= {f"the scale of {name}": of_frame[name] for name in part.free if name in part.scale_owners}
    for what, value in scales.items():
        if not (np.isfinite(value) and value > 0.0):
            raise ScaleError(
                f"{what} is {value:.6g} at the {'optimum' if proven else 'best point found'}, which no real target "
                "has. Either the poses contradict the frame convention (is B = T_sensor_target? is A inverted?), or "
                "the motion was planar, where a mirror image fits too (turn about a second axis), or the "
                "noise is too large to find the scale (SolveOptions(nonnegative_scale=True) constrains a shared one)"
            )
