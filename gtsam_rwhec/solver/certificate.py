"""The certificate of an answer: its cost, the lower bound, and what the two prove."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from gtsam_rwhec.solver.cause import Cause, SearchPath, Status
from gtsam_rwhec.solver.parts import Kind


@dataclass(frozen=True)
class Objective:
    """Which cost a certificate is about.

    Attributes
    ----------
    form : "direct" or "inverse"
        "direct" is the cost of A X = Y B (eq. 18). "inverse" is the cost of B X^-1 = Y^-1 A. A scale for each target
        needs it, and so do priors on translations with an unknown scale (design facts 7 and 11). The inverse cost is
        not half a chi-square; ``refine`` finds the optimum of the exact model from its answer.
    has_priors : bool
        Whether the cost has terms for priors.
    """

    form: Kind
    has_priors: bool

    def __str__(self) -> str:
        return _OBJECTIVES[self.form] + (", and the priors" if self.has_priors else "")


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
    status : Status
    cause : Cause
        Why it is proven, or why not.
    figures : dict of str to float
        The numbers in the sentence of the cause, by name.
    objective : Objective
        Which cost the certificate is about.
    path : SearchPath
        The start of the descent to the answer, and the multipliers of the bound.
    cost : float
        J at the answer (eq. 18; half a chi-square when the weights are true).
    lower_bound : float
        No answer costs less; rigorous in floating point, for the reduced form as stored.
    float_bound : float
        The lower bound without the allowance for rounding.
    min_eigenvalue : float
        A lower bound on the certificate matrix Z's smallest eigenvalue. In exact arithmetic it is 0 when certified.
    tolerance : float
        The absolute gap up to which the answer counts as optimal.
    is_relative : bool
        Whether all weights are 1: the cost then has no statistical meaning.
    seconds : dict of str to float
        Time of each stage, in s.
    words : str
        The reason in a file of format version 3 or older, which has no cause; empty otherwise.
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
    words: str = ""

    @property
    def reason(self) -> str:
        """The cause in a sentence."""
        parts = int(self.figures.get("parts", 1))
        apart = f"{parts} unconnected parts, solved separately; " if parts > 1 else ""
        return self.words or apart + self.cause.sentence({"cost": self.cost} | self.figures)

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
        return self._relative_gap(self.lower_bound)

    @property
    def float_gap(self) -> float:
        """The relative gap without the allowance for rounding."""
        return self._relative_gap(self.float_bound)

    def _relative_gap(self, bound: float) -> float:
        is_zero = self.cost <= self.tolerance
        return max(0.0, self.cost - bound) / (
            max(abs(self.cost), 1e6 * self.tolerance, 1e-300) if is_zero else self.cost
        )

    def __str__(self) -> str:
        unit = " (unit weights: relative)" if self.is_relative else ""
        return (
            f"{self.status}: cost {self.cost:.8g}{unit}, no answer below {self.lower_bound:.8g}, "
            f"relative gap {self.relative_gap:.1e}; {self.reason}"
        )

    @staticmethod
    def merged(certificates: list[Certificate]) -> Certificate:
        """One certificate for parts that were solved separately: the sums of costs and bounds, and the worst cause."""
        if len(certificates) == 1:
            return certificates[0]
        statuses, causes = list(Status), list(Cause)
        worst = max(certificates, key=lambda c: (statuses.index(c.status), causes.index(c.cause)))
        seconds: Counter[str] = Counter()
        for certificate in certificates:
            seconds.update(certificate.seconds)
        return Certificate(
            status=worst.status,
            cause=worst.cause,
            objective=Objective(
                "inverse" if any(c.objective.form == "inverse" for c in certificates) else "direct",
                any(c.objective.has_priors for c in certificates),
            ),
            path=worst.path,
            cost=sum(c.cost for c in certificates),
            lower_bound=sum(c.lower_bound for c in certificates),
            float_bound=sum(c.float_bound for c in certificates),
            min_eigenvalue=min(c.min_eigenvalue for c in certificates),
            tolerance=sum(c.tolerance for c in certificates),
            is_relative=worst.is_relative,
            seconds=dict(seconds),
            figures={"cost": worst.cost} | worst.figures | {"parts": float(len(certificates))},
        )
