"""One search on its way: descents from several starts, and bounds at the best point so far."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver import small_dual
from gtsam_rwhec.solver.bound import Bound, exact_value, lower_bound
from gtsam_rwhec.solver.cause import Cause, Multipliers, SearchPath, Start
from gtsam_rwhec.solver.descent import Descent, descend, homogeneous
from gtsam_rwhec.solver.found import Found
from gtsam_rwhec.solver.interior_point import Relaxation
from gtsam_rwhec.solver.options import SolveOptions
from gtsam_rwhec.solver.reduced_form import ReducedForm
from gtsam_rwhec.solver.rotations import kkt_multipliers, project, random_rotations, unvec, vec
from gtsam_rwhec.solver.stages import Stages
from gtsam_rwhec.solver.start import unconstrained_start

#: Before a bound was asked for.
NOTHING_YET = Bound(-np.inf, -np.inf, definite=False, semidefinite=False, eigenvalue=-np.inf, direction=None)


class Attempt:
    """The best point that descents have reached, from which start, and the best bound there.

    Parameters
    ----------
    form : ReducedForm
    tolerance : callable
        The absolute gap that counts as none at a cost.
    options : SolveOptions
    stages : Stages
    starts : list of (n, 3, 3) array
        The first ones.
    start : Start
        What those are.
    """

    def __init__(
        self,
        form: ReducedForm,
        tolerance: Callable[[float], float],
        options: SolveOptions,
        stages: Stages,
        starts: list[Array],
        start: Start,
    ) -> None:
        self.form, self.tolerance, self.options, self.stages = form, tolerance, options, stages
        self.best = Descent(starts[0], np.inf, np.inf, 0, converged=False)
        self.start, self.multipliers, self.bound = start, Multipliers.KKT, NOTHING_YET
        self.descend(starts, start)
        self.first_cost = self.best.cost

    def descend(self, starts: list[Array], start: Start) -> bool:
        """Descend from more starts; whether that beat the best so far by more than rounding."""
        improved = False
        with self.stages.of("descent"):
            for R in starts:
                end = descend(self.form, R, self.options.max_descent_iterations)
                if end.cost < self.best.cost - 0.01 * self.tolerance(end.cost):
                    improved = True
                    self.best, self.start, self.bound = end, start, NOTHING_YET
        return improved

    def certify(self, relaxation: Relaxation | None = None) -> bool:
        """Bound the optimum at the best point: KKT multipliers, then all constraints', then the relaxation's."""
        R, r = self.best.R, vec(self.best.R).ravel()
        with self.stages.of("dual certificate"):
            kkt = kkt_multipliers(R, self.form.apply(homogeneous(R))[:-1].reshape(-1, 9))
            self._add(Multipliers.KKT, kkt, r)
        if self.is_closed or self.is_large:
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
            starts += unconstrained_start(self.form)
            generator = np.random.default_rng(self.options.seed)
            starts += [random_rotations(self.form.rotations, generator) for _ in range(self.options.random_starts)]
        return self.descend(starts, Start.BETTER)

    @property
    def is_large(self) -> bool:
        """Whether the dense methods, small dual and relaxation, are not tried."""
        return self.form.rotations > self.options.max_dense_frames

    @property
    def is_closed(self) -> bool:
        """Whether the bound reaches the cost."""
        return self.best.cost - self.bound.lower_bound <= self.tolerance(self.best.cost)

    @property
    def is_closed_but_for_rounding(self) -> bool:
        """Whether Z is positive semidefinite as far as can be told, and no other point or multiplier can do better."""
        return self.bound.semidefinite and self.best.cost - self.bound.value <= self.tolerance(self.best.cost)

    def found(self, cause_of_gap: Cause = Cause.LOCAL_MINIMUM_POSSIBLE, **figures: float) -> Found:
        """What the attempt comes to; ``cause_of_gap``, with its figures, is told where the gap is open."""
        exact, rounding = exact_value(self.form, homogeneous(self.best.R))
        cost = max(exact, 0.0)
        found = Found(
            R=self.best.R,
            cost=cost,
            lower_bound=min(self.bound.lower_bound, exact + rounding, cost),
            float_bound=self.bound.value,
            is_definite=self.bound.definite,
            eigenvalue=self.bound.eigenvalue,
            tolerance=self.tolerance(cost),
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
        if self.first_cost - self.best.cost > self.tolerance(self.first_cost):
            return Cause.PROVEN_AFTER_LOCAL_MINIMUM
        needed = self.multipliers is not Multipliers.KKT
        return Cause.PROVEN_WITH_REDUNDANT_CONSTRAINTS if needed else Cause.PROVEN

    def _add(self, kind: Multipliers, multipliers: Array, r: Array) -> None:
        """Keep the bound that multipliers give at a point, if it is the best."""
        bound = lower_bound(self.form, multipliers, r)
        if self.bound is NOTHING_YET or bound.lower_bound > self.bound.lower_bound:
            if bound.direction is None and not bound.semidefinite:
                bound = replace(bound, direction=self.bound.direction)
            self.bound, self.multipliers = bound, kind
