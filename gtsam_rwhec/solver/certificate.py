"""The certificate of an answer: its cost, the lower bound, and what the two prove."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum
from math import fsum

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.cause import Cause, SearchPath, Status
from gtsam_rwhec.solver.parts import Kind, Part
from gtsam_rwhec.solver.region import Region


class Basis(StrEnum):
    """What the cost and the bound are true of; from the strongest claim to the weakest."""

    #: The measurements as they were given, in double precision; all rounding is enclosed.
    MEASUREMENTS = "measurements"
    #: Their moments as they are stored, as the measurements were not kept: the rounding of the sums is not enclosed.
    MOMENTS = "moments"
    #: The reduced form as it was stored: read from a result file of format version 4 or older.
    REDUCED_FORM = "reduced_form"


@dataclass(frozen=True)
class Objective:
    """Which cost a certificate is about.

    Attributes
    ----------
    form : "direct" or "inverse"
        "direct" is the cost of A X = Y B (eq. 18). "inverse" is the cost of B X^-1 = Y^-1 A. A scale for each target
        needs it, and so do priors on translations with an unknown scale (design facts 7 and 11). The inverse cost is
        not half a chi-square; ``refine`` finds the optimum of the exact model from its answer. Of several unconnected
        parts it is "inverse" if any part's is.
    has_priors : bool
        Whether the cost has terms for priors.
    origin_m : (x, y, z) or None
        The inverse cost depends on the target carrier's origin: there the rotation residual acts on the lever arm
        t_X. It is taken about this point of the target carrier's frame, in metres: A becomes A T(origin_m) and X
        becomes T(-origin_m) X. None for the direct cost, which no origin changes, in files of format version 4 and
        older, and where unconnected parts have different ones: each part's own is in ``Solution.parts``.
    motion_origin_m : (x, y, z) or None
        The same for the motions of a sensor, in its carrier's frame.
    """

    form: Kind
    has_priors: bool
    origin_m: tuple[float, float, float] | None = None
    motion_origin_m: tuple[float, float, float] | None = None

    @staticmethod
    def of(part: Part) -> Objective:
        """The cost of a part."""
        if part.kind == "direct":
            return Objective(part.kind, bool(part.priors))
        has_motions = bool(part.moments.motion.any())
        return Objective(
            part.kind,
            bool(part.priors),
            _triple(part.gauge.target_carrier),
            _triple(part.gauge.sensor_carrier) if has_motions else None,
        )

    @staticmethod
    def merged(objectives: list[Objective]) -> Objective:
        """That of several parts: an origin only where they share it."""
        origins, of_motions = {o.origin_m for o in objectives}, {o.motion_origin_m for o in objectives}
        return Objective(
            "inverse" if any(o.form == "inverse" for o in objectives) else "direct",
            any(o.has_priors for o in objectives),
            origins.pop() if len(origins) == 1 else None,
            of_motions.pop() if len(of_motions) == 1 else None,
        )

    def __str__(self) -> str:
        about = ""
        if self.origin_m is not None:
            about = f", about the point ({', '.join(f'{x:.6g}' for x in self.origin_m)}) m of the target carrier"
        return _OBJECTIVES[self.form] + about + (", and the priors" if self.has_priors else "")


def _triple(v: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in v)
    return x, y, z


_OF = {Basis.MEASUREMENTS: "", Basis.MOMENTS: " (of the moments)", Basis.REDUCED_FORM: " (of the stored form)"}
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
        The cost of ``objective`` at the answer as it is returned. The exact value is at most this, for what ``basis``
        names. In the direct form it is half a chi-square when the weights are true.
    lower_bound : float
        No answer (of the region) costs less in exact arithmetic. Rotations may be off by the rounding of doubles.
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
    basis : Basis
        Whether cost and bound are true of the measurements as they were given, of their stored moments, or of the
        reduced form of an older file.
    region : Region or None
        The answers that the lower bound is about; None: all answers. It is named where the measurements leave a
        translation or a scale free up to the rounding of their doubles. What is free up to noise only needs none, so
        an answer that is not unique may have none.
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
    # Result files before format version 5 do not have these two.
    basis: Basis = Basis.REDUCED_FORM
    region: Region | None = None

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
            f"{self.status}: cost {self.cost:.8g}{unit}, no answer below {self.lower_bound:.8g}{_OF[self.basis]}, "
            f"relative gap {self.relative_gap:.1e}; {self.reason}" + (f"; {self.region}" if self.region else "")
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
            seconds=dict(seconds),
            figures={"cost": worst.cost} | worst.figures | {"parts": float(len(certificates))},
        )
