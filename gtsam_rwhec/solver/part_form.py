"""Everything that is known of a part's cost: its quadratic forms, its curvature, and its enclosed values."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.answers import Answer, Evaluation, Form, answer_at, answer_of, as_point
from gtsam_rwhec.solver.block_matrix import BlockMatrix
from gtsam_rwhec.solver.curvature import Curvature
from gtsam_rwhec.solver.descent import SearchForm
from gtsam_rwhec.solver.full_form import Slots, full_forms, rounding_of, slots_of
from gtsam_rwhec.solver.graph_form import GraphForm
from gtsam_rwhec.solver.measured_form import MeasuredForm
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.polish import is_worth_a_step, newton_step
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import project, unvec
from gtsam_rwhec.solver.stored_form import StoredForm

#: Up to so many frames Q' is one matrix for the search.
DENSE_FRAMES = 40
#: Newton steps that follow the elimination; one is usual with extreme weights, and none without.
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
        """Translations and scales eliminated, for all that needs Q' as a matrix."""
        return ReducedForm.of(self.full)

    @cached_property
    def form(self) -> SearchForm:
        """Where the search looks for answers: Q' as a matrix, or by the graph where frames are many."""
        by_graph = GraphForm.of(self.full) if len(self.part.free) > DENSE_FRAMES else None
        return by_graph or self.reduced

    @cached_property
    def curvature(self) -> Curvature:
        """Q without h, with what dominates its rounding."""
        rounding = None if self.part.given is None else rounding_of(self.part, self.slots)
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

        ``t`` (n, 3) are translations as they were given, which the answer has about the gauge, rounded.
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
        R = project(unvec(numbers[:, 4:]))
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
