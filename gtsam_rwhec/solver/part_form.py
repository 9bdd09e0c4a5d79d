"""Everything that is known of a part's cost: its quadratic forms, its curvature, and its enclosed values."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from rwhec_factors.se3 import so3_nearest

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.answers import Answer, Evaluation, Form, Point, answer_at, answer_of, as_point
from gtsam_rwhec.solver.block_matrix import BlockMatrix
from gtsam_rwhec.solver.curvature import Curvature
from gtsam_rwhec.solver.descent import SearchForm
from gtsam_rwhec.solver.full_form import Slots, full_forms, rounding_of, slots_of
from gtsam_rwhec.solver.graph_form import GraphForm
from gtsam_rwhec.solver.measured_form import MeasuredForm
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import kkt_multipliers, retract, tangent_basis, unvec, vec
from gtsam_rwhec.solver.stored_form import StoredForm

#: No step is taken if the gradient can lower the cost by less than about this fraction of it.
WORTH = 1e-18
#: This fraction of the Hessian's diagonal is added to it, because the measurements may leave directions free.
DAMPING = 1e-9
#: A step that moves a rotation (rad), a translation over the largest, or a scale over itself, by more than this is not
#: taken: the start was near the optimum already.
LONGEST = 1e-2


def is_worth_a_step(curvature: Curvature, evaluation: Evaluation) -> bool:
    """Whether the gradient along the rotations' tangents and the other variables is more than rounding."""
    g = _tangent_gradient(evaluation)
    scale = np.abs(curvature.diagonal)
    frames = scale[:-1].reshape(-1, 13)
    of_turns = np.repeat(frames[:, 4:].mean(axis=1, keepdims=True), 3, axis=1)
    by_tangent = np.append(np.concatenate([frames[:, :4], of_turns], axis=1).ravel(), scale[-1])
    gain = float((g**2 / np.maximum(by_tangent, 1e-290)).sum())
    return gain > WORTH * evaluation.cost


def newton_step(curvature: Curvature, evaluation: Evaluation) -> Point | None:
    """The point after one Newton step; None where the Hessian is not positive definite, or the step is long."""
    point = evaluation.point
    R = point.rotations
    n = len(R)
    gradient = evaluation.gradient[:-1].reshape(n, 13)[:, 4:]
    T = np.zeros((n, 13, 7))
    T[:, :4, :4] = np.eye(4)
    T[:, 4:, 4:] = tangent_basis(R)
    hessian = curvature.less(kkt_multipliers(R, gradient)).matrix.congruent(T)
    factor = hessian.factor()
    if factor is None:
        factor = hessian.plus(DAMPING * hessian.diagonal).factor()
    if factor is None:
        return None
    step = factor.solve_vector(_tangent_gradient(evaluation))
    by_frame = step[:-1].reshape(n, 7)
    reach = max(float(np.abs(point.numbers[:, :3]).max(initial=0.0)), 1e-9)
    scales = np.append(point.numbers[:, 3], point.alpha)
    of_scales = np.append(by_frame[:, 3], step[-1]) / np.maximum(np.abs(scales), 1e-290)
    lengths = np.r_[by_frame[:, 4:].ravel(), by_frame[:, :3].ravel() / reach, of_scales]
    if not np.abs(lengths).max() <= LONGEST:
        return None
    numbers = point.numbers.copy()
    numbers[:, :4] -= by_frame[:, :4]
    numbers[:, 4:] = vec(retract(R, -by_frame[:, 4:]))
    return Point(numbers, point.alpha - float(step[-1]))


def _tangent_gradient(evaluation: Evaluation) -> Array:
    """(7 n + 1,): by [t, own scale, right perturbation of R] of each frame, and alpha."""
    point = evaluation.point
    n = len(point.numbers)
    gradient = evaluation.gradient[:-1].reshape(n, 13)
    turning = np.matmul(tangent_basis(point.rotations).transpose(0, 2, 1), gradient[:, 4:, None])[:, :, 0]
    return np.append(np.concatenate([gradient[:, :4], turning], axis=1).ravel(), evaluation.gradient[-1])


#: Up to this many frames, the search uses Q' as one matrix.
DENSE_FRAMES = 40
#: The most Newton steps after the elimination; one is usual with extreme weights, none with other weights.
STEPS = 6


@dataclass(frozen=True)
class PartForm:
    """The cost of a part: ``full`` over all variables, ``rotation`` of the rotation residuals alone, both as stored."""

    part: Part
    slots: Slots
    full: BlockMatrix
    rotation: BlockMatrix

    @staticmethod
    def of(part: Part) -> PartForm:
        """Build the forms from the part's moments."""
        slots = slots_of(part)
        return PartForm(part, slots, *full_forms(part, slots))

    @cached_property
    def reduced(self) -> ReducedForm:
        """The form with translations and scales eliminated, where Q' is needed as a matrix."""
        return ReducedForm.of(self.full)

    @cached_property
    def form(self) -> SearchForm:
        """The form that the search uses: Q' as a matrix, or as products over the graph for many frames."""
        by_graph = GraphForm.of(self.full) if len(self.part.free) > DENSE_FRAMES else None
        return by_graph or self.reduced

    @cached_property
    def curvature(self) -> Curvature:
        """Q without h, with a diagonal that dominates its rounding error.

        Without measurements the cost is that of the sums as they are; what is rounded in them holds no translation.
        """
        rounding = rounding_of(self.part, self.slots)
        if self.part.given is None:
            rounding[:-1].reshape(-1, 13)[:, 4:] = 0.0
        return Curvature.of(self.full, rounding)

    @cached_property
    def cost(self) -> Form:
        """Enclosed values of the cost: of the raw measurements where they were kept, else of the stored moments."""
        return self._measured or StoredForm(self.full)

    @cached_property
    def _measured(self) -> MeasuredForm | None:
        given = self.part.given
        return None if given is None else MeasuredForm(self.part, given, self.slots)

    def evaluated(self, answer: Answer, t: Array | None = None) -> Evaluation:
        """The cost of an answer as it is returned: poses in double precision about the user's origin.

        ``t`` (n, 3): the translations as they were given; the answer has them about the gauge, with a rounding.
        """
        if self._measured is None or not answer.has_positive_scales:
            return self.cost.at(as_point(self.part, answer))
        if t is None:
            t = answer.t + np.array([self.part.frame_shift(name) for name in self.part.free]).reshape(-1, 3)
        return self._measured.at_poses(answer.R, t, answer)

    def answer_near(self, R: Array) -> tuple[Answer, Evaluation]:
        """The answer with the best translations and scales for rotations of the form, polished, and its cost."""
        return self._polished(answer_of(self.part, self.form, R))

    def moved(self, evaluation: Evaluation, step: Array) -> tuple[Answer, Evaluation]:
        """The answer after a step (13 n + 1,) in the form's variables, with its rotations projected, and polished."""
        point = evaluation.point
        numbers = point.numbers + step[:-1].reshape(point.numbers.shape)
        R = so3_nearest(unvec(numbers[:, 4:]))
        return self._polished(answer_at(self.part, R, numbers[:, :4], point.alpha + float(step[-1])))

    def _polished(self, answer: Answer) -> tuple[Answer, Evaluation]:
        """Newton steps on the cost of the measurements."""
        evaluation = self.evaluated(answer)
        for _ in range(STEPS):
            if not (np.isfinite(evaluation.cost) and is_worth_a_step(self.curvature, evaluation)):
                break
            point = newton_step(self.curvature, evaluation)
            if point is None or not (np.isfinite(point.numbers).all() and np.isfinite(point.alpha)):
                break
            better = answer_at(self.part, point.rotations, point.numbers[:, :4], point.alpha)
            after = self.evaluated(better)
            if not after.cost < evaluation.cost:
                break
            answer, evaluation = better, after
        return answer, evaluation
