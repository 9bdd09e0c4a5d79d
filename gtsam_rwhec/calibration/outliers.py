"""The measurements that a calibration left out, as a record."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.problem.pairs import Pair

#: A sentence about outliers names at most this many pairs.
NAMED = 5


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

    @property
    def number(self) -> int:
        """How many measurements were left out."""
        return sum(total - kept for kept, total in self.counts.values())

    def __str__(self) -> str:
        total = sum(number for _, number in self.counts.values())
        if not self.looked_for:
            return f"Outliers were not looked for among {total} measurements."
        out = {pair: (number - kept, number) for pair, (kept, number) in self.counts.items() if kept < number}
        if not out:
            return f"No outliers among {total} measurements."
        most = sorted(out.items(), key=lambda item: -item[1][0])[:NAMED]
        named = [f"{number} of {of} of {pair}" for pair, (number, of) in most]
        more = f", and some of {len(out) - NAMED} other pairs" if len(out) > NAMED else ""
        said = f"{self.number} of {total} measurements contradict the others and were left out"
        return f"{said}: {', '.join(named)}{more}."
