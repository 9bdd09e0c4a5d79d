"""The optimum of re-weighted measurements on the way of the outlier rejection: found by descents, and not certified.

A certificate on the way would say nothing about the answer, and where the gap is open it takes a search of its own:
outliers open it often. So a fit is the lowest end of two or three descents, from the last fit and from starts that know
nothing of it. What is kept at the end is solved and certified once (``graduated``).

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
from gtsam_rwhec.solver.descent import descend
from gtsam_rwhec.solver.mirror import mirrored
from gtsam_rwhec.solver.options import SolveOptions
from gtsam_rwhec.solver.parts import Part, parts_of
from gtsam_rwhec.solver.search import MIRROR_COST, Search
from gtsam_rwhec.solver.start import unconstrained_start
from gtsam_rwhec.solver.variables import Answer, answer_of, rotations_as_variables, scales_of

#: So many Newton steps lead from a start to its optimum; three to ten are usual.
MAX_DESCENT_STEPS = 50
#: So many Levenberg-Marquardt steps may lead from the certified optimum to the physical one; below ten is usual.
MAX_STEPS = 30


@dataclass(frozen=True)
class WeightedFit:
    """Poses (4, 4) of the frames that have a measurement, metres; alpha by target (or mover).

    A scale may be negative: outliers may make it so on the way.
    """

    poses: dict[str, Array]
    alpha: dict[str, float]

    @property
    def has_positive_scales(self) -> bool:
        """Whether every scale is positive and finite."""
        return all(0.0 < scale < np.inf for scale in self.alpha.values())


@np.errstate(all="ignore")
def weighted_fit(problem: Problem, previous: WeightedFit | None) -> WeightedFit:
    """The lowest optimum that descents find, from the previous poses too if there are any.

    Raises
    ------
    UnderdeterminedError
        If too few measurements are left.
    """
    poses: dict[str, Array] = {}
    alpha: dict[str, float] = {}
    parts = parts_of(problem)
    for part in parts:
        answer = _solve(part, previous)
        for name, R, t in zip(part.free, answer.R, answer.t, strict=True):
            poses[name] = se3.pose(R, t + part.frame_shift(name))
        poses |= {name: problem.fixed[name] for name in part.fixed}
        alpha |= scales_of(part, answer)
    return at_physical_optimum(problem, parts, WeightedFit(poses, alpha))


def at_physical_optimum(problem: Problem, parts: list[Part], fit: WeightedFit) -> WeightedFit:
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
    return WeightedFit(
        fit.poses | {name: pose.matrix() for name, pose in (end.X | end.Y).items() if name in moved},
        fit.alpha | {pair.target: end.scales[scale] for pair, scale in variables.scale_of_pair.items()},
    )


def _solve(part: Part, previous: WeightedFit | None) -> Answer:
    """A part's answer: the lowest end of the descents, or its mirror image where only that has positive scales."""
    search = Search.of(part, SolveOptions())
    form = search.form
    starts = search.whole.spectral_starts()
    if previous is not None and all(name in previous.poses for name in part.free):
        before = np.array([previous.poses[name][:3, :3] for name in part.free]).reshape(-1, 3, 3)
        starts.append(rotations_as_variables(part, before))
    else:
        starts += unconstrained_start(form)
    ends = [descend(form, start, MAX_DESCENT_STEPS) for start in starts]
    best = min(ends, key=lambda end: end.cost)
    answer = answer_of(part, form, best.R)
    if not answer.has_positive_scales:
        image = descend(form, mirrored(part, best.R), MAX_DESCENT_STEPS)
        reflected = answer_of(part, form, image.R)
        if reflected.has_positive_scales and image.cost <= best.cost * (1.0 + MIRROR_COST) + search.rounding:
            return reflected
    return answer
