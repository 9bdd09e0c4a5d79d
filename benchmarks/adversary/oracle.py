"""Whether a certificate tells the truth: against the exact cost of its own answer, and of every better answer found.

What is claimed: the certificate's cost is at least the exact cost of the poses that it is about, and its lower bound at
most the exact cost of any answer, of the measurements as they were given. By any amount: each comparison that an
enclosure does not decide is decided in fractions.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
from exact_cost import RationalPoses, exact_cost
from global_search import minima, weighted_matrix
from pair_descent import Answers, PairDescent, Region
from seeded_case import Case
from stated_cost import Enclosure, Poses, Rows, StatedCost

import gtsam_rwhec as rw

#: Random starts of the search beside the returned answer and its images.
STARTS = 20
#: So many Newton steps end at a minimum to the last digit, from an answer that is optimal to rounding.
STEPS = 12
#: Answers that cost more than the bound by more than this share of max(bound, 1) are not refined.
NEAR = 1e-3
#: What the moments' rounding may do to a claim about moments, relative to the sums of squares.
MOMENTS = 1e-9


@dataclass(frozen=True)
class Violation:
    """One claim that is false, by how much; relative to max(cost, 1)."""

    kind: str
    amount: float
    relative: float
    said: float
    true: float

    def __str__(self) -> str:
        return f"{self.kind}: {self.said!r} said, {self.true!r} found ({self.amount:.3g}, relative {self.relative:.3g})"


@dataclass
class Verdict:
    """What the oracle found of one certificate."""

    cost: float  #: exact cost of the answer, rounded
    best: float  #: the least cost found, rounded
    violations: list[Violation] = field(default_factory=list)
    region_ratio: float = np.inf  #: a region's radius over the extent of its part's data, the least of the parts


def form_of(problem: rw.Problem, certificate: Any) -> str:
    """The form whose cost a certificate is about; versions that do not name it follow the same rule."""
    is_inverse = problem.scale == "per_target" or (
        problem.scale == "shared" and any(p.sigma is not None for priors in problem.priors.values() for p in priors)
    )
    return getattr(certificate.objective, "form", "inverse" if is_inverse else "direct")


def centres(problem: rw.Problem, rows: Rows, certificates: list[tuple[tuple[str, ...], Any]]) -> np.ndarray:
    """(F, 3) the origin that the inverse cost of a frame in the role of X is taken about, NaN elsewhere."""
    result = np.full((len(rows.frames), 3), np.nan)
    objectives = {name: certificate.objective for names, certificate in certificates for name in names}
    motions = {x for x, y in zip(rows.X.tolist(), rows.Y.tolist(), strict=True) if x == y}
    for x in sorted(set(rows.X.tolist())):
        which = "motion_origin_m" if x in motions else "origin_m"
        origin = getattr(objectives[rows.frames[x]], which, None)
        if origin is None:  # a certificate of several parts, or a version that does not name it
            for part in _parts_of(problem):
                if rows.frames[x] in part.targets + part.sensors:
                    origin = part.gauge.sensor_carrier if x in motions else part.gauge.target_carrier
        result[x] = origin
    return result


def _parts_of(problem: rw.Problem) -> list[Any]:
    """The parts, each with its origin, for certificates that do not name it."""
    try:
        module = importlib.import_module("gtsam_rwhec.solver.parts")
    except ModuleNotFoundError:
        module = importlib.import_module("gtsam_rwhec.certify.parts")
    return module.parts_of(problem)


def judged(
    case: Case,
    problem: rw.Problem,
    rows: Rows,
    certificate: Any,
    matrices: Mapping[str, np.ndarray],
    scale: float | Mapping[str, float],
    parts: list[tuple[tuple[str, ...], Any]],
    *,
    starts: int = STARTS,
) -> Verdict:
    """The verdict on a certificate of an answer (matrices by frame, and its scale)."""
    form = form_of(problem, certificate)
    poses = Poses.of(rows, matrices, scale)
    centre = centres(problem, rows, parts) if form == "inverse" else np.full((len(rows.frames), 3), np.nan)
    cost = StatedCost(rows, form, poses.t, centre)
    judge = _Judge(case, problem, cost, poses, certificate)
    judge.verdict.region_ratio = min(
        (
            part.region.radius_m / max(cost.extent(poses, names), 1e-300)
            for names, part in parts
            if getattr(part, "region", None) is not None
        ),
        default=np.inf,
    )
    judge.look_at_the_answer()
    if np.isfinite(certificate.lower_bound) and certificate.lower_bound > 0.0:
        judge.look_for_better(starts, np.random.default_rng([case.seed, 7]))
    return judge.verdict


class _Judge:
    def __init__(self, case: Case, problem: rw.Problem, cost: StatedCost, poses: Poses, certificate: Any) -> None:
        self.cost, self.poses, self.certificate = cost, poses, certificate
        self.enclosure = cost.of_poses(poses)
        here = float(self.enclosure.value.hi[0])
        self.verdict = Verdict(here, here)
        basis = getattr(certificate, "basis", "measurements" if case.keep_measurements else "moments")
        about_moments = basis == "moments" or not case.is_exact
        gauge = problem.gauge
        sums = cost.sums(poses, gauge.target_carrier, gauge.sensor_carrier) if about_moments else 0.0
        self.allowance = MOMENTS * sums
        self.bound = certificate.lower_bound - self.allowance
        self.region = self._region()

    def _region(self) -> Region | None:
        record = getattr(self.certificate, "region", None)
        if record is None:
            return None
        rows = self.cost.rows
        scales = np.log([self.poses.alpha[name] for name in rows.free_scales])
        if not (record.radius_m > 0.0 and record.scale_factor > 1.0):
            self._report("region without room", record.radius_m, record.scale_factor)
        return Region(self.poses.t, record.radius_m, scales, float(np.log(max(record.scale_factor, 1.0))))

    def _exact(self, answer: RationalPoses) -> Fraction:
        return exact_cost(self.cost.rows, self.cost.form, self.cost.centre, answer)

    def _report(self, kind: str, said: float, true: float) -> None:
        amount = abs(said - true)
        relative = amount / max(abs(self.certificate.cost), 1.0)
        self.verdict.violations.append(Violation(kind, amount, relative, said, true))

    def _is_below(self, number: float, enclosure: Enclosure, k: int, answer: Callable[[], RationalPoses]) -> bool:
        """Whether the cost that is enclosed is below a number, beyond doubt."""
        if enclosure.is_above(number)[k]:
            return False
        if enclosure.is_below(number)[k]:
            return True
        return self._exact(answer()) < Fraction(number)

    def look_at_the_answer(self) -> None:
        """The claims about the answer itself."""
        certificate = self.certificate
        finite = np.isfinite(certificate.cost) and np.isfinite(certificate.lower_bound)
        if not finite:
            if certificate.status != "failed":
                self._report("not finite, and not failed", certificate.cost, certificate.lower_bound)
            if not np.isfinite(certificate.cost):
                return
        here = self.verdict.cost
        said = certificate.cost + self.allowance
        if self.enclosure.is_above(said)[0] or (
            not self.enclosure.is_below(said)[0] and self._exact(RationalPoses.of(self.poses)) > Fraction(said)
        ):
            self._report("cost below its answer's", certificate.cost, here)
        if certificate.lower_bound > certificate.cost:
            self._report("bound above its own cost", certificate.lower_bound, certificate.cost)
        if certificate.status.startswith("certified"):
            gap = certificate.cost - certificate.lower_bound
            if not gap <= certificate.tolerance:
                self._report("certified with a gap above the tolerance", certificate.cost, certificate.lower_bound)
        if finite and self._is_below(self.bound, self.enclosure, 0, lambda: RationalPoses.of(self.poses)):
            self._report("bound above its answer's cost", certificate.lower_bound, here)

    def look_for_better(self, starts: int, rng: np.random.Generator) -> None:
        """The claim about every answer."""
        cost, bound = self.cost, self.bound
        if not cost.rows.free and not cost.rows.free_scales:
            return
        descent = PairDescent(cost, self.poses, self.region)
        M = weighted_matrix(cost, np.float64)
        candidates = [self.poses, *minima(cost, M, self.poses, starts, rng)]
        answers = descent.answers(candidates)
        z, t = descent.z_and_t(answers)
        value, _ = cost.enclosed(z, t)
        inside = descent.inside(answers, t.hi)
        slack = NEAR * max(abs(bound), 1.0)
        worth = inside & (value.value.hi <= bound + slack)
        if not worth.any():
            # Answers outside the region may still lead to its border.
            worth = np.zeros(len(inside), dtype=bool)
            worth[0] = value.value.hi[0] <= bound + slack
            if not worth.any():
                return
        chosen = answers.at(np.flatnonzero(worth)[:3])
        answers, value = descent.descend(chosen, STEPS)
        self._compare(descent, answers, value)
        best = int(np.argmin(value.value.hi))
        far = descent.far(answers, best)
        if far is not None:
            value_far = descent.enclosed(far)
            order = np.argsort(value_far.value.hi)[:6]
            far, value_far = descent.descend(far.at(order), 2, holds_weak=True)
            order = np.argsort(value_far.value.hi)[:2]
            far, value_far = descent.descend(far.at(order), 4)
            self._compare(descent, far, value_far)

    def _compare(self, descent: PairDescent, answers: Answers, value: Enclosure) -> None:
        """The bound against answers: as they are, rounded to doubles, and each entry an ulp to where it costs less."""
        k = int(np.argmin(value.value.hi))
        certificate = self.certificate
        found = float(value.value.hi[k])
        self.verdict.best = min(self.verdict.best, found)
        kinds = {violation.kind for violation in self.verdict.violations}
        if "bound above an answer" not in kinds and self._is_below(
            self.bound, value, k, lambda: descent.rational(answers, k)
        ):
            self._report("bound above an answer", certificate.lower_bound, found)
        rounded = descent.rounded(answers, k)
        enclosure = self.cost.of_poses(rounded)
        if "bound above a rounded answer" not in kinds and self._is_below(
            self.bound, enclosure, 0, lambda: RationalPoses.of(rounded)
        ):
            self._report("bound above a rounded answer", certificate.lower_bound, float(enclosure.value.hi[0]))
        nudged = descent.nudged(rounded)
        enclosure = self.cost.of_poses(nudged)
        if "bound above an answer an ulp off" not in kinds and self._is_below(
            self.bound, enclosure, 0, lambda: RationalPoses.of(nudged)
        ):
            self._report("bound above an answer an ulp off", certificate.lower_bound, float(enclosure.value.hi[0]))
