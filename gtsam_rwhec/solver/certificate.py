"""What is proven about an answer."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum


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


@dataclass(frozen=True)
class Certificate:
    """A proof, or how far from one.

    Attributes
    ----------
    status : Status
    reason : str
        Why there is no certificate, or what the certificate needed, in words.
    objective : str
        Which cost it is about, in words.
    path : str
        What gave it: "dual" (the multipliers of R'R = I at a critical point), "small dual" (those of all 20
        independent constraints), each possibly after "better start" or "relaxation".
    cost : float
        J at the answer (eq. 18; half a chi-square when the weights are true).
    lower_bound : float
        No answer costs less: rigorous in floating point, for the reduced form as stored.
    float_bound : float
        The same without the allowance for rounding.
    min_eigenvalue : float
        A lower bound on the smallest eigenvalue of the certificate matrix Z (0 in exact arithmetic when certified).
    tolerance : float
        The absolute gap up to which the status says certified.
    is_relative : bool
        Whether unit weights were used: the cost then has no statistical meaning.
    seconds : dict of str to float
        Time of each stage.
    """

    status: Status
    reason: str
    objective: str
    path: str
    cost: float
    lower_bound: float
    float_bound: float
    min_eigenvalue: float
    tolerance: float
    is_relative: bool
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def is_certified(self) -> bool:
        """Whether the answer is proven optimal and determined by the measurements."""
        return self.status is Status.CERTIFIED

    @property
    def is_optimal(self) -> bool:
        """Whether the cost is proven optimal, whether or not the answer is the only one."""
        return self.status in (Status.CERTIFIED, Status.CERTIFIED_NOT_UNIQUE)

    @property
    def gap(self) -> float:
        """Cost minus lower bound, at least 0."""
        return max(0.0, self.cost - self.lower_bound)

    @property
    def relative_gap(self) -> float:
        """The gap over the cost; 0 / 0, which exact data give, counts as the gap over the tolerance's scale."""
        return self.gap / max(abs(self.cost), 1e6 * self.tolerance, 1e-300) if self._tiny else self.gap / self.cost

    @property
    def float_gap(self) -> float:
        """The relative gap without the allowance for rounding."""
        gap = max(0.0, self.cost - self.float_bound)
        return gap / max(abs(self.cost), 1e6 * self.tolerance, 1e-300) if self._tiny else gap / self.cost

    @property
    def _tiny(self) -> bool:
        return self.cost <= self.tolerance

    def __str__(self) -> str:
        unit = " (unit weights: relative)" if self.is_relative else ""
        return (
            f"{self.status}: cost {self.cost:.8g}{unit}, no answer below {self.lower_bound:.8g}, "
            f"relative gap {self.relative_gap:.1e}; {self.reason}"
        )


OBJECTIVES = {
    "direct": "Problem 3: half the squared residuals of A X = Y B, R_A t_X + alpha t_A - t_Y - R_Y t_B over sigma and "
    "R_A R_X - R_Y R_B times the square root of kappa",
    "inverse": "the equation turned round: half the squared residuals of B X^-1 = Y^-1 A, with each t_B divided by "
    "its scale (refine for the exact per-target model)",
}


def combined(certificates: list[Certificate]) -> Certificate:
    """One certificate for parts that were solved apart: costs and bounds add, the worst status counts."""
    if len(certificates) == 1:
        return certificates[0]
    order = list(Status)
    worst = max(certificates, key=lambda c: order.index(c.status))
    seconds: dict[str, float] = {}
    for certificate in certificates:
        for stage, duration in certificate.seconds.items():
            seconds[stage] = seconds.get(stage, 0.0) + duration
    return Certificate(
        status=worst.status,
        reason=f"{len(certificates)} unconnected parts, solved apart; {worst.reason}",
        objective=worst.objective,
        path=", ".join(dict.fromkeys(c.path for c in certificates)),
        cost=sum(c.cost for c in certificates),
        lower_bound=sum(c.lower_bound for c in certificates),
        float_bound=sum(c.float_bound for c in certificates),
        min_eigenvalue=min(c.min_eigenvalue for c in certificates),
        tolerance=sum(c.tolerance for c in certificates),
        is_relative=worst.is_relative,
        seconds=seconds,
    )
