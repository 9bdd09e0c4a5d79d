"""What the user gave for one part, as it was given: raw measurements, fixed frames and priors, about no gauge."""

from __future__ import annotations

from dataclasses import dataclass

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import Prior
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem


@dataclass(frozen=True)
class Given:
    """Raw measurements by the index of their pair, fixed poses (4, 4) and priors, about the user's own origin."""

    batches: list[tuple[int, Measurements]]
    fixed: dict[str, Array]
    priors: dict[str, list[Prior]]

    @staticmethod
    def of(problem: Problem, pairs: tuple[Pair, ...], names: frozenset[str]) -> Given | None:
        """What a problem holds of the pairs and frames; None where its raw measurements were not kept."""
        if not problem.has_measurements:
            return None
        return Given(
            [(e, batch) for e, pair in enumerate(pairs) for batch in problem.batches(*pair)],
            {name: T for name, T in problem.fixed.items() if name in names},
            {name: priors for name, priors in problem.priors.items() if name in names},
        )
