"""Why an answer is proven or not, and how it was found: facts for programs, each with its words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum


class Start(StrEnum):
    """From where the descent came that ended at the answer."""

    GIVEN = "given start"
    SPECTRAL = "spectral start"
    #: A negative eigenvector of Z, the unconstrained minimum of Q', or a random start.
    BETTER = "better start"
    #: The semidefinite relaxation, solved by Clarabel or by the block method of ``interior_point``.
    CLARABEL = "relaxation (Clarabel)"
    INTERIOR_POINT = "relaxation (interior point (blocks))"
    #: The relaxation that has alpha >= 0 as a constraint.
    NONNEGATIVE_SCALE = "relaxation with alpha >= 0"


class Multipliers(StrEnum):
    """Which multipliers gave the best lower bound."""

    #: Those of R'R = I at the answer (DESIGN fact 3).
    KKT = "dual"
    #: Those of all 20 independent constraints of each rotation (DESIGN fact 4).
    ALL_CONSTRAINTS = "small dual"
    #: Those that the solver of the semidefinite relaxation returned.
    RELAXATION = "relaxation's multipliers"


@dataclass(frozen=True)
class SearchPath:
    """How the answer and its bound were found; ``str()`` is "spectral start, dual" and the like.

    Attributes
    ----------
    start : Start
    multipliers : Multipliers
    is_mirrored : bool
        Whether the answer is the mirror image of the one first found, which had a negative scale.
    """

    start: Start
    multipliers: Multipliers
    is_mirrored: bool = False

    @staticmethod
    def parse(text: str) -> SearchPath:
        """The path that a result file has as text.

        Raises
        ------
        ValueError
            For a text that ``str()`` of no path is.
        """
        start, *rest = text.split(", ")
        multipliers = Multipliers(rest[0]) if rest[:1] not in ([], ["mirrored"]) else Multipliers.RELAXATION
        start = {"relaxation": Start.INTERIOR_POINT}.get(start, start)
        return SearchPath(Start(start), multipliers, is_mirrored=rest[-1:] == ["mirrored"])

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
    #: No bound, or no critical point, was found.
    FAILED = "failed"


class Cause(StrEnum):
    """Why an answer is proven optimal, or why not; from the best to the worst.

    DESIGN fact 4 names three reasons for which the multipliers of R'R = I do not suffice: (a) redundant constraints are
    needed, (b) the answer is a local minimum, (c) the relaxation is not tight.
    """

    #: The multipliers of R'R = I at the first answer prove it.
    PROVEN = "proven"
    #: Proven, and the multipliers of redundant constraints were needed: fact 4 (a).
    PROVEN_WITH_REDUNDANT_CONSTRAINTS = "proven_with_redundant_constraints"
    #: Proven, and the first start led to a local minimum: fact 4 (b). ``SearchPath.multipliers`` tells whether (a) too.
    PROVEN_AFTER_LOCAL_MINIMUM = "proven_after_local_minimum"
    #: The optimum has a negative scale; this is the proven optimum among answers with alpha >= 0.
    PROVEN_WITH_NONNEGATIVE_SCALE = "proven_with_nonnegative_scale"
    #: The cost is proven optimal; the measurements leave directions free.
    FREE_DIRECTIONS = "free_directions"
    #: The cost is proven optimal; another answer, far from this one, costs the same.
    TWIN = "twin"
    #: Not proven, because the bound's allowance for rounding is larger than the tolerance.
    ROUNDING = "rounding"
    #: Not proven: the mirror image, with a negative scale, costs less.
    MIRROR_IMAGE = "mirror_image"
    #: Not proven: either a local minimum, fact 4 (b), or redundant constraints are needed, (a). method="local" does not
    #: find out which.
    LOCAL_MINIMUM_POSSIBLE = "local_minimum_possible"
    #: Not proven: the small dual and the relaxation were not tried, as the problem is too large for them.
    TOO_LARGE = "too_large"
    #: Not proven: the relaxation's optimum is below the best answer that was found, fact 4 (c).
    NOT_TIGHT = "not_tight"
    #: Not optimal: the search found a better answer than the one that was to be certified.
    BETTER_ANSWER = "better_answer"
    #: Not proven: eliminating the translations lost so many digits that the reduced form has another cost.
    DIGITS_LOST = "digits_lost"
    #: No finite bound was found.
    NO_BOUND = "no_bound"
    #: The answer costs less than the bound of the reduced form, which rounding alone can bring about.
    BELOW_BOUND = "below_bound"
    #: Read from a result file of format version 3 or older, which has words only.
    NOT_RECORDED = "not_recorded"

    @property
    def status(self) -> Status:
        """What a certificate with this cause says; of ``NOT_RECORDED``, the file tells."""
        if self in (Cause.FREE_DIRECTIONS, Cause.TWIN):
            return Status.CERTIFIED_NOT_UNIQUE
        if self in (Cause.NO_BOUND, Cause.BELOW_BOUND):
            return Status.FAILED
        return Status.CERTIFIED if self.is_proven else Status.GAP

    @property
    def is_proven(self) -> bool:
        """Whether the answer is proven optimal."""
        return self in _PROVEN

    def sentence(self, figures: Mapping[str, float]) -> str:
        """The cause in words, with its figures."""
        return _SENTENCES[self].format(**figures)


_PROVEN = (
    Cause.PROVEN,
    Cause.PROVEN_WITH_REDUNDANT_CONSTRAINTS,
    Cause.PROVEN_AFTER_LOCAL_MINIMUM,
    Cause.PROVEN_WITH_NONNEGATIVE_SCALE,
)
_SENTENCES = {
    Cause.PROVEN: "proven globally optimal",
    Cause.PROVEN_WITH_REDUNDANT_CONSTRAINTS: "proven globally optimal; the multipliers of redundant constraints were "
    "needed",
    Cause.PROVEN_AFTER_LOCAL_MINIMUM: "proven globally optimal; the first start led to a local minimum",
    Cause.PROVEN_WITH_NONNEGATIVE_SCALE: "proven optimal among the answers with a scale of at least zero; without that "
    "constraint the optimum has a negative scale",
    Cause.FREE_DIRECTIONS: "the cost is proven globally optimal, but the answer is not unique: the number of "
    "directions that the measurements leave free is {free_directions:.0f} (Solution.identifiability names them)",
    Cause.TWIN: "the cost is proven globally optimal, but another answer, far from this one, costs the same",
    Cause.ROUNDING: "the bound reaches the cost in exact arithmetic, but not with the allowance for rounding; free "
    "directions and mirror images cause this",
    Cause.MIRROR_IMAGE: "the mirror image, which has a negative scale, costs {mirror_cost:.8g}, less than this "
    "answer's {cost:.8g}: with planar motion only the noise decides the sign of the scale",
    Cause.LOCAL_MINIMUM_POSSIBLE: "the answer may be a local minimum, or the multipliers of redundant constraints are "
    "needed; method='auto' finds out",
    Cause.TOO_LARGE: "the problem has {frames:.0f} unknown frames, and the semidefinite relaxation is tried up to "
    "SolveOptions.max_dense_frames = {max_dense_frames:.0f}",
    Cause.NOT_TIGHT: "the relaxation is not tight: its own optimum is {relaxation_cost:.8g}, below the best answer's "
    "{cost:.8g}",
    Cause.BETTER_ANSWER: "a better answer exists: {better_cost:.8g} against {cost:.8g}",
    Cause.DIGITS_LOST: "eliminating the translations lost digits: the answer costs {cost:.8g}, and {reduced_cost:.8g} "
    "in the reduced form that the bound is about; the motion hardly turns for the accuracy that sigma claims",
    Cause.NO_BOUND: "no finite lower bound was found",
    Cause.BELOW_BOUND: "the answer costs {cost:.8g}, less than the bound of the reduced form, {reduced_bound:.8g}: "
    "eliminating the translations lost digits",
    Cause.NOT_RECORDED: "the file does not tell why",
}
