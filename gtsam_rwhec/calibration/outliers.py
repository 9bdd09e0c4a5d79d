"""The measurements that a calibration left out, as a record."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.calibration.choices import OUTLIERS, Choice
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem

#: A sentence about outliers names at most this many pairs.
NAMED = 5
#: Of fewer measurements of one frame, a wrong one cannot be told.
FEWEST_OF_A_FRAME = 3


@dataclass(frozen=True)
class Outliers:
    """The measurements that were left out because they contradict the others.

    Attributes
    ----------
    inliers : dict of (target, sensor) to (N,) booleans
        The measurements that were kept, in the order of ``problem.measurements``; empty if none were looked for.
    counts : dict of (target, sensor) to (int, int)
        The number kept, and the number of all.
    left_out : tuple of str
        Sensors and targets that have no measurement left, and so no pose.
    looked_for : bool
        Whether outliers were looked for.
    """

    inliers: dict[Pair, np.ndarray]
    counts: dict[Pair, tuple[int, int]]
    left_out: tuple[str, ...]
    looked_for: bool

    @staticmethod
    def of(problem: Problem, inliers: dict[Pair, np.ndarray]) -> Outliers:
        """The outliers of a problem; without ``inliers`` they were not looked for, and every measurement counts."""
        totals = {pair: problem.moments(*pair).count for pair in problem.pairs}
        counts = {pair: (int(inliers[pair].sum()) if inliers else total, total) for pair, total in totals.items()}
        left = {name for pair, (kept, _) in counts.items() if kept for name in pair}
        left_out = tuple(name for name in (*problem.sensors, *problem.targets) if name not in left)
        return Outliers(inliers, counts, left_out, looked_for=bool(inliers))

    @property
    def resting_on_few(self) -> dict[str, int]:
        """The sensors and targets that rest on fewer than three measurements in all, and on how many."""
        kept = Counter[str]()
        for pair, (number, _) in self.counts.items():
            for name in pair.frames:
                kept[name] += number
        return {name: number for name, number in kept.items() if 0 < number < FEWEST_OF_A_FRAME}

    @property
    def number(self) -> int:
        """How many measurements were left out."""
        return sum(total - kept for kept, total in self.counts.values())

    def __str__(self) -> str:
        total = sum(number for _, number in self.counts.values())
        if not self.looked_for:
            return f"Outliers were not looked for among {total} measurements."
        if not self.number:
            return f"No outliers among {total} measurements."
        return f"{self.number} of {total} measurements contradict the others and were left out: {self.by_pair}."

    @property
    def by_pair(self) -> str:
        """How many of which pair were left out, the most first."""
        out = {pair: (number - kept, number) for pair, (kept, number) in self.counts.items() if kept < number}
        most = sorted(out.items(), key=lambda item: -item[1][0])[:NAMED]
        named = [f"{number} of {of} of {pair}" for pair, (number, of) in most]
        more = f", and some of {len(out) - NAMED} other pairs" if len(out) > NAMED else ""
        return f"{', '.join(named)}{more}"

    def choice(self, evidence: str) -> Choice:
        """What was chosen where outliers were looked for; ``evidence`` is why some were left out."""
        if not self.number:
            return Choice(OUTLIERS, "none", "every measurement agrees with the others")
        total = sum(number for _, number in self.counts.values())
        return Choice(OUTLIERS, f"{self.number} of {total} measurements were left out ({self.by_pair})", evidence)


def few_words(frame: str, number: int) -> str:
    """What is said of a frame that rests on so few measurements."""
    if number == 1:
        return f"{frame} rests on 1 measurement: a wrong one would not show"
    return f"{frame} rests on {number} measurements: a wrong one could not be told from the other"
