"""Whether a calibration is to be used: one rule, for the report, the result file, exports and the exit status."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from gtsam_rwhec.refinement.refined import RefinedPoses
from gtsam_rwhec.results.stage_reports import LogFields
from gtsam_rwhec.solver.cause import Status
from gtsam_rwhec.solving.solution import Solution


class Verdict(StrEnum):
    """What to do with the poses."""

    #: Certified, determined by the measurements, contradicted by none of them.
    USE = "use"
    #: They may be right, but something speaks against them that a person should look at first.
    CARE = "care"
    #: Some poses are known to be wrong, or could be others just as well.
    DO_NOT_USE = "do_not_use"

    @property
    def words(self) -> str:
        """How a sentence about it begins."""
        return {
            Verdict.USE: "Use these poses",
            Verdict.CARE: "Use these poses with care",
            Verdict.DO_NOT_USE: "Do not use these poses",
        }[self]


class Ground(StrEnum):
    """What speaks against using the poses, the gravest first."""

    #: No bound on the cost was found.
    NO_BOUND = "no_bound"
    #: The bound is below the cost: a better answer may exist.
    NOT_CERTIFIED = "not_certified"
    #: The measurements leave a direction free.
    NOT_UNIQUE = "not_unique"
    #: Most measurements of a sensor or target were left out as outliers.
    CONTRADICTED = "contradicted"
    #: A size was taken as stated, and the measurements say another one.
    SIZE_DOUBTED = "size_doubted"

    @property
    def verdict(self) -> Verdict:
        """What it leads to."""
        return Verdict.CARE if self in (Ground.NOT_CERTIFIED, Ground.SIZE_DOUBTED) else Verdict.DO_NOT_USE


@dataclass(frozen=True)
class Judgement:
    """A verdict and what it rests on.

    Attributes
    ----------
    verdict : Verdict
    grounds : tuple of Ground
        What speaks against using the poses, the gravest first; none for ``Verdict.USE``.
    reason : str
        The same in words.
    """

    verdict: Verdict
    grounds: tuple[Ground, ...]
    reason: str

    def __str__(self) -> str:
        return f"{self.verdict.words}: {self.reason}."


def judge(solution: Solution, refined: RefinedPoses | None = None, log: LogFields | None = None) -> Judgement:
    """Judge a calibration by its facts.

    Parameters
    ----------
    solution : Solution
        The certified solution.
    refined : RefinedPoses, optional
        What refining made of it.
    log : LogFields, optional
        What became of the measurements of a log.
    """
    certificate = solution.certificate
    found: dict[Ground, str] = {}
    if certificate.status is Status.FAILED:
        found[Ground.NO_BOUND] = "it is not proven that they are near the best answer, as no bound was found"
    elif not certificate.is_optimal:
        found[Ground.NOT_CERTIFIED] = (
            "it is not proven that no answer is better: the cost may be up to "
            f"{100.0 * certificate.relative_gap:.2g} % above the lowest"
        )
    is_unique = solution.identifiability.is_unique and certificate.status is not Status.CERTIFIED_NOT_UNIQUE
    if not is_unique or (refined is not None and refined.free_directions):
        found[Ground.NOT_UNIQUE] = "the measurements do not determine all of them: others fit as well"
    if log is not None:
        if log.contradicted:
            found[Ground.CONTRADICTED] = "; ".join(log.contradictions)
        doubted = [size.target for size in log.sizes if size.is_doubted and not size.is_free]
        if doubted:
            found[Ground.SIZE_DOUBTED] = f"the stated size of {', '.join(doubted)} does not fit the motion"
    if found:
        worst = max((ground.verdict for ground in found), key=list(Verdict).index)
        return Judgement(worst, tuple(found), "; ".join(found.values()))
    answer = "they are" if refined is None else "the answer that they were refined from is"
    return Judgement(Verdict.USE, (), f"{answer} proven optimal, and the measurements determine every pose")
