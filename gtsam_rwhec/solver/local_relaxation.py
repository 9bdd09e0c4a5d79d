"""The semidefinite relaxation of a few frames, with the multipliers of R'R = I kept for all others.

For any multipliers of the other frames, eliminating them leaves a quadratic form of the few frames' rotations that is
nowhere above the cost (`local_dual`). Its relaxation is small, and its optimum is a lower bound on the cost of every
answer. The bound is lower than that of the relaxation of all frames where those kept multipliers are not the best. The
rotations of its optimum, with all other variables as they follow, are the start that leaves local minima of several
frames together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.local_blocks import scatter
from gtsam_rwhec.solver.local_dual import LocalForm
from gtsam_rwhec.solver.options import SolveOptions
from gtsam_rwhec.solver.point import Evaluation
from gtsam_rwhec.solver.relaxation import round_to_rotations, solve_relaxation
from gtsam_rwhec.solver.rotations import CONSTRAINTS, project, unvec, vec


@dataclass(frozen=True)
class LocalRelaxation:
    """A solution of the relaxation of a few frames, up to the solver's accuracy."""

    multipliers: Array  #: (n, 20), of all frames
    dual: float  #: its optimum: no answer costs less
    starts: list[Array]  #: rotations (n, 3, 3) of all frames


def relax_locally(
    evaluation: Evaluation, kkt: Array, form: LocalForm, options: SolveOptions, progress: Progress | None = None
) -> LocalRelaxation:
    """Solve the relaxation of the frames of ``form``; ``kkt`` (n, 20) are those of R'R = I at the evaluated point."""
    Q = form.Z + scatter(np.einsum("nk,kpq->npq", form.kkt, CONSTRAINTS))
    Q[-1, -1] += evaluation.cost  # Z has it taken off, so that Z x = 0
    relaxation = solve_relaxation(Q, options.relaxation_tolerance, options.max_relaxation_iterations, progress)
    multipliers = kkt.copy()
    multipliers[form.frames] = relaxation.multipliers
    starts = []
    for R in round_to_rotations(relaxation):
        followed = form.follow @ np.append(vec(R).ravel(), 1.0)
        starts.append(project(unvec(followed[:-1].reshape(-1, 13)[:, 4:])))
    return LocalRelaxation(multipliers, relaxation.dual, starts)
