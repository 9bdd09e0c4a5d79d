"""Causes and paths: why an answer is proven optimal or not, and how the search found it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum


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

    @property
    def words(self) -> str:
        """How the answer was found, and how its bound was proven."""
        mirrored = " and mirrored" if self.is_mirrored else ""
        return f"found from {_STARTS[self.start]}{mirrored}, bound proven by {_MULTIPLIERS[self.multipliers]}"

    @staticmethod
    def parse(text: str) -> SearchPath:
        """The path that a result file has as text; a ``ValueError`` for any other text."""
        start, *rest = text.split(", ")
        multipliers = Multipliers(rest[0]) if rest[:1] not in ([], ["mirrored"]) else Multipliers.RELAXATION
        start = {"relaxation": Start.INTERIOR_POINT}.get(start, start)
        return SearchPath(Start(start), multipliers, is_mirrored=rest[-1:] == ["mirrored"])

    def __str__(self) -> str:
        return ", ".join([self.start, self.multipliers] + ["mirrored"] * self.is_mirrored)


_STARTS = {
    Start.GIVEN: "the given start",
    Start.SPECTRAL: "a spectral start",
    Start.BETTER: "a better start",
    Start.CLARABEL: "the relaxation (Clarabel)",
    Start.INTERIOR_POINT: "the relaxation (interior point)",
    Start.LOCAL_RELAXATION: "the relaxation of a few frames",
    Start.NONNEGATIVE_SCALE: "the relaxation with alpha >= 0",
}
_MULTIPLIERS = {
    Multipliers.KKT: "dual multipliers",
    Multipliers.ALL_CONSTRAINTS: "dual multipliers of all constraints",
    Multipliers.RELAXATION: "the relaxation's multipliers",
}


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
    #: More frames at once need the multipliers of all constraints than the dense methods take.
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
    #: Only in result files of format version 4 and older, whose bound was about the reduced form.
    DIGITS_LOST = (
        "digits_lost",
        Status.GAP,
        "eliminating the translations lost digits: the answer costs {cost:.8g}, and {reduced_cost:.8g} in the reduced "
        "form that the bound is about; the motion turns too little for the accuracy that sigma claims",
    )
    NO_BOUND = "no_bound", Status.FAILED, "no finite lower bound was found"
    #: As DIGITS_LOST: now no answer can cost less than the bound, rounding included.
    BELOW_BOUND = (
        "below_bound",
        Status.FAILED,
        "the answer costs {cost:.8g}, less than the bound of the reduced form, {reduced_bound:.8g}: eliminating the "
        "translations lost digits",
    )
    #: Read from a result file of format version 3 or older, which has words only; the file has the status.
    NOT_RECORDED = "not_recorded", Status.GAP, "the file does not tell why"

    def __new__(cls, value: str, status: Status, sentence: str) -> Cause:
        """A member of the table."""
        cause = str.__new__(cls, value)
        cause._value_, cause.status, cause._sentence = value, status, sentence
        return cause

    def sentence(self, figures: Mapping[str, float]) -> str:
        """The cause in words, with its figures."""
        return self._sentence.format(**figures)
