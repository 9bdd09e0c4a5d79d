"""The search for a certified answer of one part: starts, descent, dual, small dual, better starts, relaxation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.attempt import Attempt
from gtsam_rwhec.solver.bound import exact_value
from gtsam_rwhec.solver.cause import Cause, Start
from gtsam_rwhec.solver.descent import descend, homogeneous
from gtsam_rwhec.solver.forms import Forms
from gtsam_rwhec.solver.found import Found
from gtsam_rwhec.solver.interior_point import Relaxation
from gtsam_rwhec.solver.mirror import mirrored
from gtsam_rwhec.solver.options import Method, SolveOptions
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.relaxation import round_to_rotations, solve_relaxation
from gtsam_rwhec.solver.rotations import random_rotations
from gtsam_rwhec.solver.stages import Stages
from gtsam_rwhec.solver.start import spectral_start
from gtsam_rwhec.solver.variables import answer_of

#: A mirror image may cost this much more, relatively, and still be what the data mean; more is another answer.
MIRROR_COST = 0.01
#: Entries of rotations that differ by this much are another answer.
TWIN_DISTANCE = 1e-3


def _has_positive_scales(part: Part, form: ReducedForm, R: Array) -> bool:
    answer = answer_of(part, form, R)
    own = answer.own_scale[np.isfinite(answer.own_scale)]
    return answer.scale > 0.0 and bool((own > 0.0).all())


@dataclass(frozen=True)
class Search:
    """One part's search: its forms, and the stages' times."""

    part: Part
    options: SolveOptions
    stages: Stages
    forms: Forms

    @staticmethod
    def of(part: Part, options: SolveOptions, progress: Progress | None = None) -> Search:
        """Build the forms; ``progress`` is called with the name of each stage as it begins."""
        stages = Stages(progress)
        with stages.of("quadratic form"):
            forms = Forms.of(part)
        return Search(part, options, stages, forms)

    @property
    def form(self) -> ReducedForm:
        """Q'."""
        return self.forms.reduced

    def tolerance(self, cost: float) -> float:
        """The absolute gap that counts as none (DESIGN fact 10), or what rounding leaves of it.

        With unit weights 1 means nothing, and with exact data the cost is zero too: then there is only the rounding of
        the form's own entries to compare with.
        """
        unit = 0.0 if self.part.is_relative else 1.0
        rounding = 1e-15 * self.form.size * self.form.magnitude + 1e-250
        return max(self.options.relative_tolerance * max(cost, unit), rounding)

    def run(self, method: Method, initial: Array | None) -> Found:
        """Search with a method; ``initial`` (n, 3, 3) is the start of "local" (and of ``certify``)."""
        if method == "sdp":
            relaxation = self._relax()
            attempt = self._attempt(round_to_rotations(relaxation), relaxation.solver)
            return self._after_relaxation(attempt, relaxation)
        if initial is not None:
            attempt = self._attempt([initial], Start.GIVEN)
        else:
            with self.stages.of("spectral start"):
                starts = spectral_start(self.part, self.forms.rotation)
            attempt = self._attempt(starts, Start.SPECTRAL)
        if attempt.certify() or method == "local" or attempt.is_closed_but_for_rounding:
            return attempt.found()
        if attempt.look_elsewhere() and attempt.certify():
            return attempt.found()
        if attempt.is_large:
            limit = self.options.max_dense_frames
            return attempt.found(Cause.TOO_LARGE, frames=self.form.rotations, max_dense_frames=limit)
        relaxation = self._relax()
        attempt.descend(round_to_rotations(relaxation), relaxation.solver)
        return self._after_relaxation(attempt, relaxation)

    def with_positive_scale(self, found: Found) -> Found:
        """The answer as found, or its mirror image where only that has positive scales and it costs as little.

        Planar motion leaves the sign of a scale open (``mirror``). With noise in A the two costs differ a
        little, and the image may cost more than the bound allows: then it is returned with that gap.
        """
        if _has_positive_scales(self.part, self.form, found.R):
            return found
        with self.stages.of("descent"):
            end = descend(self.form, mirrored(self.part, found.R), self.options.max_descent_iterations)
        likely = end.cost - found.cost <= max(self.tolerance(found.cost), MIRROR_COST * found.cost)
        if not (likely and _has_positive_scales(self.part, self.form, end.R)):
            return found
        cost, _ = exact_value(self.form, homogeneous(end.R))
        image = replace(
            found,
            R=end.R,
            cost=cost,
            lower_bound=min(found.lower_bound, cost),
            tolerance=self.tolerance(cost),
            path=replace(found.path, is_mirrored=True),
        )
        if image.is_closed:
            return image if found.is_closed else replace(image, cause=Cause.PROVEN_AFTER_LOCAL_MINIMUM, figures={})
        if cost > found.cost:
            return replace(image, cause=Cause.MIRROR_IMAGE, figures={"mirror_cost": found.cost})
        return image

    def has_twin(self, found: Found) -> bool:
        """Whether descents from elsewhere find another answer of the same cost.

        Information is about the answer's neighbourhood; twins far away show in a Z that is not definite, which is
        when this is asked.
        """
        if self.form.rotations > self.options.max_dense_frames:
            return False
        generator = np.random.default_rng(self.options.seed)
        with self.stages.of("twins"):
            for _ in range(2 * self.options.random_starts):
                start = random_rotations(self.form.rotations, generator)
                end = descend(self.form, start, self.options.max_descent_iterations)
                elsewhere = float(np.abs(end.R - found.R).max(initial=0.0)) > TWIN_DISTANCE
                if elsewhere and end.cost <= found.cost + self.tolerance(found.cost):
                    return _has_positive_scales(self.part, self.form, end.R)
        return False

    def _attempt(self, starts: list[Array], start: Start) -> Attempt:
        return Attempt(self.form, self.tolerance, self.options, self.stages, starts, start)

    @staticmethod
    def _after_relaxation(attempt: Attempt, relaxation: Relaxation) -> Found:
        attempt.certify(relaxation)
        if attempt.best.cost - relaxation.dual > attempt.tolerance(attempt.best.cost):
            return attempt.found(Cause.NOT_TIGHT, relaxation_cost=relaxation.dual)
        return attempt.found(Cause.ROUNDING)

    def _relax(self) -> Relaxation:
        with self.stages.of("semidefinite relaxation"):
            return solve_relaxation(
                self.form.dense(),
                self.options.relaxation_tolerance,
                self.options.max_relaxation_iterations,
                progress=self.stages.progress,
            )
