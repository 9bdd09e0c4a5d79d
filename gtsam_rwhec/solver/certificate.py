"""The certificate of an answer: its cost, the lower bound, and what the two prove."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import fsum

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.parts import Kind, Part
from gtsam_rwhec.solver.region import Region


class Start(StrEnum):
    """Where the descent began that ended at the answer."""

    GIVEN = "given start"
    SPECTRAL = "spectral start"
    #: A negative eigenvector of Z, the unconstrained minimum of Q', or a random start.
    BETTER = "better start"
    #: The semidefinite relaxation, solved by Clarabel or by the block method of ``interior_point``.
    CLARABEL = "relaxation (Clarabel)"
    INTERIOR_POINT = "relaxation (interior point (blocks))"
    #: The relaxation of a few of many frames, with the others eliminated (``local_relaxation``).
    LOCAL_RELAXATION = "relaxation of a few frames"
    #: The relaxation that has alpha >= 0 as a constraint.
    NONNEGATIVE_SCALE = "relaxation with alpha >= 0"


class Multipliers(StrEnum):
    """Which multipliers gave the best lower bound."""

    #: Multipliers of R'R = I, at the answer (design fact 3).
    KKT = "dual"
    #: Multipliers of all 20 independent constraints of each rotation (design fact 4).
    ALL_CONSTRAINTS = "small dual"
    #: Multipliers that the solver of the semidefinite relaxation returned.
    RELAXATION = "relaxation's multipliers"


@dataclass(frozen=True)
class SearchPath:
    """How the answer and its bound were found; ``str()`` is "spectral start, dual" and the like.

    ``is_mirrored``: the answer is the mirror image of the one first found, which had a negative scale.
    """

    start: Start
    multipliers: Multipliers
    is_mirrored: bool = False

    @property
    def words(self) -> str:
        """How the answer was found, and how its bound was proven."""
        mirrored = " and mirrored" if self.is_mirrored else ""
        of_rotations = " multipliers" if self.multipliers is Multipliers.KKT else ""
        return f"found from the {self.start}{mirrored}, bound proven by the {self.multipliers}{of_rotations}"

    def __str__(self) -> str:
        return ", ".join([self.start, self.multipliers] + ["mirrored"] * self.is_mirrored)


class Status(StrEnum):
    """What a certificate says."""

    #: The answer is proven optimal, and the measurements determine it.
    CERTIFIED = "certified"
    #: The cost is proven optimal, but other answers cost the same, up to noise: some direction is free.
    CERTIFIED_NOT_UNIQUE = "certified_not_unique"
    #: The bound is true but below the cost: the answer may or may not be optimal.
    GAP = "gap"
    #: The search found no bound, or no critical point.
    FAILED = "failed"


class Cause(StrEnum):
    """Why an answer is proven optimal, or why not; from the best to the worst.

    Each cause has its name in files, the status of a certificate with this cause, and its sentence. Design fact 4 names
    three reasons for which the multipliers of R'R = I do not suffice: (a) redundant constraints are needed, (b) the
    answer is a local minimum, (c) the relaxation is not tight.
    """

    status: Status
    _sentence: str

    #: The multipliers of R'R = I at the first answer prove it.
    PROVEN = "proven", Status.CERTIFIED, "proven globally optimal"
    #: Fact 4 (a).
    PROVEN_WITH_REDUNDANT_CONSTRAINTS = (
        "proven_with_redundant_constraints",
        Status.CERTIFIED,
        "proven globally optimal; the multipliers of redundant constraints were needed",
    )
    #: Fact 4 (b). ``SearchPath.multipliers`` tells whether redundant constraints were needed too.
    PROVEN_AFTER_LOCAL_MINIMUM = (
        "proven_after_local_minimum",
        Status.CERTIFIED,
        "proven globally optimal; the first start led to a local minimum",
    )
    PROVEN_WITH_NONNEGATIVE_SCALE = (
        "proven_with_nonnegative_scale",
        Status.CERTIFIED,
        "proven optimal among the answers with a scale of at least zero; without that constraint the optimum has a "
        "negative scale",
    )
    FREE_DIRECTIONS = (
        "free_directions",
        Status.CERTIFIED_NOT_UNIQUE,
        "the cost is proven globally optimal, but the answer is not unique: the number of directions that the "
        "measurements leave free is {free_directions:.0f} (Solution.identifiability names them)",
    )
    TWIN = (
        "twin",
        Status.CERTIFIED_NOT_UNIQUE,
        "the cost is proven globally optimal, but another answer, far from this one, costs the same",
    )
    #: The bound's allowance for rounding is larger than the tolerance.
    ROUNDING = (
        "rounding",
        Status.GAP,
        "the bound reaches the cost in exact arithmetic, but not with the allowance for rounding; free directions, "
        "mirror images, far origins and extreme weights cause this, and more so where the measurements are not kept",
    )
    MIRROR_IMAGE = (
        "mirror_image",
        Status.GAP,
        "the mirror image, which has a negative scale, costs no more: {mirror_cost:.8g} against this "
        "answer's {cost:.8g}; with planar motion only the noise decides the sign of the scale",
    )
    #: Fact 4 (a) or (b) applies; method="local" does not find out which.
    LOCAL_MINIMUM_POSSIBLE = (
        "local_minimum_possible",
        Status.GAP,
        "the answer may be a local minimum, or the multipliers of redundant constraints are needed; method='auto' "
        "finds out",
    )
    #: Too many frames at once need the multipliers of all constraints: the dense methods cannot take them.
    TOO_LARGE = (
        "too_large",
        Status.GAP,
        "the semidefinite relaxation that it takes has {frames:.0f} unknown frames, and it is tried up to "
        "SolveOptions.max_dense_frames = {max_dense_frames:.0f}; look for wrong measurements first; a larger number is "
        "allowed, and takes much time and memory",
    )
    #: Fact 4 (c), for a few of many frames: the relaxation of all frames may be tight.
    PART_NOT_TIGHT = (
        "part_not_tight",
        Status.GAP,
        "the multipliers of R'R = I do not suffice for {relaxed:.0f} frames, and the relaxation of these proves no "
        "more than {relaxation_cost:.8g}, below the best answer's {cost:.8g}; the relaxation of all {frames:.0f} "
        "unknown frames together is tried up to SolveOptions.max_dense_frames = {max_dense_frames:.0f}",
    )
    #: Fact 4 (c).
    NOT_TIGHT = (
        "not_tight",
        Status.GAP,
        "the relaxation is not tight: its own optimum is {relaxation_cost:.8g}, below the best answer's {cost:.8g}",
    )
    #: The search found a better answer than the one that was to be certified.
    BETTER_ANSWER = "better_answer", Status.GAP, "a better answer exists: {better_cost:.8g} against {cost:.8g}"
    NO_BOUND = "no_bound", Status.FAILED, "no finite lower bound was found"

    def __new__(cls, value: str, status: Status, sentence: str) -> Cause:
        """A member of the table."""
        cause = str.__new__(cls, value)
        cause._value_, cause.status, cause._sentence = value, status, sentence
        return cause

    def sentence(self, figures: Mapping[str, float]) -> str:
        """The cause in words, with its figures."""
        return self._sentence.format(**figures)


class Basis(StrEnum):
    """What the cost and the bound are true of; from the strongest claim to the weakest."""

    #: The measurements as they were given, in double precision; all rounding is enclosed.
    MEASUREMENTS = "measurements"
    #: Their moments as they are stored, as the measurements were not kept: the rounding of the sums is not enclosed.
    MOMENTS = "moments"


@dataclass(frozen=True)
class Objective:
    """Which cost a certificate is about.

    ``form`` "direct" is the cost of A X = Y B (eq. 18), "inverse" that of B X^-1 = Y^-1 A, which a scale for each
    target needs, and priors on translations with an unknown scale (design facts 7 and 11). The inverse cost is not half
    a chi-square; ``refine`` finds the optimum of the exact model from its answer. It depends on the target carrier's
    origin, as its rotation residual acts on the lever arm t_X: it is about ``origin_m`` in the target carrier's frame,
    metres (A becomes A T(origin_m), X becomes T(-origin_m) X), and for motions about ``motion_origin_m`` in the
    sensor's carrier. Both are None for the direct cost, and where unconnected parts differ: ``Solution.parts`` has each
    part's own. ``by_direction``: some measurements weigh by their information matrix; its directions are those of the
    answer of the last round but one, in which nothing moved any more.
    """

    form: Kind
    has_priors: bool
    origin_m: tuple[float, float, float] | None = None
    motion_origin_m: tuple[float, float, float] | None = None
    by_direction: bool = False

    @staticmethod
    def of(part: Part) -> Objective:
        """The cost of a part."""
        objective = Objective(part.kind, bool(part.priors), by_direction=bool(part.directed))
        if part.kind == "direct":
            return objective
        of_motions = _triple(part.gauge.sensor_carrier) if part.moments.motion.any() else None
        return replace(objective, origin_m=_triple(part.gauge.target_carrier), motion_origin_m=of_motions)

    @staticmethod
    def merged(objectives: list[Objective]) -> Objective:
        """That of several parts: an origin only where they share it."""
        origins, of_motions = {o.origin_m for o in objectives}, {o.motion_origin_m for o in objectives}
        return Objective(
            "inverse" if any(o.form == "inverse" for o in objectives) else "direct",
            any(o.has_priors for o in objectives),
            origins.pop() if len(origins) == 1 else None,
            of_motions.pop() if len(of_motions) == 1 else None,
            any(o.by_direction for o in objectives),
        )

    def __str__(self) -> str:
        about = ""
        if self.origin_m is not None:
            about = f", about the point ({', '.join(f'{x:.6g}' for x in self.origin_m)}) m of the target carrier"
        if self.by_direction:
            about += (
                "; where measurements weigh by direction, by their information, with the directions of translations at "
                "the answer of the round before"
            )
        return _OBJECTIVES[self.form] + about + (", and the priors" if self.has_priors else "")


def _triple(v: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in v)
    return x, y, z


_OBJECTIVES: dict[Kind, str] = {
    "direct": "Problem 3 of the RWHEC paper: half the squared residuals of A X = Y B, R_A t_X + alpha t_A - t_Y - "
    "R_Y t_B over sigma and R_A R_X - R_Y R_B times the square root of kappa",
    "inverse": "half the squared residuals of the inverse equation B X^-1 = Y^-1 A, with each t_B divided by its scale",
}


@dataclass(frozen=True)
class Certificate:
    """The proof that an answer is optimal, or how far its cost is from a proof.

    Attributes
    ----------
    status, cause, figures
        Whether it is proven, why or why not, and the numbers in the cause's sentence, by name.
    objective, basis
        Which cost it is about, and whether cost and bound are true of the measurements or of their moments as stored.
    path
        The start of the descent to the answer, and the multipliers of the bound.
    cost, lower_bound : float
        The exact cost of the answer as it is returned is at most ``cost``, and no answer (of the ``region``) costs less
        than ``lower_bound``, for rotations up to the rounding of doubles. ``float_bound`` has no allowance for
        rounding.
    min_eigenvalue : float
        A lower bound on the certificate matrix Z's smallest eigenvalue. In exact arithmetic it is 0 when certified.
    tolerance : float
        The absolute gap up to which the answer counts as optimal.
    is_relative : bool
        Whether all weights are 1: the cost then has no statistical meaning.
    seconds : dict of str to float
        Time of each stage, s.
    region : Region or None
        The answers that the bound is about; None: all. It is named where the measurements leave a translation or a
        scale free up to the rounding of their doubles. What is free up to noise only needs none.
    """

    status: Status
    cause: Cause
    objective: Objective
    path: SearchPath
    cost: float
    lower_bound: float
    float_bound: float
    min_eigenvalue: float
    tolerance: float
    is_relative: bool
    seconds: dict[str, float] = field(default_factory=dict)
    figures: dict[str, float] = field(default_factory=dict)
    basis: Basis = Basis.MEASUREMENTS
    region: Region | None = None

    @property
    def reason(self) -> str:
        """The cause in a sentence."""
        parts = int(self.figures.get("parts", 1))
        apart = f"{parts} unconnected parts, solved separately; " if parts > 1 else ""
        return apart + self.cause.sentence({"cost": self.cost} | self.figures)

    @property
    def is_certified(self) -> bool:
        """Whether the answer is proven optimal and determined by the measurements."""
        return self.status is Status.CERTIFIED

    @property
    def is_optimal(self) -> bool:
        """Whether the cost is proven optimal; other answers may cost the same."""
        return self.status in (Status.CERTIFIED, Status.CERTIFIED_NOT_UNIQUE)

    @property
    def gap(self) -> float:
        """Cost minus lower bound, at least 0."""
        return max(0.0, self.cost - self.lower_bound)

    @property
    def relative_gap(self) -> float:
        """The gap over the cost. Where exact data make the cost zero, the gap is divided by a million tolerances."""
        is_zero = self.cost <= self.tolerance
        return self.gap / (max(abs(self.cost), 1e6 * self.tolerance, 1e-300) if is_zero else self.cost)

    @property
    def float_gap(self) -> float:
        """The relative gap without the allowance for rounding."""
        return replace(self, lower_bound=self.float_bound).relative_gap

    def __str__(self) -> str:
        unit = " (unit weights: relative)" if self.is_relative else ""
        of = " (of the moments)" if self.basis is Basis.MOMENTS else ""
        return (
            f"{self.status}: cost {self.cost:.8g}{unit}, no answer below {self.lower_bound:.8g}{of}, "
            f"relative gap {self.relative_gap:.1e}; {self.reason}" + (f"; {self.region}" if self.region else "")
        )

    @staticmethod
    def merged(certificates: list[Certificate]) -> Certificate:
        """One certificate for parts that were solved separately: the sums of costs and bounds, and the worst cause."""
        if len(certificates) == 1:
            return certificates[0]
        statuses, causes = list(Status), list(Cause)
        worst = max(certificates, key=lambda c: (statuses.index(c.status), causes.index(c.cause)))
        return Certificate(
            status=worst.status,
            cause=worst.cause,
            objective=Objective.merged([c.objective for c in certificates]),
            basis=max((c.basis for c in certificates), key=list(Basis).index),
            region=Region.common([c.region for c in certificates]),
            path=worst.path,
            # Rounded outwards, so that both stay true.
            cost=float(np.nextafter(fsum(c.cost for c in certificates), np.inf)),
            lower_bound=float(np.nextafter(fsum(c.lower_bound for c in certificates), -np.inf)),
            float_bound=sum(c.float_bound for c in certificates),
            min_eigenvalue=min(c.min_eigenvalue for c in certificates),
            tolerance=sum(c.tolerance for c in certificates),
            is_relative=worst.is_relative,
            seconds=dict(sum((Counter(c.seconds) for c in certificates), Counter())),
            figures={"cost": worst.cost} | worst.figures | {"parts": float(len(certificates))},
        )
