"""The search for a certified answer of one part: starts, descent, dual, small dual, better starts, relaxation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.attempt import Attempt
from gtsam_rwhec.solver.cause import Cause, Start
from gtsam_rwhec.solver.descent import descend
from gtsam_rwhec.solver.elimination import Elimination
from gtsam_rwhec.solver.interior_point import Relaxation
from gtsam_rwhec.solver.mirror import mirrored
from gtsam_rwhec.solver.options import Method, SolveOptions
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.relaxation import round_to_rotations, solve_relaxation
from gtsam_rwhec.solver.searched_part import Found, SearchedPart
from gtsam_rwhec.solver.stages import Stages
from gtsam_rwhec.solver.variables import Answer, answer_of

#: A mirror image may cost this part more, and the measurements may still mean it. Above, it is another answer.
MIRROR_COST = 0.01
#: Two answers are different when an entry of their rotations differs by this much.
TWIN_DISTANCE = 1e-3


@dataclass(frozen=True)
class Searched:
    """What remains of a search that has ended: not its forms, which take more memory than all that follows.

    ``search`` has them, where another answer of the same cost may still be looked for (`Search.has_twin`).
    """

    part: Part
    found: Found
    order: Elimination
    stages: Stages
    search: Search | None

    @property
    def has_twin(self) -> bool:
        """Whether another answer costs the same."""
        return self.search is not None and self.search.has_twin(self.found)


class Search(SearchedPart):
    """The search of one part."""

    @staticmethod
    def of(
        part: Part, options: SolveOptions, progress: Progress | None = None, *, contains: Answer | None = None
    ) -> Search:
        """Build the forms; the search calls ``progress`` with the name of each stage as the stage begins."""
        stages = Stages(progress)
        with stages.of("quadratic form"):
            whole = PartForm.of(part)
            _ = whole.form
        return Search(part, options, stages, whole, contains)

    def run(self, method: Method, initial: Array | None) -> Found:
        """Search with a method; ``initial`` (n, 3, 3) is the start of "local" (and of ``certify``)."""
        if method == "sdp":
            relaxation = self._relax()
            return Attempt(self, round_to_rotations(relaxation), relaxation.solver).after_relaxation(relaxation)
        if initial is not None:
            attempt = Attempt(self, [initial], Start.GIVEN)
        else:
            with self.stages.of("spectral start"):
                starts = self.whole.spectral_starts()
            attempt = Attempt(self, starts, Start.SPECTRAL)
        if method == "auto" and self.is_large:
            return attempt.run_locally()
        if attempt.certify() or method == "local" or attempt.is_closed_but_for_rounding:
            return attempt.found()
        if attempt.look_elsewhere() and attempt.certify():
            return attempt.found()
        relaxation = self._relax()
        attempt.descend(round_to_rotations(relaxation), relaxation.solver)
        return attempt.after_relaxation(relaxation)

    def with_positive_scale(self, found: Found) -> Found:
        """The answer as found, or its mirror image where only the image has positive scales and costs as little.

        Planar motion leaves the sign of a scale open (``mirror``). With noise in A the two costs differ a little, and
        the image may cost more than the bound allows: then the image is returned with this gap.
        """
        if self._has_positive_scales(found.R):
            return found
        with self.stages.of("descent"):
            end = descend(self.form, mirrored(self.part, found.R), self.options.max_descent_iterations)
        likely = end.cost - found.cost <= max(self.tolerance(found.cost), self.rounding, MIRROR_COST * found.cost)
        if not (likely and self._has_positive_scales(end.R)):
            return found
        attempt = Attempt(self, [end.R], found.path.start)
        attempt.certify()
        image = attempt.found(Cause.MIRROR_IMAGE, mirror_cost=found.cost)
        image = replace(image, path=replace(image.path, is_mirrored=True))
        if not image.is_closed and found.bound.region is None:  # found's bound holds for all answers
            image = replace(image, bound=found.bound.at_most(attempt.lowest))
        if image.is_closed:
            cause = image.cause if image.cause is not Cause.MIRROR_IMAGE else found.cause
            proven = cause if found.is_closed else Cause.PROVEN_AFTER_LOCAL_MINIMUM
            return replace(image, cause=proven, figures={})
        if image.cost > found.cost + self.tolerance(found.cost):
            return replace(image, cause=Cause.MIRROR_IMAGE, figures={"mirror_cost": found.cost})
        return replace(image, cause=Cause.ROUNDING, figures={})

    def ended(self, found: Found) -> Searched:
        """What was found, without the forms where nothing more is searched: in large parts no twin is."""
        keeps = found.is_closed and not found.bound.definite and not self.is_large
        return Searched(self.part, found, self.whole.order, self.stages, self if keeps else None)

    def has_twin(self, found: Found) -> bool:
        """Whether descents from random starts find another answer of the same cost.

        The information matrix shows only the neighbourhood of the answer. If there is a twin far away, Z is not
        positive definite: only then is this function called.
        """
        with self.stages.of("twins"):
            for start in self.random_starts(2 * self.options.random_starts):
                end = descend(self.form, start, self.options.max_descent_iterations)
                elsewhere = float(np.abs(end.R - found.R).max(initial=0.0)) > TWIN_DISTANCE
                if elsewhere and end.cost <= found.cost + max(self.tolerance(found.cost), self.rounding):
                    return self._has_positive_scales(end.R)
        return False

    def _has_positive_scales(self, R: Array) -> bool:
        return answer_of(self.part, self.form, R).has_positive_scales

    def _relax(self) -> Relaxation:
        options = self.options
        with self.stages.of("semidefinite relaxation"):
            return solve_relaxation(
                self.whole.reduced.dense(),
                options.relaxation_tolerance,
                options.max_relaxation_iterations,
                self.stages.progress,
            )
