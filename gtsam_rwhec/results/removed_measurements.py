"""The result of a step of cleaning: the measurements that it keeps, and why it removed the others."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike


class RemovalReason(StrEnum):
    """Why a measurement is not used. Logs and reports print these words; the unit is the unit of `Removed.value`."""

    SEEN_TWICE = "seen twice at one stamp"
    OUTSIDE_TRAJECTORY = "outside the carrier's trajectory (s)"
    GAP = "gap in the carrier's poses (s)"
    TURNING_FAST = "turning fast (rad/s)"
    MOVING_FAST = "moving fast (m/s)"
    STANDSTILL = "standstill (m moved)"
    CLOCK_UNKNOWN = "the sensor's clock is not known"
    SINGLE = "a single measurement of the pair"
    NO_CONSENSUS = "the pair has no consensus (share that agrees)"
    ROTATION_OFF = "rotation off the pair's consensus (rad)"
    TRANSLATION_OFF = "translation off the pair's consensus (m)"
    ODOMETRY_GAP = "gap in the odometry"
    ODOMETRY_STEP = "step of the odometry that nothing drives (lost tracking)"
    OUTLIER = "outlier (robust estimation)"
    FIRST_SENSOR_STEP_M = "step of the first sensor (m)"
    FIRST_SENSOR_STEP_RAD = "step of the first sensor (rad)"


#: Reasons for which cleaning removes a measurement that does not agree with the carriers' motion.
OF_THE_MOTION = (RemovalReason.NO_CONSENSUS, RemovalReason.ROTATION_OFF, RemovalReason.TRANSLATION_OFF)


@dataclass(frozen=True)
class Removed:
    """One measurement that a step removed."""

    reason: RemovalReason  #: Why the step removed it
    index: int  #: Row of the measurement in the step's input
    stamp_ns: int  #: Stamp of the measurement, nanoseconds
    #: The value that was compared, and its limit, in the unit that `reason` names
    value: float
    limit: float


@dataclass(frozen=True)
class Kept:
    """The result of a step: a mask (N,) of the measurements that it keeps, and the removed ones in order of index."""

    mask: np.ndarray
    removed: tuple[Removed, ...]

    @property
    def counts(self) -> dict[str, int]:
        """How many measurements were removed for each reason."""
        return dict(Counter(item.reason for item in self.removed))

    @staticmethod
    def of(bad: np.ndarray, reason: RemovalReason, stamps_ns: np.ndarray, values: np.ndarray, limit: ArrayLike) -> Kept:
        """Keep all measurements but the ``bad`` ones (N,); `limit` is one number or one for each measurement."""
        limits = np.broadcast_to(np.asarray(limit, dtype=float), bad.shape)
        return Kept(
            ~bad,
            tuple(
                Removed(reason, i, int(stamps_ns[i]), float(values[i]), float(limits[i]))
                for i in np.flatnonzero(bad).tolist()
            ),
        )

    @staticmethod
    def by_all(*steps: Kept) -> Kept:
        """Keep what every step keeps; a measurement has the reason of the first step that removes it."""
        first = {item.index: item for step in reversed(steps) for item in step.removed}
        return Kept(np.logical_and.reduce([step.mask for step in steps]), tuple(first[i] for i in sorted(first)))

    @staticmethod
    def within(stamps_ns: np.ndarray, *checks: tuple[RemovalReason, np.ndarray, float]) -> Kept:
        """Keep the measurements whose values (N,) are at most the limit of each check; see `by_all`."""
        return Kept.by_all(*(Kept.of(values > limit, why, stamps_ns, values, limit) for why, values, limit in checks))
