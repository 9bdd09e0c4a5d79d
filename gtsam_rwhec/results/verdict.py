"""The verdict on a calibration: may its poses be used? Reports, files, exports and the exit status share this rule."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.refinement.refined import RefinedPoses
from gtsam_rwhec.results.log_history import LogFields
from gtsam_rwhec.solver.cause import Status
from gtsam_rwhec.solving.solution import Solution


class Verdict(StrEnum):
    """What to do with the poses."""

    #: The answer is certified, and the measurements determine it and do not contradict it.
    USE = "use"
    #: The poses may be right, but a person should first look at the grounds.
    CARE = "care"
    #: Some poses are wrong, or the measurements do not determine them.
    DO_NOT_USE = "do_not_use"

    @property
    def words(self) -> str:
        """The instruction to the user."""
        return {
            Verdict.USE: "Use these poses",
            Verdict.CARE: "Use these poses with care",
            Verdict.DO_NOT_USE: "Do not use these poses",
        }[self]


class Ground(StrEnum):
    """Reasons not to use the poses, the most serious first."""

    #: No lower bound of the cost was found.
    NO_BOUND = "no_bound"
    #: The lower bound is below the cost: a better answer may exist.
    NOT_CERTIFIED = "not_certified"
    #: The measurements leave a direction free.
    NOT_UNIQUE = "not_unique"
    #: Most measurements of a sensor or target were left out as outliers.
    CONTRADICTED = "contradicted"
    #: The stated size of a target was used, but it does not fit the motion.
    SIZE_DOUBTED = "size_doubted"

    @property
    def verdict(self) -> Verdict:
        """The verdict to which this ground leads."""
        return Verdict.CARE if self in (Ground.NOT_CERTIFIED, Ground.SIZE_DOUBTED) else Verdict.DO_NOT_USE


@dataclass(frozen=True)
class Judgement:
    """A verdict with its grounds.

    Attributes
    ----------
    verdict : Verdict
        What to do with the poses.
    grounds : tuple of Ground
        Reasons not to use the poses, the most serious first; empty for ``Verdict.USE``.
    reason : str
        The grounds in words.
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
        The refined calibration.
    log : LogFields, optional
        What became of the measurements, if they come from a log.
    """
    if not isinstance(solution, Solution):
        raise OptionError(f"the solution is a {type(solution).__name__}; give what gtsam_rwhec.solve returned")
    certificate = solution.certificate
    found: dict[Ground, str] = {}
    if certificate.status is Status.FAILED:
        found[Ground.NO_BOUND] = "no lower bound of the cost was found, so a much better answer may exist"
    elif not certificate.is_optimal:
        found[Ground.NOT_CERTIFIED] = (
            f"a better answer may exist; its cost would be lower by at most {100.0 * certificate.relative_gap:.2g} %"
        )
    is_unique = solution.identifiability.is_unique and certificate.status is not Status.CERTIFIED_NOT_UNIQUE
    if not is_unique or (refined is not None and refined.free_directions):
        found[Ground.NOT_UNIQUE] = "the measurements do not determine all poses; other poses fit them equally well"
    if log is not None:
        if log.contradicted:
            found[Ground.CONTRADICTED] = "; ".join(map(str, log.contradicted))
        doubted = [size.target for size in log.sizes if size.is_doubted and not size.is_free]
        if doubted:
            found[Ground.SIZE_DOUBTED] = f"the stated size of {', '.join(doubted)} does not fit the motion"
    if found:
        worst = max((ground.verdict for ground in found), key=list(Verdict).index)
        return Judgement(worst, tuple(found), "; ".join(found.values()))
    proven = (
        "the answer is proven optimal, and"
        if refined is None
        else "the first answer is proven optimal, the refinement started from it, and"
    )
    return Judgement(Verdict.USE, (), f"{proven} the measurements determine every pose")
