"""Problems for the certified core's tests, and its forms and points on them."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

import gtsam_rwhec as rw
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import ScaleMode
from gtsam_rwhec.simulate import Noise, Simulation, general
from gtsam_rwhec.solver.answers import Evaluation
from gtsam_rwhec.solver.bound import Bound, lower_bound
from gtsam_rwhec.solver.descent import Descent, descend, homogeneous, spectral_start
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import Part, parts_of
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import kkt_multipliers, vec
from gtsam_rwhec.solver.search import Search
from gtsam_rwhec.solver.solve_options import SolveOptions

#: One centimetre, and half a degree about each axis.
SMALL_NOISE = Noise(0.01, 6500.0)
#: Sixty degrees about each axis, and half a metre.
GROSS_NOISE = Noise(0.5, 0.4)
SCALES: tuple[ScaleMode, ...] = ("known", "shared", "per_target")


def simulated(targets: int = 2, sensors: int = 1, seed: int = 0, **options: Any) -> Simulation:
    """A general problem with small noise and ten measurements a pair, unless told otherwise."""
    return general(targets, sensors, seed=seed, **{"noise": SMALL_NOISE, "number_of_measurements": 10} | options)


def part_of(problem: rw.Problem) -> Part:
    """The one part of a connected problem."""
    (part,) = parts_of(problem)
    return part


def reduced(problem: rw.Problem) -> ReducedForm:
    """Q' of a connected problem."""
    return PartForm.of(part_of(problem)).reduced


def searched(problem: rw.Problem, **options: Any) -> Search:
    """A search that has not run."""
    return Search.of(part_of(problem), SolveOptions(**options))


def solved(problem: rw.Problem, method: str = "auto", **options: object) -> rw.Solution:
    """Solve without warnings: tests read the certificate."""
    with warnings.catch_warnings(action="ignore", category=rw.errors.RwhecWarning):
        return rw.solve(problem, method, options=SolveOptions(**options))


def optimum(problem: rw.Problem) -> Descent:
    """Where the descent from the spectral start ends."""
    part = part_of(problem)
    forms = PartForm.of(part)
    ends = [descend(forms.reduced, start, 200) for start in spectral_start(part, forms.rotation)]
    return min(ends, key=lambda end: end.cost)


def multipliers_at(form: ReducedForm, R: Array) -> Array:
    """Those of R'R = I at a point."""
    return kkt_multipliers(R, form.apply(homogeneous(R))[:-1].reshape(-1, 9))


def whole(problem: rw.Problem) -> PartForm:
    """All that is known of the cost of a connected problem."""
    return PartForm.of(part_of(problem))


def kkt_of(evaluation: Evaluation) -> Array:
    """The multipliers of R'R = I by the gradient at a point, whose numbers are 13 for each frame and one more."""
    return kkt_multipliers(evaluation.point.rotations, evaluation.gradient[:-1].reshape(-1, 13)[:, 4:])


def bound_at(form: PartForm, R: Array, multipliers: Array | None = None) -> tuple[Bound, Evaluation]:
    """The bound at rotations of the form, by the multipliers of R'R = I unless others are given; and the cost there."""
    _, evaluation = form.answer_near(R)
    return lower_bound(form, evaluation, kkt_of(evaluation) if multipliers is None else multipliers), evaluation


def gradient_norm(form: ReducedForm, R: Array) -> float:
    """Of the Riemannian gradient, halved, over the size of the form."""
    G = form.apply(homogeneous(R))[:-1].reshape(-1, 9)
    skew = R.transpose(0, 2, 1) @ G.reshape(-1, 3, 3).transpose(0, 2, 1)
    return float(np.linalg.norm(skew - skew.transpose(0, 2, 1))) / form.magnitude


def true_rotations(simulation: Simulation) -> Array:
    """The truth as the form's variables; inverted in the form turned round."""
    part = part_of(simulation.problem)
    frames = simulation.X | simulation.Y
    R = np.array([frames[name][:3, :3] for name in part.free])
    return R if part.kind == "direct" else R.transpose(0, 2, 1)


def flat(R: Array) -> Array:
    """vec R_1, ..., vec R_n, one after the other."""
    return vec(R).ravel()
