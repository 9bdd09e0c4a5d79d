"""A sample of a problem's measurements, small enough that many readings of it can be tried."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from gtsam_rwhec.calibration.readings import Reading
from gtsam_rwhec.calibration.trial_fits import angles
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.problem.measurements import Measurements
from gtsam_rwhec.problem.pairs import Pair
from gtsam_rwhec.problem.problem import Problem

#: At most so many measurements of a pair, from all over its rows.
MOST_OF_A_PAIR = 200
#: At most so many pairs: those that join the frames with the most measurements.
MOST_PAIRS = 24
#: At most so many measurements in all.
MOST_IN_ALL = 2000
#: About so many blocks of neighbouring rows are compared.
BLOCKS = 24
#: A row turns by at most this share of what rows far apart differ by, where carriers move slowly.
SLOW_SHARE = 0.3
#: A pair with fewer measurements is not sampled where others have more: it says little, and has its own unknowns.
FEWEST_OF_A_PAIR = 4


@dataclass(frozen=True)
class Sampled:
    """The raw measurements of some pairs, and which rows of each are looked at."""

    whole: dict[Pair, Measurements]
    rows: dict[Pair, np.ndarray]

    @staticmethod
    def of(problem: Problem, most_pairs: int = MOST_PAIRS, most_in_all: int = MOST_IN_ALL) -> Sampled | None:
        """A sample of a problem; None where it kept no measurements."""
        if not problem.has_measurements:
            return None
        pairs = _pairs(problem, most_pairs)
        most = max(min(MOST_OF_A_PAIR, most_in_all // len(pairs)), FEWEST_OF_A_PAIR)
        whole = {pair: problem.measurements(*pair) for pair in pairs}
        rows = {pair: np.unique(np.linspace(0, len(raw.A) - 1, most).astype(int)) for pair, raw in whole.items()}
        return Sampled(whole, rows)

    @property
    def count(self) -> int:
        """The number of measurements."""
        return sum(map(len, self.rows.values()))

    @property
    def unknown_poses(self) -> int:
        """The number of frames."""
        return len({name for pair in self.rows for name in pair.frames})

    def as_read(self) -> dict[Pair, tuple[Array, Array]]:
        """A and B as they are."""
        return {pair: (raw.A[self.rows[pair]], raw.B[self.rows[pair]]) for pair, raw in self.whole.items()}

    @property
    def has_clock(self) -> bool:
        """Whether every pair has stamps, and moves slowly from one row to the next: then rows tell a clock's offset.

        A shift of such rows and an offset of the clock are one thing, and the offset is estimated.
        """
        for raw in self.whole.values():
            if raw.stamps_ns is None or len(raw.A) < 3:
                return False
            R = raw.A[np.argsort(raw.stamps_ns), :3, :3]
            apart = len(R) // 2
            if np.median(angles(R[1:], R[:-1])) > SLOW_SHARE * np.median(angles(R[apart:], R[: len(R) - apart])):
                return False
        return True

    @property
    def all_poses(self) -> tuple[Array, Array]:
        """A and B (N, 4, 4) of all pairs, as they are."""
        A, B = (np.concatenate(poses) for poses in zip(*self.as_read().values(), strict=True))
        return A, B

    @property
    def median_lengths(self) -> tuple[float, float]:
        """Median lengths of A's translations about their own median, and of B's."""
        A, B = (poses[:, :3, 3] for poses in self.all_poses)
        centred = A - np.median(A, axis=0)
        return float(np.median(np.linalg.norm(centred, axis=1))), float(np.median(np.linalg.norm(B, axis=1)))

    def by(self, reading: Reading) -> dict[Pair, tuple[Array, Array]]:
        """A and B by another reading. Motions have one frame, and their rows belong together: no roles, no shift."""
        found = {}
        for pair, raw in self.whole.items():
            rows, shift = self.rows[pair][self._remains(pair, reading)], 0 if pair.is_motion else reading.shift
            if len(rows):
                found[reading.pair(pair)] = reading.changed(raw.A[rows], raw.B[rows + shift])
        return found

    def remains(self, reading: Reading) -> np.ndarray:
        """Which measurements of ``as_read`` the reading has too, pair after pair: a shift leaves some out."""
        return np.concatenate([self._remains(pair, reading) for pair in self.rows])

    def _remains(self, pair: Pair, reading: Reading) -> np.ndarray:
        shifted = self.rows[pair] + (0 if pair.is_motion else reading.shift)
        return (shifted >= 0) & (shifted < len(self.whole[pair].B))

    def blocks(self) -> np.ndarray:
        """A block number of each measurement: blocks are contiguous rows of a pair, since neighbours share errors."""
        of_a_pair = -(-BLOCKS // len(self.rows))
        numbers, first = [], 0
        for rows in self.rows.values():
            many = min(of_a_pair, len(rows))
            numbers.append(first + np.arange(len(rows)) * many // len(rows))
            first += many
        return np.concatenate(numbers)


def _pairs(problem: Problem, most: int) -> list[Pair]:
    """The pairs with the most measurements, each joined to those before it where there is such a pair."""
    counts = {pair: problem.moments(*pair).count for pair in problem.pairs}
    by_frame: dict[str, set[Pair]] = defaultdict(set)
    for pair in counts:
        for name in pair:
            by_frame[name].add(pair)
    enough = [pair for pair, count in counts.items() if count >= FEWEST_OF_A_PAIR] or list(counts)
    left = sorted(enough, key=lambda pair: -counts[pair])
    chosen: list[Pair] = []
    names: set[str] = set()
    while left and len(chosen) < most:
        # A pair that closes a loop tells more than one with a frame of its own.
        best = max(left, key=lambda pair: (sum(name in names for name in pair), counts[pair]))
        chosen.append(best)
        names.update(best)
        left.remove(best)
    return chosen
