"""The search for a certified answer of one part: starts, descent, dual, small dual, better starts, relaxation."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from gtsam_rwhec.files.progress import Progress
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver import small_dual
from gtsam_rwhec.solver.bound import Bound, exact_value, lower_bound
from gtsam_rwhec.solver.descent import Descent, descend, homogeneous
from gtsam_rwhec.solver.full_form import FullForm, add_priors, assemble, edge_slots, forms_of_edges
from gtsam_rwhec.solver.interior_point import Relaxation
from gtsam_rwhec.solver.mirror import mirrored
from gtsam_rwhec.solver.options import Method, SolveOptions
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.reduced_form import ReducedForm, reduce
from gtsam_rwhec.solver.relaxation import round_to_rotations, solve_relaxation
from gtsam_rwhec.solver.rotations import kkt_multipliers, project, random_rotations, unvec, vec
from gtsam_rwhec.solver.start import spectral_start, unconstrained_start
from gtsam_rwhec.solver.variables import answer_of

#: A mirror image may cost this much more, relatively, and still be what the data mean; more is another answer.
MIRROR_COST = 0.01
#: Entries of rotations that differ by this much are another answer.
TWIN_DISTANCE = 1e-3


@dataclass(frozen=True)
class Forms:
    """A part's forms: full, with and without its translation residuals, reduced; and the edges' own."""

    full: FullForm
    rotation: FullForm
    reduced: ReducedForm
    edges_translation: Array
    edges_rotation: Array
    substitution: Array

    @staticmethod
    def of(part: Part) -> Forms:
        """Build them from the part's moments."""
        slots = edge_slots(part)
        translation, rotation = forms_of_edges(part)
        full = assemble(part, slots, translation + rotation)
        rotation_form = assemble(part, slots, rotation)
        add_priors(full, part)
        add_priors(rotation_form, part)
        return Forms(full, rotation_form, reduce(full), translation, rotation, slots.substitution)


@dataclass(frozen=True)
class Found:
    """The best rotations of a part and the best bound on what any answer costs."""

    R: Array
    cost: float
    lower: float
    value: float
    definite: bool
    eigenvalue: float
    converged: bool
    path: str
    reason: str


def _has_positive_scales(part: Part, form: ReducedForm, R: Array) -> bool:
    answer = answer_of(part, form, R)
    own = answer.own_scale[np.isfinite(answer.own_scale)]
    return answer.scale > 0.0 and bool((own > 0.0).all())


@dataclass
class Search:
    """One part's search. ``run`` does it; ``seconds`` holds the stages' times."""

    part: Part
    options: SolveOptions
    progress: Progress | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage and tell the progress display."""
        if self.progress is not None:
            self.progress(name)
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

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
        with self.stage("quadratic form"):
            self.forms = Forms.of(self.part)
            self.form = self.forms.reduced
        self.best: Descent | None = None
        self.bound: Bound | None = None
        self.path = ""
        if method == "sdp":
            relaxation = self._relax()
            label = f"relaxation ({relaxation.solver})"
            self._descend(round_to_rotations(relaxation), label)
            self._certify(label, relaxation)
            return self._found("")
        if initial is not None:
            self._descend([initial], "given start")
            label = "given start"
        else:
            with self.stage("spectral start"):
                starts = spectral_start(self.part, self.forms.rotation)
            self._descend(starts, "spectral start")
            label = "spectral start"
        if self._certify(label) or method == "local" or self._is_closed_but_for_rounding():
            return self._found("")
        if self._better_starts() and self._certify("better start"):
            return self._found("the first start led to a local minimum")
        if self.form.rotations > self.options.max_dense_frames:
            return self._found(
                f"the relaxation of {self.form.rotations} frames was not tried (SolveOptions.max_dense_frames = "
                f"{self.options.max_dense_frames})"
            )
        relaxation = self._relax()
        before = self._cost
        self._descend(round_to_rotations(relaxation), "relaxation")
        if self._certify("relaxation", relaxation):
            if self._cost < before - self.tolerance(before):
                return self._found("the first starts led to local minima; the relaxation to the optimum")
            return self._found("")
        gap = self._cost - relaxation.dual
        return self._found(
            f"the relaxation is not tight: its own optimum is {relaxation.dual:.8g}, {gap:.3g} below the best answer"
        )

    def with_positive_scale(self, found: Found) -> Found:
        """The answer as found, or its mirror image where only that has positive scales and it costs as little.

        Planar motion leaves the sign of a scale open (``mirror``). With noise in A the two costs differ a
        little, and the image may cost more than the bound allows: then it is returned with that gap.
        """
        if _has_positive_scales(self.part, self.form, found.R):
            return found
        with self.stage("descent"):
            end = descend(self.form, mirrored(self.part, found.R), self.options.max_descent_iterations)
        likely = end.cost - found.cost <= max(self.tolerance(found.cost), MIRROR_COST * found.cost)
        if not (likely and _has_positive_scales(self.part, self.form, end.R)):
            return found
        cost, _ = exact_value(self.form, homogeneous(end.R))
        reason = found.reason
        if cost - found.lower > self.tolerance(cost):
            reason = (
                f"its mirror image, with a negative scale, costs {found.cost:.8g}, less than this answer's {cost:.8g}: "
                "planar motion leaves the sign of the scale to the noise"
            )
        path = f"{found.path}, mirrored"
        return replace(found, R=end.R, cost=cost, lower=min(found.lower, cost), reason=reason, path=path)

    def has_twin(self, found: Found) -> bool:
        """Whether descents from elsewhere find another answer of the same cost.

        Information is about the answer's neighbourhood; twins far away show in a Z that is not definite, which is
        when this is asked.
        """
        if self.form.rotations > self.options.max_dense_frames:
            return False
        generator = np.random.default_rng(self.options.seed)
        with self.stage("twins"):
            for _ in range(2 * self.options.random_starts):
                start = random_rotations(self.form.rotations, generator)
                end = descend(self.form, start, self.options.max_descent_iterations)
                elsewhere = float(np.abs(end.R - found.R).max(initial=0.0)) > TWIN_DISTANCE
                if elsewhere and end.cost <= found.cost + self.tolerance(found.cost):
                    return _has_positive_scales(self.part, self.form, end.R)
        return False

    @property
    def _cost(self) -> float:
        assert self.best is not None
        return self.best.cost

    def _descend(self, starts: list[Array], label: str) -> bool:
        """Descend from each start; whether that beat the best so far by more than rounding."""
        improved = False
        with self.stage("descent"):
            for start in starts:
                end = descend(self.form, start, self.options.max_descent_iterations)
                margin = 0.01 * self.tolerance(end.cost)
                if self.best is None or end.cost < self.best.cost - margin:
                    improved = self.best is not None
                    self.best, self.bound, self.path = end, None, label
        return improved

    def _certify(self, label: str, relaxation: Relaxation | None = None) -> bool:
        """Bound the optimum at the best point: KKT multipliers, then all constraints', then the relaxation's."""
        assert self.best is not None
        R, r = self.best.R, vec(self.best.R).ravel()
        with self.stage("dual certificate"):
            kkt = kkt_multipliers(R, self.form.apply(homogeneous(R))[:-1].reshape(-1, 9))
            self._take(lower_bound(self.form, kkt, r), f"{label}, dual")
        if self._is_closed() or self.form.rotations > self.options.max_dense_frames:
            return self._is_closed()
        with self.stage("small dual"):
            multipliers, _ = small_dual.improve(self.form, R, kkt)
            self._take(lower_bound(self.form, multipliers, r), f"{label}, small dual")
        if self._is_closed() or relaxation is None:
            return self._is_closed()
        with self.stage("dual certificate"):
            polished = small_dual.stationary_multipliers(self.form, R, relaxation.multipliers)
            self._take(lower_bound(self.form, polished, r), f"{label}, relaxation's multipliers")
            self._take(
                lower_bound(self.form, relaxation.multipliers, relaxation.X[:-1, -1] / relaxation.X[-1, -1]),
                f"{label}, relaxation's multipliers",
            )
        return self._is_closed()

    def _take(self, bound: Bound, path: str) -> None:
        if self.bound is None or bound.lower > self.bound.lower:
            if self.bound is not None and bound.direction is None:
                bound = Bound(
                    bound.lower,
                    bound.value,
                    bound.definite,
                    bound.semidefinite,
                    bound.eigenvalue,
                    None if bound.semidefinite else self.bound.direction,
                )
            self.bound, self.path = bound, path

    def _is_closed(self) -> bool:
        return self.bound is not None and self._cost - self.bound.lower <= self.tolerance(self._cost)

    def _is_closed_but_for_rounding(self) -> bool:
        """Whether Z is positive semidefinite as far as can be told, and no other point or multiplier can do better."""
        assert self.bound is not None
        return self.bound.semidefinite and self._cost - self.bound.value <= self.tolerance(self._cost)

    def _better_starts(self) -> bool:
        """Look for a lower critical point: along the negative curvature of Z, from Q' as a whole, at random."""
        assert self.best is not None
        assert self.bound is not None
        starts = []
        if self.bound.direction is not None:
            direction = self.bound.direction * np.sqrt(3.0 * self.form.rotations)
            for step in (0.5, -0.5, 2.0, -2.0):
                starts.append(project(self.best.R + step * unvec(direction)))
        with self.stage("better starts"):
            starts += unconstrained_start(self.form)
            generator = np.random.default_rng(self.options.seed)
            starts += [random_rotations(self.form.rotations, generator) for _ in range(self.options.random_starts)]
        return self._descend(starts, "better start")

    def _relax(self) -> Relaxation:
        with self.stage("semidefinite relaxation"):
            return solve_relaxation(
                self.form.dense(),
                self.options.relaxation_tolerance,
                self.options.max_relaxation_iterations,
                progress=self.progress,
            )

    def _found(self, reason: str) -> Found:
        assert self.best is not None
        assert self.bound is not None
        closed = self._is_closed()
        if not closed and self._is_closed_but_for_rounding():
            reason = (
                "without the allowance for rounding the bound reaches the cost; answers that are as good (free "
                "directions, a mirror image) leave the verified test no room"
            )
        elif not closed and not reason:
            reason = (
                "the point may be a local minimum, or redundant constraints' multipliers are needed; "
                "method='auto' looks further"
            )
        if closed:
            needed = "the multipliers of redundant constraints were needed" if "small" in self.path else ""
            reason = "; ".join(filter(None, ["proven globally optimal", reason, needed]))
        cost, rounding = exact_value(self.form, homogeneous(self.best.R))
        lower = min(self.bound.lower, cost + rounding)
        return Found(
            self.best.R,
            max(cost, 0.0),
            min(lower, max(cost, 0.0)),
            self.bound.value,
            self.bound.definite,
            self.bound.eigenvalue,
            self.best.converged,
            self.path,
            reason,
        )
