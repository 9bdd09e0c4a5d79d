"""One part, what is known of it, and what a search of it has found."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.solver.bound import Bound
from gtsam_rwhec.solver.cause import Cause, SearchPath
from gtsam_rwhec.solver.descent import SearchForm
from gtsam_rwhec.solver.options import SolveOptions
from gtsam_rwhec.solver.part_form import PartForm
from gtsam_rwhec.solver.parts import Part
from gtsam_rwhec.solver.rotations import random_rotations
from gtsam_rwhec.solver.stages import Stages
from gtsam_rwhec.solver.variables import Answer

#: With unit weights and exact data, costs below this part of the form's magnitude are the rounding of the measurements.
OF_MEASUREMENTS = 1e-30
#: The same part of what a far origin adds: poses about it are rounded to 1.1e-16 of their distance.
OF_ORIGIN = 1e-31
#: The same where only moments are known, whose sums are rounded.
OF_MOMENTS = 1e-13


@dataclass(frozen=True)
class Found:
    """The best answer of a part and the best bound on the cost of any answer."""

    answer: Answer  #: about the part's gauge
    R: Array  #: (n, 3, 3), its rotations in the order of ``part.free``, as the form has them
    cost: float  #: J at the answer, rounded up
    bound: Bound  #: its ``lower_bound`` is at most the exact cost of the answer
    tolerance: float  #: the absolute gap up to which the answer counts as proven optimal
    is_known: bool  #: whether the moments, where measurements were not kept, tell the cost
    path: SearchPath
    cause: Cause
    figures: dict[str, float] = field(default_factory=dict)  #: numbers in the cause's sentence, by name

    @property
    def is_closed(self) -> bool:
        """Whether the gap is within the tolerance: the answer is proven optimal."""
        return self.cost - self.bound.lower_bound <= self.tolerance and self.is_known


@dataclass(frozen=True)
class SearchedPart:
    """A part that is searched: its cost, and the times of the stages.

    A bound that holds in a region only has the answer ``contains``, if there is one, in its region.
    """

    part: Part
    options: SolveOptions
    stages: Stages
    whole: PartForm
    contains: Answer | None = None

    @property
    def form(self) -> SearchForm:
        """Q'."""
        return self.whole.form

    @property
    def is_large(self) -> bool:
        """Whether small dual and relaxation are too large for all frames at once: then a few frames have theirs."""
        return self.form.rotations > self.options.max_dense_frames

    def tolerance(self, cost: float) -> float:
        """The absolute gap that counts as zero (design fact 10).

        With unit weights a cost of 1 has no meaning, and with exact data the cost is zero but for the rounding of the
        measurements and of the answer, which grows with the distance of the world's origin. Of moments alone, no more
        than the rounding of the form's entries is known.
        """
        if not self.part.is_relative:
            return self.options.relative_tolerance * max(cost, 1.0)
        zero = OF_MOMENTS if self.part.given is None else OF_MEASUREMENTS
        # At rest a motion's equation cancels in the form, and its terms are of the size of kappa.
        magnitude = max(self.form.magnitude, float(self.part.moments.kappa.sum()))
        floor = zero * self.form.size * magnitude + OF_ORIGIN * self._of_origin + 1e-250
        return max(self.options.relative_tolerance * cost, floor)

    @property
    def _of_origin(self) -> float:
        """The part of the form that the gauge took off, sum (|a|^2 + |c|^2) / sigma^2, in which poses are rounded."""
        gauge = self.part.gauge
        squares = float((gauge.sensor_carrier**2).sum() + (gauge.target_carrier**2).sum())
        return float(self.part.moments.weight.sum()) * squares

    @property
    def rounding(self) -> float:
        """What rounding can change in x'Q'x: smaller differences between descents mean nothing."""
        return 1e-15 * self.form.size * self.form.magnitude + 1e-250

    def random_starts(self, count: int) -> list[Array]:
        """Random rotations (n, 3, 3); the same ones in each call."""
        generator = np.random.default_rng(self.options.seed)
        return [random_rotations(self.form.rotations, generator) for _ in range(count)]
