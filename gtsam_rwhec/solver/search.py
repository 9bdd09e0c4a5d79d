"""The search for a certified answer of one part: starts, descent, dual, small dual, better starts, relaxation."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver import small_dual
from gtsam_rwhec.solver.bound import Bound, exact_value, lower_bound
from gtsam_rwhec.solver.cause import Cause, Multipliers, SearchPath, Start
from gtsam_rwhec.solver.descent import Descent, descend, homogeneous
from gtsam_rwhec.solver.interior_point import Relaxation
from gtsam_rwhec.solver.mirror import mirrored
from gtsam_rwhec.solver.options import Method, SolveOptions
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.reduced_form import Forms, ReducedForm
from gtsam_rwhec.solver.relaxation import round_to_rotations, solve_relaxation
from gtsam_rwhec.solver.rotations import kkt_multipliers, project, random_rotations, unvec, vec
from gtsam_rwhec.solver.stages import Stages
from gtsam_rwhec.solver.start import spectral_start, unconstrained_start
from gtsam_rwhec.solver.variables import answer_of

#: A mirror image may cost this part more, and the measurements may still mean it. Above, it is another answer.
MIRROR_COST = 0.01
#: Two answers are different when an entry of their rotations differs by this much.
TWIN_DISTANCE = 1e-3
#: A search has this bound before it has tried any multipliers.
NOTHING_YET = Bound()


@dataclass(frozen=True)
class Found:
    """The best rotations of a part and the best bound on the cost of any answer."""

    R: Array  #: (n, 3, 3), in the order of ``part.free``, as the form has them
    cost: float  #: x'Q'x at R
    bound: Bound  #: its ``lower_bound`` is at most ``cost``
    tolerance: float  #: the absolute gap up to which the answer counts as proven optimal
    path: SearchPath
    cause: Cause
    figures: dict[str, float] = field(default_factory=dict)  #: numbers in the cause's sentence, by name

    @property
    def is_closed(self) -> bool:
        """Whether the gap is within the tolerance: the answer is proven optimal."""
        return self.cost - self.bound.lower_bound <= self.tolerance


@dataclass(frozen=True)
class Search:
    """The search of one part: its forms, and the times of the stages."""

    part: Part
    options: SolveOptions
    stages: Stages
    forms: Forms

    @staticmethod
    def of(part: Part, options: SolveOptions, progress: Progress | None = None) -> Search:
        """Build the forms; the search calls ``progress`` with the name of each stage as the stage begins."""
        stages = Stages(progress)
        with stages.of("quadratic form"):
            forms = Forms.of(part)
        return Search(part, options, stages, forms)

    @property
    def form(self) -> ReducedForm:
        """Q'."""
        return self.forms.reduced

    @property
    def is_large(self) -> bool:
        """Whether the part is too large for the dense methods: small dual and relaxation."""
        return self.form.rotations > self.options.max_dense_frames

    def tolerance(self, cost: float) -> float:
        """The absolute gap that counts as zero (design fact 10), and at least the rounding of the form's entries.

        With unit weights a cost of 1 has no meaning, and with exact data the cost is zero. Then only the rounding is
        left to compare with.
        """
        unit = 0.0 if self.part.is_relative else 1.0
        rounding = 1e-15 * self.form.size * self.form.magnitude + 1e-250
        return max(self.options.relative_tolerance * max(cost, unit), rounding)

    def random_starts(self, count: int) -> list[Array]:
        """Random rotations (n, 3, 3); the same ones in each call."""
        generator = np.random.default_rng(self.options.seed)
        return [random_rotations(self.form.rotations, generator) for _ in range(count)]

    def run(self, method: Method, initial: Array | None) -> Found:
        """Search with a method; ``initial`` (n, 3, 3) is the start of "local" (and of ``certify``)."""
        if method == "sdp":
            relaxation = self._relax()
            return _Attempt(self, round_to_rotations(relaxation), relaxation.solver).after_relaxation(relaxation)
        if initial is not None:
            attempt = _Attempt(self, [initial], Start.GIVEN)
        else:
            with self.stages.of("spectral start"):
                starts = spectral_start(self.part, self.forms.rotation)
            attempt = _Attempt(self, starts, Start.SPECTRAL)
        if attempt.certify() or method == "local" or attempt.is_closed_but_for_rounding:
            return attempt.found()
        if attempt.look_elsewhere() and attempt.certify():
            return attempt.found()
        if self.is_large:
            limit = self.options.max_dense_frames
            return attempt.found(Cause.TOO_LARGE, frames=self.form.rotations, max_dense_frames=limit)
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
        likely = end.cost - found.cost <= max(self.tolerance(found.cost), MIRROR_COST * found.cost)
        if not (likely and self._has_positive_scales(end.R)):
            return found
        cost, _ = exact_value(self.form, homogeneous(end.R))
        image = replace(
            found,
            R=end.R,
            cost=cost,
            bound=replace(found.bound, lower_bound=min(found.bound.lower_bound, cost)),
            tolerance=self.tolerance(cost),
            path=replace(found.path, is_mirrored=True),
        )
        if image.is_closed:
            return image if found.is_closed else replace(image, cause=Cause.PROVEN_AFTER_LOCAL_MINIMUM, figures={})
        if cost > found.cost:
            return replace(image, cause=Cause.MIRROR_IMAGE, figures={"mirror_cost": found.cost})
        return image

    def has_twin(self, found: Found) -> bool:
        """Whether descents from random starts find another answer of the same cost.

        The information matrix shows only the neighbourhood of the answer. If there is a twin far away, Z is not
        positive definite: only then is this function called.
        """
        if self.is_large:
            return False
        with self.stages.of("twins"):
            for start in self.random_starts(2 * self.options.random_starts):
                end = descend(self.form, start, self.options.max_descent_iterations)
                elsewhere = float(np.abs(end.R - found.R).max(initial=0.0)) > TWIN_DISTANCE
                if elsewhere and end.cost <= found.cost + self.tolerance(found.cost):
                    return self._has_positive_scales(end.R)
        return False

    def _has_positive_scales(self, R: Array) -> bool:
        answer = answer_of(self.part, self.form, R)
        own = answer.own_scale[np.isfinite(answer.own_scale)]
        return answer.scale > 0.0 and bool((own > 0.0).all())

    def _relax(self) -> Relaxation:
        options = self.options
        with self.stages.of("semidefinite relaxation"):
            return solve_relaxation(
                self.form.dense(), options.relaxation_tolerance, options.max_relaxation_iterations, self.stages.progress
            )


class _Attempt:
    """The best point that the descents of a search have reached, its start, and the best bound at this point."""

    def __init__(self, search: Search, starts: list[Array], start: Start) -> None:
        self.search, self.form, self.stages = search, search.form, search.stages
        self.best = Descent(starts[0], np.inf, 0, converged=False)
        self.start, self.multipliers, self.bound = start, Multipliers.KKT, NOTHING_YET
        self.descend(starts, start)
        self.first_cost = self.best.cost

    def descend(self, starts: list[Array], start: Start) -> bool:
        """Descend from more starts; whether the cost fell by more than rounding."""
        improved = False
        with self.stages.of("descent"):
            for R in starts:
                end = descend(self.form, R, self.search.options.max_descent_iterations)
                if end.cost < self.best.cost - 0.01 * self.search.tolerance(end.cost):
                    improved = True
                    self.best, self.start, self.bound = end, start, NOTHING_YET
        return improved

    def certify(self, relaxation: Relaxation | None = None) -> bool:
        """Bound the optimum at the best point: KKT multipliers, then all constraints', then the relaxation's."""
        R, r = self.best.R, vec(self.best.R).ravel()
        with self.stages.of("dual certificate"):
            kkt = kkt_multipliers(R, self.form.apply(homogeneous(R))[:-1].reshape(-1, 9))
            self._add(Multipliers.KKT, kkt, r)
        if self.is_closed or self.search.is_large:
            return self.is_closed
        with self.stages.of("small dual"):
            multipliers, _ = small_dual.improve(self.form, R, kkt)
            self._add(Multipliers.ALL_CONSTRAINTS, multipliers, r)
        if self.is_closed or relaxation is None:
            return self.is_closed
        with self.stages.of("dual certificate"):
            polished = small_dual.stationary_multipliers(self.form, R, relaxation.multipliers)
            self._add(Multipliers.RELAXATION, polished, r)
            own = relaxation.X[:-1, -1] / relaxation.X[-1, -1]
            self._add(Multipliers.RELAXATION, relaxation.multipliers, own)
        return self.is_closed

    def look_elsewhere(self) -> bool:
        """Look for a lower critical point: along the negative curvature of Z, from Q' as a whole, at random."""
        starts = []
        if self.bound.direction is not None:
            direction = self.bound.direction * np.sqrt(3.0 * self.form.rotations)
            for step in (0.5, -0.5, 2.0, -2.0):
                starts.append(project(self.best.R + step * unvec(direction)))
        with self.stages.of("better starts"):
            starts += unconstrained_start(self.form) + self.search.random_starts(self.search.options.random_starts)
        return self.descend(starts, Start.BETTER)

    @property
    def is_closed(self) -> bool:
        """Whether the bound reaches the cost."""
        return self.best.cost - self.bound.lower_bound <= self.search.tolerance(self.best.cost)

    @property
    def is_closed_but_for_rounding(self) -> bool:
        """Whether Z is positive semidefinite up to rounding: no other point and no other multipliers do better."""
        return self.bound.semidefinite and self.best.cost - self.bound.value <= self.search.tolerance(self.best.cost)

    def after_relaxation(self, relaxation: Relaxation) -> Found:
        """Bound with the relaxation's multipliers too; where the gap stays open, compare with the relaxation's cost."""
        self.certify(relaxation)
        if self.best.cost - relaxation.dual > self.search.tolerance(self.best.cost):
            return self.found(Cause.NOT_TIGHT, relaxation_cost=relaxation.dual)
        return self.found(Cause.ROUNDING)

    def found(self, cause_of_gap: Cause = Cause.LOCAL_MINIMUM_POSSIBLE, **figures: float) -> Found:
        """The best point and its bound; ``cause_of_gap`` and its figures count where the gap is open."""
        exact, rounding = exact_value(self.form, homogeneous(self.best.R))
        cost = max(exact, 0.0)
        found = Found(
            R=self.best.R,
            cost=cost,
            bound=replace(self.bound, lower_bound=min(self.bound.lower_bound, exact + rounding, cost)),
            tolerance=self.search.tolerance(cost),
            path=SearchPath(self.start, self.multipliers),
            cause=cause_of_gap,
            figures=figures,
        )
        if found.is_closed:
            return replace(found, cause=self._cause_of_proof(), figures={})
        if self.is_closed_but_for_rounding:
            return replace(found, cause=Cause.ROUNDING, figures={})
        return found

    def _cause_of_proof(self) -> Cause:
        if self.first_cost - self.best.cost > self.search.tolerance(self.first_cost):
            return Cause.PROVEN_AFTER_LOCAL_MINIMUM
        return Cause.PROVEN if self.multipliers is Multipliers.KKT else Cause.PROVEN_WITH_REDUNDANT_CONSTRAINTS

    def _add(self, kind: Multipliers, multipliers: Array, r: Array) -> None:
        """Keep the bound that multipliers give at a point, if this bound is the best."""
        bound = lower_bound(self.form, multipliers, r)
        if self.bound is NOTHING_YET or bound.lower_bound > self.bound.lower_bound:
            if bound.direction is None and not bound.semidefinite:
                bound = replace(bound, direction=self.bound.direction)
            self.bound, self.multipliers = bound, kind
