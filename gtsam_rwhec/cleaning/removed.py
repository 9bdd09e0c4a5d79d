"""Which measurements a step of cleaning keeps, and why each of the others is removed."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum

import numpy as np


class RemovalReason(StrEnum):
    """Why a measurement is not used; the values are the words in logs and reports, with the unit of `Removed.value`."""

    SEEN_TWICE = "seen twice at one stamp"
    OUTSIDE_TRAJECTORY = "outside the carrier's trajectory (s)"
    GAP = "gap in the carrier's poses (s)"
    TURNING_FAST = "turning fast (rad/s)"
    MOVING_FAST = "moving fast (m/s)"
    STANDSTILL = "standstill (m moved)"
    SINGLE = "a single measurement of the pair"
    NO_CONSENSUS = "the pair has no consensus (share that agrees)"
    ROTATION_OFF = "rotation off the pair's consensus (rad)"
    TRANSLATION_OFF = "translation off the pair's consensus (m)"
    OUTLIER = "outlier (robust estimation)"
    STAMPS_APART = "stamps apart (s)"
    FIRST_SENSOR_STEP_M = "step of the first sensor (m)"
    FIRST_SENSOR_STEP_RAD = "step of the first sensor (rad)"
    SECOND_SENSOR_STEP_M = "step of the second sensor (m)"
    SECOND_SENSOR_STEP_RAD = "step of the second sensor (rad)"


@dataclass(frozen=True)
class Removed:
    """One measurement that was taken out.

    Attributes
    ----------
    reason : RemovalReason
    index : int
        In the step's input.
    stamp_ns : int
    value, limit : float
        What was compared, and with what; in the unit that `reason` names.
    """

    reason: RemovalReason
    index: int
    stamp_ns: int
    value: float
    limit: float


@dataclass(frozen=True)
class Kept:
    """The result of a step: mask (N,) of what is kept, and the rest in order of index."""

    mask: np.ndarray
    removed: tuple[Removed, ...]

    @property
    def counts(self) -> dict[str, int]:
        """How many were removed for each reason."""
        return dict(Counter(item.reason for item in self.removed))

    @staticmethod
    def of(bad: np.ndarray, reason: RemovalReason, stamps_ns: np.ndarray, values: np.ndarray, limit: float) -> Kept:
        """Keep all but those marked ``bad`` (N,)."""
        return Kept(
            ~bad,
            tuple(
                Removed(reason, int(i), int(stamps_ns[i]), float(values[i]), float(limit)) for i in np.flatnonzero(bad)
            ),
        )

    def and_of(
        self, bad: np.ndarray, reason: RemovalReason, stamps_ns: np.ndarray, values: np.ndarray, limit: float
    ) -> Kept:
        """Keep what is kept so far, but those marked ``bad`` (N,); each is removed for one reason, the first."""
        more = Kept.of(bad & self.mask, reason, stamps_ns, values, limit)
        return Kept(self.mask & more.mask, tuple(sorted(self.removed + more.removed, key=lambda item: item.index)))
