"""What became of the measurements of a log: what each stage used, and what it removed, with the reasons.

The logs that stages write hold these records, and so does the result file.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from gtsam_rwhec.calibration.outliers import LeftOut, contradicted_frames
from gtsam_rwhec.calibration.sizes import is_size_doubted, is_size_uncertain
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.file_record import Count, FileRecord, NotNegative, Positive


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


#: Seconds whose nanoseconds fit 64 bits; rig files have the same limit.
Seconds: TypeAlias = Annotated[float, Field(ge=-4e9, le=4e9)]


class _Count(FileRecord):
    """How many measurements of one target by one sensor were used."""

    target: str = Field(description="the target's name")
    sensor: str = Field(description="the sensor's name")
    used: Count = Field(description="measurements that went on to the next stage")

    @property
    def pair(self) -> Pair:
        """The pair that was counted."""
        return Pair(self.target, self.sensor)


class TrackCount(_Count):
    """How many measurements of a pair a stage used, and how many it removed for which reason."""

    removed: dict[str, Count] = Field(default={}, description="number of removed measurements, by reason")

    def __str__(self) -> str:
        name = self.pair.label if self.pair.is_motion else f"{self.target} in {self.sensor}"
        return f"{name}: {', '.join(f'{count} {why}' for why, count in self.removed.items())}"

    @property
    def seen(self) -> int:
        """Number of measurements, used and removed."""
        return self.used + sum(self.removed.values())


class OutlierCount(_Count):
    """How many measurements of a pair the answer uses, and how many were left out as outliers."""

    left_out: Count = Field(default=0, description="measurements that were left out as outliers")


class RegisteredPair(FileRecord):
    """Two clouds of a sensor that were registered with each other."""

    first: str = Field(description="name of a cloud")
    second: str = Field(description="name of the other")
    overlap: NotNegative = Field(description="share of the second cloud's points that lie on the first")
    off_mm: NotNegative = Field(description="how far the registration is from where the carriers' poses put it, mm")
    off_deg: NotNegative = Field(description="the same of its rotation, degrees")
    slides: Count = Field(description="number of directions, of six, along which the two slide on each other")


class ObjectReport(FileRecord):
    """What the registration of a sensor's clouds gave."""

    target: str = Field(description="the object's name")
    sensor: str = Field(description="the sensor's name")
    views: Count = Field(description="clouds with a pose of the carriers")
    used: Count = Field(description="clouds that were registered with others")
    noise_mm: NotNegative = Field(description="standard deviation of points of two clouds across the surface, mm")
    spacing_mm: Positive = Field(description="distance of neighbouring points after thinning, mm")
    alike_mm: NotNegative = Field(description="what all clouds are shifted by alike, one standard deviation, mm")
    alike_deg: NotNegative = Field(description="what they are turned by alike, about the object, degrees")
    by_groups: tuple[tuple[float, ...], ...] = Field(
        default=(),
        description="how errors that groups of clouds have together move the sensor, one standard deviation each: "
        "three turns, rad, and three shifts, m",
    )
    stretch_percent: float = Field(default=0.0, description="how much longer clouds are across their z axis, percent")
    stretch_sigma_percent: float | None = Field(default=None, description="its standard deviation; null: not told")
    registrations: tuple[RegisteredPair, ...] = Field(description="registrations of two clouds")
    remarks: tuple[str, ...] = Field(default=(), description="what is wrong with single clouds, in words")


class DetectionReport(FileRecord):
    """What the detection stage reports."""

    sources: tuple[str, ...] = Field(description="file names of the logs")
    images: dict[str, Count] = Field(description="number of images, or of a detection driver's messages, by sensor")
    undecoded: dict[str, tuple[str, ...]] = Field(description="images that could not be used, and why, by sensor")
    tracks: tuple[TrackCount, ...] = Field(description="detections of each target in each sensor")
    strangers: dict[str, Count] = Field(
        description="how often each tag that belongs to no target was seen, by family and id"
    )
    unseen: tuple[str, ...] = Field(default=(), description="targets that no sensor saw")
    likely: tuple[str, ...] = Field(
        default=(), description="why targets were not read where most were not: what some of the images show, and cures"
    )
    remarks: tuple[str, ...] = Field(default=(), description="what was found out about targets, in words")
    objects: tuple[ObjectReport, ...] = Field(default=(), description="registrations of the clouds of each sensor")
    blurred: tuple[str, ...] = Field(
        default=(), description="sensors with many images in which no target is read since they are blurred, in words"
    )
    corner_px: dict[str, NotNegative] = Field(
        description="measured standard deviation of a corner along each axis, pixels, by target/sensor"
    )


class CleaningReport(FileRecord):
    """What the cleaning stage reports."""

    tracks: tuple[TrackCount, ...] = Field(description="measurements of each target by each sensor")
    time_offsets_s: dict[str, Seconds] = Field(
        description="of each sensor, used to synchronise: as given, or found from rotations"
    )
    coarse_sigma_s: dict[str, NotNegative] = Field(
        description="standard deviations of the time offsets that were found from rotations"
    )


class SizeFields(FileRecord):
    """What the measurements say about a target's stated size."""

    target: str = Field(description="the target's name")
    stated_m: Positive = Field(description="the length in the rig file, metres")
    scale: Positive = Field(description="stated length / true length")
    sigma: NotNegative | None = Field(
        description="standard deviation of scale; null where the motion does not determine it"
    )
    is_free: bool = Field(description="true: the size was estimated, as it does not fit the motion, or on request")

    @property
    def percent_too_large(self) -> float:
        """By how much the stated size exceeds the true size, percent; negative where it is too small."""
        return 100.0 * (self.scale - 1.0)

    @property
    def is_doubted(self) -> bool:
        """Whether the measurements contradict the stated size clearly, and by a share that matters."""
        return is_size_doubted(self.scale, self.sigma)

    @property
    def is_uncertain(self) -> bool:
        """Whether the measurements speak against the stated size, though not clearly."""
        return is_size_uncertain(self.scale, self.sigma)


class TimeOffsetFields(FileRecord):
    """The time offset of a sensor's clock."""

    sensor: str = Field(description="the sensor's name")
    offset_s: Seconds = Field(description="the sensor's stamp t is the carriers' t + offset")
    sigma_s: NotNegative | None = Field(
        description="standard deviation; null where the offset was given, or the motion does not determine it"
    )


class LogFields(FileRecord):
    """Where a calibration's measurements came from, and what became of them."""

    sensor_carrier: str = Field(description="name of the frame that carries the sensors")
    target_carrier: str = Field(description="name of the frame that carries the targets")
    detection: DetectionReport = Field(description="what the detection stage reported")
    cleaning: CleaningReport = Field(description="what the cleaning stage reported")
    outliers: tuple[OutlierCount, ...] = Field(description="measurements in the answer, and outliers, of each pair")
    sizes: tuple[SizeFields, ...] = Field(description="what the measurements say about the stated sizes")
    time_offsets: tuple[TimeOffsetFields, ...] = Field(description="time offset of every sensor that was used")

    @property
    def contradicted(self) -> tuple[LeftOut, ...]:
        """The sensors and targets of which most, or of many nearly half, of the measurements were left out.

        Their poses are not to be used.
        """
        return contradicted_frames(self.agreement)

    @property
    def agreement(self) -> dict[Pair, tuple[int, int]]:
        """By pair: measurements in the answer, and these with all that contradict it, in cleaning or as outliers."""
        off = {track.pair: sum(track.removed.get(why, 0) for why in OF_THE_MOTION) for track in self.cleaning.tracks}
        every = {count.pair: count.used + count.left_out + off.get(count.pair, 0) for count in self.outliers}
        return {count.pair: (count.used, every[count.pair]) for count in self.outliers}
