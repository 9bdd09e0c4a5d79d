"""The best point that a search has reached: its descents, its bounds, and the search of a part with many frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver import small_dual
from gtsam_rwhec.solver.bound import Bound, lower_bound
from gtsam_rwhec.solver.cause import Cause, Multipliers, SearchPath, Start
from gtsam_rwhec.solver.descent import Descent, descend
from gtsam_rwhec.solver.interior_point import Relaxation
from gtsam_rwhec.solver.local_dual import LocalDual, improve_locally
from gtsam_rwhec.solver.local_relaxation import relax_locally
from gtsam_rwhec.solver.point import Evaluation
from gtsam_rwhec.solver.rotations import kkt_multipliers, project, unvec
from gtsam_rwhec.solver.searched_part import Found, SearchedPart
from gtsam_rwhec.solver.start import unconstrained_start
from gtsam_rwhec.solver.variables import Answer

#: A search has this bound before it has tried any multipliers.
NOTHING_YET = Bound()
#: What a region costs the bound matters from this part of the tolerance on.
REGION_SHARE = 1e-4
#: Moments whose rounding may change the cost by more than this part of it prove nothing.
KNOWN = 1e-3
#: A large part's local relaxations are as many at most: each has a lower answer than the one before.
LOCAL_RELAXATIONS = 10
#: Directions that only the noise of measured rotations determines are known from the raw measurements alone. The answer
#: takes at most so many steps along them.
STEPS_ALONG_FREE_DIRECTIONS = 3


class Attempt:
    """The best point that the descents of a search have reached, its start, and the best bound at this point."""

    def __init__(self, search: SearchedPart, starts: list[Array], start: Start) -> None:
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
        """What the exact cost of the answer at the best point is at least."""
        evaluation = self.reached[1]
        return float(np.nextafter(evaluation.cost - evaluation.cost_error * (1.0 + 1e-9), -np.inf))

    def certify(self, relaxation: Relaxation | None = None) -> bool:
        """Bound the optimum at the best point: KKT multipliers, then all constraints', then the relaxation's."""
        if self.certify_by_kkt():
            return True
        evaluation = self.reached[1]
        R, gradient = evaluation.point.rotations, _by_rotations(evaluation)
        kkt = kkt_multipliers(R, gradient)
        with self.stages.of("small dual"):
            if self.search.is_large:
                self._local = improve_locally(self.search.whole, evaluation, kkt, self.search.options.max_dense_frames)
                multipliers, is_better = self._local.multipliers, self._local.t > 0.0
            else:
                (multipliers, _), is_better = small_dual.improve(self.search.whole.reduced, R, kkt), True
            if is_better:
                self._add(Multipliers.ALL_CONSTRAINTS, multipliers)
        if self.is_closed or relaxation is None:
            return self.is_closed
        self._add_of_relaxation(relaxation.multipliers)
        return self.is_closed

    def certify_by_kkt(self) -> bool:
        """Bound the optimum at the best point by the multipliers of R'R = I, unless that was done before."""
        if self.bound is not NOTHING_YET:
            return self.is_closed
        with self.stages.of("dual certificate"):
            self._add_kkt()
            for _ in range(STEPS_ALONG_FREE_DIRECTIONS):
                if self.bound.step is None:
                    break
                answer, evaluation = self.search.whole.moved(self.reached[1], self.bound.step)
                if not (evaluation.cost < self.reached[1].cost and answer.has_positive_scales):
                    break
                self._reached, self.bound = (answer, evaluation), NOTHING_YET
                self._add_kkt()
        return self.is_closed

    def run_locally(self) -> Found:
        """The search of a large part: the dense methods have a few frames, with all others eliminated."""
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
            kkt = kkt_multipliers(evaluation.point.rotations, _by_rotations(evaluation))
            with self.stages.of("semidefinite relaxation"):
                relaxation = relax_locally(evaluation, kkt, local.form, search.options, self.stages.progress)
            if self.descend(relaxation.starts, Start.LOCAL_RELAXATION):
                continue
            if self.descend(search.random_starts(search.options.random_starts), Start.BETTER):
                continue
            self._add_of_relaxation(relaxation.multipliers)
            if abs(self.cost - relaxation.dual) <= search.tolerance(self.cost):
                return self.found(Cause.ROUNDING)
            if local.needed > limit:
                break
            # A solver that lost its digits may say more than there is: then what is proven counts.
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
        """Add the bounds from a relaxation's multipliers (n, 20): the nearest that fit the point, and they."""
        evaluation = self.reached[1]
        R, gradient = evaluation.point.rotations, _by_rotations(evaluation)
        with self.stages.of("dual certificate"):
            self._add(Multipliers.RELAXATION, small_dual.stationary_multipliers(gradient, R, multipliers))
            self._add(Multipliers.RELAXATION, multipliers)

    def _add_kkt(self) -> None:
        """Add the bound from the multipliers of R'R = I, at the answer reached."""
        evaluation = self.reached[1]
        self._add(Multipliers.KKT, kkt_multipliers(evaluation.point.rotations, _by_rotations(evaluation)))

    def look_elsewhere(self) -> bool:
        """Look for a lower critical point: along the negative curvature of Z, from Q' as a whole, at random.

        A large part starts at random last, after its local relaxation: these starts take longest and lead nowhere.
        """
        starts = []
        if self.bound.direction is not None:
            direction = self.bound.direction * np.sqrt(3.0 * self.form.rotations)
            for step in (0.5, -0.5, 2.0, -2.0):
                starts.append(project(self.best.R + step * unvec(direction)))
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
        """Whether rounding leaves three digits of the cost, where only moments tell it."""
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
