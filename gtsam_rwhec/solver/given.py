"""What the user gave for one part, as it was given: raw measurements, fixed frames and priors, about no gauge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.knowledge import Prior
from gtsam_rwhec.problem.measurements import Measurements, Section
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem
from gtsam_rwhec.problem.segmented_moments import Sorted

#: Pairs with more measurements are evaluated one by one.
SMALL = 256


@dataclass(frozen=True)
class Shared:
    """Measurements of many pairs, and which pair of the part each of them is (P,): -1 for none."""

    many: Sorted
    pair: np.ndarray

    def of(self, begin: int, end: int) -> Shared | None:
        """Those of the part's pairs from ``begin`` up to ``end``, counted from ``begin``; None where there are none."""
        inside = (self.pair >= begin) & (self.pair < end)
        return Shared(self.many, np.where(inside, self.pair - begin, -1)) if inside.any() else None


@dataclass(frozen=True)
class Given:
    """Raw measurements by the index of their pair, fixed poses (4, 4) and priors, about the user's own origin."""

    batches: list[tuple[int, Measurements]]  #: in ascending order of the pairs
    shared: list[Shared]  #: of pairs that were added many at once
    fixed: dict[str, Array]
    priors: dict[str, list[Prior]]

    @staticmethod
    def of(problem: Problem, pairs: tuple[Pair, ...], names: frozenset[str]) -> Given | None:
        """What a problem holds of the pairs and frames; None where its raw measurements were not kept."""
        if not problem.has_measurements:
            return None
        batches: list[tuple[int, Measurements]] = []
        shared: dict[int, Shared] = {}
        for e, pair in enumerate(pairs):
            for batch in problem.stored(pair):
                if not isinstance(batch, Section):
                    batches.append((e, batch))
                elif batch.count > SMALL:
                    batches.append((e, batch.measurements))
                else:
                    many = batch.many
                    if id(many) not in shared:
                        shared[id(many)] = Shared(many, np.full(len(many.pairs), -1))
                    shared[id(many)].pair[batch.index] = e
        return Given(
            batches,
            list(shared.values()),
            {name: T for name, T in problem.fixed.items() if name in names},
            {name: priors for name, priors in problem.priors.items() if name in names},
        )
