"""What every stage of cleaning returns: what is kept, and each thing that is not, with its reason."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Removed:
    """One measurement that was taken out.

    Attributes
    ----------
    reason : str
        A few words, the same for all of one kind: they are counted by it.
    index : int
        In the stage's input.
    stamp_ns : int
    value, limit : float
        What was compared, and with what; in the unit that ``reason`` names.
    """

    reason: str
    index: int
    stamp_ns: int
    value: float
    limit: float


@dataclass(frozen=True)
class Kept:
    """A stage's result: mask (N,) of what is kept, and the rest by reason."""

    mask: np.ndarray
    removed: tuple[Removed, ...]

    @property
    def counts(self) -> dict[str, int]:
        """How many were removed for each reason."""
        return dict(Counter(item.reason for item in self.removed))

    @staticmethod
    def of(bad: np.ndarray, reason: str, stamps_ns: np.ndarray, values: np.ndarray, limit: float) -> Kept:
        """Keep all but those marked ``bad`` (N,)."""
        return Kept(
            ~bad,
            tuple(
                Removed(reason, int(i), int(stamps_ns[i]), float(values[i]), float(limit)) for i in np.flatnonzero(bad)
            ),
        )
