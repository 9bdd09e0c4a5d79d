"""The search for a certified answer of one part: starts, descent, dual, small dual, better starts, relaxation."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
from rwhec_factors.se3 import pose, so3_nearest

from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.answers import Answer, Evaluation, answer_of
from gtsam_rwhec.solver.bound import Bound, lower_bound
from gtsam_rwhec.solver.certificate import Cause, Multipliers, SearchPath, Start
from gtsam_rwhec.solver.descent import Descent, SearchForm, descend, mirrored, spectral_start, unconstrained_start
from gtsam_rwhec.solver.elimination import Elimination
from gtsam_rwhec.solver.local_dual import LocalDual, improve_locally, relax_locally
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.relaxation import Relaxation, round_to_rotations, solve_relaxation
from gtsam_rwhec.solver.rotations import kkt_multipliers, random_rotations, unvec
from gtsam_rwhec.solver.small_dual import improve, stationary_multipliers
from gtsam_rwhec.solver.solve_options import Method, SolveOptions


@dataclass(frozen=True)
class Stages:
    """``with stages.of(name): ...`` calls ``progress`` with the name and adds the time to ``seconds``."""

    progress: Progress | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def of(self, name: str) -> Iterator[None]:
        """Report that a stage begins, and add its time."""
        if self.progress is not None:
            self.progress(name)
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


#: With unit weights and exact data, a cost below this fraction of the form's magnitude is rounding of the measurements.
OF_MEASUREMENTS = 1e-30
#: The same fraction of the terms that a far origin adds: poses about it are rounded to 1.1e-16 of their distance.
OF_ORIGIN = 1e-31
#: The same where only moments are known, whose sums are rounded.
OF_MOMENTS = 1e-13


@dataclass(frozen=True)
class Found:
    """The best answer of a part and the best bound on the cost of any answer."""

    answer: Answer  #: about the part's gauge
    R: Array  #: (n, 3, 3), its rotations in the order of ``part.free``, as the form has them
    cost: float  #: J at the answer, rounded up
    bound: Bound  #: its ``lower_bound`` is at most the exact cost of the answer
    tolerance: float  #: the absolute gap up to which the answer counts as proven optimal
    is_known: bool  #: whether the moments, where measurements were not kept, tell the cost
    path: SearchPath
    cause: Cause
    figures: dict[str, float] = field(default_factory=dict)  #: numbers in the cause's sentence, by name

    @property
    def is_closed(self) -> bool:
        """Whether the gap is within the tolerance: the answer is proven optimal."""
        return self.cost - self.bound.lower_bound <= self.tolerance and self.is_known


@dataclass(frozen=True)
class Search:
    """The search of one part: its cost, and the times of the stages.

    If the bound holds only in a region, this region contains the answer ``contains``, if one is given.
    """

    part: Part
    options: SolveOptions
    stages: Stages
    whole: PartForm
    contains: Answer | None = None

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
                starts = spectral_start(self.part, self.whole.rotation)
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
        if found.answer.has_positive_scales or len(found.R) == 0:  # fixed frames have no mirror image
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
        """The result. The forms are dropped where no further search follows: in large parts no twin is searched."""
        keeps = found.is_closed and not found.bound.definite and not self.is_large
        return Searched(self.part, found, self.whole.full.order, self.stages, self if keeps else None)

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
        limits = self.options.relaxation_tolerance, self.options.max_relaxation_iterations
        with self.stages.of("semidefinite relaxation"):
            return solve_relaxation(self.whole.reduced.Q, *limits, self.stages.progress)

    @property
    def form(self) -> SearchForm:
        """Q'."""
        return self.whole.form

    @property
    def is_large(self) -> bool:
        """Whether small dual and relaxation are too large for all frames at once; then they take a few frames."""
        return self.form.rotations > self.options.max_dense_frames

    def tolerance(self, cost: float) -> float:
        """The absolute gap that counts as zero (design fact 10).

        With unit weights a cost of 1 has no meaning, and with exact data the cost is zero but for the rounding of the
        measurements and of the answer, which grows with the distance of the world's origin. From moments alone, the
        cost is known only up to the rounding of the form's entries.
        """
        if not self.part.is_relative:
            return self.options.relative_tolerance * max(cost, 1.0)
        zero = OF_MOMENTS if self.part.given is None else OF_MEASUREMENTS
        # At rest a motion's equation cancels in the form, and its terms are of the size of kappa.
        magnitude = max(self.form.magnitude, float(self.part.moments.kappa.sum()))
        # The term that the gauge removed, sum (|a|^2 + |c|^2) / sigma^2: poses are rounded relative to its size.
        gauge = self.part.gauge
        squares = float((gauge.sensor_carrier**2).sum() + (gauge.target_carrier**2).sum())
        of_origin = float(self.part.moments.weight.sum()) * squares
        floor = zero * self.form.size * magnitude + OF_ORIGIN * of_origin + 1e-250
        return max(self.options.relative_tolerance * cost, floor)

    @property
    def rounding(self) -> float:
        """The largest change of x'Q'x by rounding: smaller differences between descents mean nothing."""
        return 1e-15 * self.form.size * self.form.magnitude + 1e-250

    def random_starts(self, count: int) -> list[Array]:
        """Random rotations (n, 3, 3); the same ones in each call."""
        generator = np.random.default_rng(self.options.seed)
        return [random_rotations(self.form.rotations, generator) for _ in range(count)]


#: A search has this bound before it has tried any multipliers.
NOTHING_YET = Bound()
#: A region may lower the bound by this fraction of the tolerance: this does not matter.
REGION_SHARE = 1e-4
#: Moments whose rounding may change the cost by more than this part of it prove nothing.
KNOWN = 1e-3
#: At most this many local relaxations of a large part: each one starts from a lower answer than the one before.
LOCAL_RELAXATIONS = 10
#: Directions that only the noise of measured rotations determines are known from the raw measurements alone. The answer
#: takes at most this many steps along them.
STEPS_ALONG_FREE_DIRECTIONS = 3


class Attempt:
    """The best point that the descents of a search have reached, its start, and the best bound at this point."""

    def __init__(self, search: Search, starts: list[Array], start: Start) -> None:
        self.search, self.form, self.stages = search, search.form, search.stages
        self.best = Descent(starts[0], np.inf, 0, converged=False)
        self.start, self.multipliers, self.bound = start, Multipliers.KKT, NOTHING_YET
        self._reached: tuple[Answer, Evaluation] | None = None
        self._local: LocalDual | None = None  # at the best point, of a large part
        self.descend(starts, start)
        self.first_cost = self.best.cost

    def descend(self, starts: list[Array], start: Start) -> bool:
        """Descend from more starts; whether the cost fell by more than rounding."""
        improved = False
        with self.stages.of("descent"):
            for R in starts:
                end = descend(self.form, R, self.search.options.max_descent_iterations)
                if end.cost < self.best.cost - max(0.01 * self.search.tolerance(end.cost), self.search.rounding):
                    improved = True
                    self.best, self.start, self.bound = end, start, NOTHING_YET
                    self._reached = self._local = None
        return improved

    @property
    def reached(self) -> tuple[Answer, Evaluation]:
        """The answer at the best point, and its cost by the raw measurements."""
        if self._reached is None:
            with self.stages.of("cost of the measurements"):
                self._reached = self.search.whole.answer_near(self.best.R)
        return self._reached

    @property
    def cost(self) -> float:
        """The cost of the answer at the best point, rounded up."""
        return self.reached[1].upper

    @property
    def lowest(self) -> float:
        """A lower bound on the exact cost of the answer at the best point."""
        evaluation = self.reached[1]
        return float(np.nextafter(evaluation.cost - evaluation.cost_error * (1.0 + 1e-9), -np.inf))

    def certify(self, relaxation: Relaxation | None = None) -> bool:
        """Bound the optimum at the best point: KKT multipliers, then all constraints', then the relaxation's."""
        if self.certify_by_kkt():
            return True
        evaluation, kkt = self.reached[1], self._kkt()
        with self.stages.of("small dual"):
            if self.search.is_large:
                self._local = improve_locally(self.search.whole, evaluation, kkt, self.search.options.max_dense_frames)
                multipliers, is_better = self._local.multipliers, self._local.t > 0.0
            else:
                (multipliers, _), is_better = (
                    improve(self.search.whole.reduced.Q, evaluation.point.rotations, kkt),
                    True,
                )
            if is_better:
                self._add(Multipliers.ALL_CONSTRAINTS, multipliers)
        if relaxation is not None and not self.is_closed:
            self._add_of_relaxation(relaxation.multipliers)
        return self.is_closed

    def certify_by_kkt(self) -> bool:
        """Bound the optimum at the best point by the multipliers of R'R = I, unless that was done before."""
        if self.bound is not NOTHING_YET:
            return self.is_closed
        with self.stages.of("dual certificate"):
            self._add(Multipliers.KKT, self._kkt())
            for _ in range(STEPS_ALONG_FREE_DIRECTIONS):
                if self.bound.step is None:
                    break
                answer, evaluation = self.search.whole.moved(self.reached[1], self.bound.step)
                if not (evaluation.cost < self.reached[1].cost and answer.has_positive_scales):
                    break
                self._reached, self.bound = (answer, evaluation), NOTHING_YET
                self._add(Multipliers.KKT, self._kkt())
        return self.is_closed

    def run_locally(self) -> Found:
        """The search of a large part: the dense methods are used for a few frames, with all others eliminated."""
        search = self.search
        limit = search.options.max_dense_frames
        if self.certify_by_kkt() or self.is_closed_but_for_rounding:
            return self.found()
        self.look_elsewhere()
        for _ in range(LOCAL_RELAXATIONS):
            if self.certify() or self.is_closed_but_for_rounding:
                return self.found()
            local, evaluation = self._local, self.reached[1]
            if local is None or local.form is None:
                break
            with self.stages.of("semidefinite relaxation"):
                relaxation = relax_locally(evaluation, self._kkt(), local.form, search.options, self.stages.progress)
            if self.descend(relaxation.starts, Start.LOCAL_RELAXATION):
                continue
            if self.descend(search.random_starts(search.options.random_starts), Start.BETTER):
                continue
            self._add_of_relaxation(relaxation.multipliers)
            if abs(self.cost - relaxation.dual) <= search.tolerance(self.cost):
                return self.found(Cause.ROUNDING)
            if local.needed > limit:
                break
            # A solver with large rounding errors may report more than is possible: then the proven bound counts.
            proven = self.bound.at_most(self.lowest).lower_bound
            bound = max(relaxation.dual, proven) if relaxation.dual < self.cost else proven
            return self.found(
                Cause.PART_NOT_TIGHT,
                relaxed=len(local.form.frames),
                relaxation_cost=bound,
                frames=self.form.rotations,
                max_dense_frames=limit,
            )
        needed = self.form.rotations if self._local is None else max(self._local.needed, limit + 1)
        return self.found(Cause.TOO_LARGE, frames=needed, max_dense_frames=limit)

    def _add_of_relaxation(self, multipliers: Array) -> None:
        """Add the bounds from a relaxation's multipliers (n, 20), and from the nearest ones with a zero gradient."""
        evaluation = self.reached[1]
        stationary = stationary_multipliers(_by_rotations(evaluation), evaluation.point.rotations, multipliers)
        with self.stages.of("dual certificate"):
            self._add(Multipliers.RELAXATION, stationary)
            self._add(Multipliers.RELAXATION, multipliers)

    def _kkt(self) -> Array:
        """The multipliers (n, 20) of R'R = I, at the answer reached."""
        return kkt_multipliers(self.reached[1].point.rotations, _by_rotations(self.reached[1]))

    def look_elsewhere(self) -> bool:
        """Search for a lower critical point: along the negative curvature of Z, from eigenvectors of Q', at random.

        A large part starts at random last, after its local relaxation: these starts take longest and lead nowhere.
        """
        starts = []
        if self.bound.direction is not None:
            direction = self.bound.direction * np.sqrt(3.0 * self.form.rotations)
            for step in (0.5, -0.5, 2.0, -2.0):
                starts.append(so3_nearest(self.best.R + step * unvec(direction)))
        with self.stages.of("better starts"):
            starts += unconstrained_start(self.form)
            if not self.search.is_large:
                starts += self.search.random_starts(self.search.options.random_starts)
        return self.descend(starts, Start.BETTER)

    @property
    def is_closed(self) -> bool:
        """Whether the bound reaches the cost."""
        return self.is_known and self.cost - self.bound.lower_bound <= self.search.tolerance(self.cost)

    @property
    def is_known(self) -> bool:
        """Where the cost comes from moments only: whether at least three of its digits are correct."""
        return self.search.part.is_relative or self.reached[1].unknown <= KNOWN * max(self.cost, 1.0)

    @property
    def is_closed_but_for_rounding(self) -> bool:
        """Whether Z is positive semidefinite up to rounding: no other point and no other multipliers do better."""
        return self.bound.semidefinite and self.cost - self.bound.value <= self.search.tolerance(self.cost)

    def after_relaxation(self, relaxation: Relaxation) -> Found:
        """Bound with the relaxation's multipliers too; where the gap stays open, compare with the relaxation's cost."""
        self.certify(relaxation)
        if self.cost - relaxation.dual > self.search.tolerance(self.cost):
            return self.found(Cause.NOT_TIGHT, relaxation_cost=relaxation.dual)
        return self.found(Cause.ROUNDING)

    def found(self, cause_of_gap: Cause = Cause.LOCAL_MINIMUM_POSSIBLE, **figures: float) -> Found:
        """The best point and its bound; ``cause_of_gap`` and its figures count where the gap is open."""
        answer, evaluation = self.reached
        found = Found(
            answer=answer,
            R=evaluation.point.rotations,
            cost=self.cost,
            bound=self.bound.at_most(self.lowest),
            tolerance=self.search.tolerance(self.cost),
            is_known=self.is_known,
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
        lowered = self.first_cost - self.best.cost
        if lowered > max(self.search.tolerance(self.first_cost), self.search.rounding):
            return Cause.PROVEN_AFTER_LOCAL_MINIMUM
        return Cause.PROVEN if self.multipliers is Multipliers.KKT else Cause.PROVEN_WITH_REDUNDANT_CONSTRAINTS

    def _add(self, kind: Multipliers, multipliers: Array) -> None:
        """Keep the bound that multipliers give at the best point, if this bound is the best."""
        search, evaluation = self.search, self.reached[1]
        enough = REGION_SHARE * search.tolerance(self.cost)
        bound = lower_bound(search.whole, evaluation, multipliers, enough=enough, contains=search.contains)
        if self.bound is NOTHING_YET or bound.lower_bound > self.bound.lower_bound:
            if bound.direction is None and not bound.semidefinite:
                bound = replace(bound, direction=self.bound.direction)
            self.bound, self.multipliers = bound, kind


def _by_rotations(evaluation: Evaluation) -> Array:
    """Half the gradient by the entries of the rotations, (n, 9)."""
    return evaluation.gradient[:-1].reshape(-1, 13)[:, 4:]


#: A mirror image whose cost is higher by up to this fraction may still be the true answer. Above, it is another answer.
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
    def poses(self) -> dict[str, Array]:
        """The free frames' poses (4, 4) about the user's origin."""
        answer, shift = self.found.answer, self.part.frame_shift
        return {n: pose(R, t + shift(n)) for n, R, t in zip(self.part.free, answer.R, answer.t, strict=True)}

    @property
    def has_twin(self) -> bool:
        """Whether another answer costs the same."""
        return self.search is not None and self.search.has_twin(self.found)
