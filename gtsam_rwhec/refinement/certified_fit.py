"""The certified optimum of re-weighted measurements, without the parts of a solution that only a final answer needs.

With a scale for each target the certified form is C X'_j = Y'_k A (design fact 7). There the noise of a measured
rotation acts on a lever arm, so at that form's optimum the physical residuals are larger than sigma says. Outliers are
found by their physical residuals. So each fit is carried on to the nearest minimum of the physical cost,

    1/2 sum |alpha_j (R_A t_X + t_A - t_Y) - R_Y t_B|^2 / sigma^2 + kappa |R_A R_X - R_Y R_B|_F^2,

by GTSAM, from the same moments.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array, to_pose3
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.variance_factors import AS_STATED
from gtsam_rwhec.refinement import graph as graphs
from gtsam_rwhec.refinement.optimisation import optimise
from gtsam_rwhec.refinement.variables import State, Variables
from gtsam_rwhec.solver.options import SolveOptions
from gtsam_rwhec.solver.parts import Part, parts_of
from gtsam_rwhec.solver.search import Found, Search
from gtsam_rwhec.solver.variables import Answer, rotations_as_variables, scales_of

#: With more free frames than this a gap stays open on the way. The semidefinite relaxation would take most of the time,
#: and the final, full solution has its own certificate.
FRAMES_RELAXED = 12
#: So many Levenberg-Marquardt steps may lead from the certified optimum to the physical one; below ten is usual.
MAX_STEPS = 30


@dataclass(frozen=True)
class CertifiedFit:
    """Poses (4, 4) of the frames that have a measurement, metres; alpha by target (or mover); whether all is certified.

    A scale may be negative: outliers may make it so on the way.
    """

    poses: dict[str, Array]
    alpha: dict[str, float]
    certified: bool


@np.errstate(all="ignore")
def certified_fit(problem: Problem, previous: CertifiedFit | None) -> CertifiedFit:
    """The global optimum; the search starts at the previous poses if there are any.

    Raises
    ------
    UnderdeterminedError
        If too few measurements are left.
    """
    poses: dict[str, Array] = {}
    alpha: dict[str, float] = {}
    certified = True
    parts = parts_of(problem)
    for part in parts:
        answer, closed = _solve(part, previous)
        certified = certified and closed
        for name, R, t in zip(part.free, answer.R, answer.t, strict=True):
            poses[name] = se3.pose(R, t + part.frame_shift(name))
        poses |= {name: problem.fixed[name] for name in part.fixed}
        alpha |= scales_of(part, answer)
    return at_physical_optimum(problem, parts, CertifiedFit(poses, alpha, certified))


def at_physical_optimum(problem: Problem, parts: list[Part], fit: CertifiedFit) -> CertifiedFit:
    """The nearest minimum of the physical cost for parts of the inverse equation; parts with a negative scale stay."""
    inverse = [
        part
        for part in parts
        if part.kind == "inverse" and all(0.0 < fit.alpha[pair.target] < np.inf for pair in part.pairs)
    ]
    if not inverse:
        return fit
    variables = Variables.of(problem, ())
    graph = gtsam.NonlinearFactorGraph()
    for part in inverse:
        for e, pair in enumerate(part.pairs):
            graphs.add_summary(graph, variables, pair, graphs.summary_of(part, e, AS_STATED))
    graphs.add_knowledge(graph, variables, problem, "chordal")
    poses = {name: to_pose3(T[:3, :3], T[:3, 3]) for name, T in fit.poses.items()}
    start = State(
        X={name: poses[name] for name in problem.targets},
        Y={name: poses[name] for name in problem.sensors},
        scales={scale: fit.alpha[pair.target] for pair, scale in variables.scale_of_pair.items()},
        offsets_s={},
    )
    end = variables.state(optimise(graph, variables.values(start), MAX_STEPS).values)
    moved = {name for part in inverse for name in part.names}
    return CertifiedFit(
        fit.poses | {name: pose.matrix() for name, pose in (end.X | end.Y).items() if name in moved},
        fit.alpha | {pair.target: end.scales[scale] for pair, scale in variables.scale_of_pair.items()},
        fit.certified,
    )


def _solve(part: Part, previous: CertifiedFit | None) -> tuple[Answer, bool]:
    """A part's answer, and whether its gap is closed."""
    search = Search.of(part, SolveOptions(max_dense_frames=FRAMES_RELAXED))
    found: Found | None = None
    if previous is not None and all(name in previous.poses for name in part.free):
        start = np.array([previous.poses[name][:3, :3] for name in part.free]).reshape(-1, 3, 3)
        found = search.run("local", rotations_as_variables(part, start))
    if found is None or not found.is_closed:
        again = search.run("auto", None)
        if found is None or again.cost < found.cost:
            found = again
    found = search.with_positive_scale(found)
    return found.answer, found.is_closed
