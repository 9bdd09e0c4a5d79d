"""What became of the measurements of a log: what each stage used, and what it removed, with the reasons.

The logs that stages write hold these records, and so does the result file.
"""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pydantic import Field

from gtsam_rwhec.calibration.outliers import LeftOut, contradicted_frames
from gtsam_rwhec.calibration.sizes import is_size_doubted, is_size_uncertain
from gtsam_rwhec.problem.measurements import Pair
from gtsam_rwhec.results.file_record import Count, FileRecord, NotNegative, Positive
from gtsam_rwhec.results.removed_measurements import OF_THE_MOTION

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
