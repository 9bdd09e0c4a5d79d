"""What each stage from a log to a calibration reports: how much it used, and what it did not, with the reasons.

Kept in the logs that stages write, and in the result file.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, TypeAlias

from pydantic import BaseModel, ConfigDict, Field

from gtsam_rwhec.problem.pairs import Pair

#: A stated size is doubted when it is off by this many standard deviations, and by this share: printers, calipers and
#: intrinsics are seldom better.
SIZE_SIGMAS, SIZE_SHARE = 5.0, 0.004
#: Beyond, nanoseconds do not fit 64 bits; rig files have the same limit.
Seconds: TypeAlias = Annotated[float, Field(ge=-4e9, le=4e9)]


class _Report(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class TrackCount(_Report):
    """One target in one sensor: how many measurements go on, and how many were removed for which reason."""

    target: str = Field(description="the target's name")
    sensor: str = Field(description="the sensor's name")
    used: int = Field(description="measurements that went on")
    removed: dict[str, int] = Field(default={}, description="those that did not, by reason")

    def __str__(self) -> str:
        return f"{self.target} in {self.sensor}: {', '.join(f'{count} {why}' for why, count in self.removed.items())}"

    @property
    def pair(self) -> Pair:
        """Of whom it is."""
        return Pair(self.target, self.sensor)


class DetectionReport(_Report):
    """Of the detection stage."""

    sources: tuple[str, ...] = Field(description="file names of the logs")
    images: dict[str, int] = Field(description="images, or messages of a detection driver, by sensor")
    undecoded: dict[str, tuple[str, ...]] = Field(description="images that could not be used, and why, by sensor")
    tracks: tuple[TrackCount, ...] = Field(description="detections of each target in each sensor")
    strangers: dict[str, int] = Field(description="tags that are no target, family and id: how often they were seen")
    unseen: tuple[str, ...] = Field(default=(), description="targets that no sensor saw")
    corner_px: dict[str, float] = Field(
        description="standard deviation of a corner along each axis, pixels, by target/sensor, as measured"
    )


class CleaningReport(_Report):
    """Of the cleaning stage."""

    tracks: tuple[TrackCount, ...] = Field(description="measurements of each target by each sensor")
    time_offsets_s: dict[str, Seconds] = Field(
        description="by sensor, with which the carriers' poses were taken: as given, or from turning rates"
    )
    coarse_sigma_s: dict[str, float] = Field(description="standard deviations of those from turning rates")


class SizeFields(_Report):
    """What the measurements say of a target's stated size."""

    target: str = Field(description="the target's name")
    stated_m: float = Field(description="the length as the rig file has it, metres")
    scale: float = Field(description="stated / true length")
    sigma: float | None = Field(description="standard deviation of scale; null where the motion does not tell it")
    is_free: bool = Field(description="true: left free in the answer, as the stated size does not fit, or on request")

    @property
    def is_doubted(self) -> bool:
        """Whether the measurements contradict the stated size, clearly and by more than matters little."""
        off = abs(self.scale - 1.0)
        return self.sigma is not None and off > SIZE_SHARE and off > SIZE_SIGMAS * self.sigma


class TimeOffsetFields(_Report):
    """A sensor's clock."""

    sensor: str = Field(description="the sensor's name")
    offset_s: Seconds = Field(description="its stamp t is the carriers' t + offset")
    sigma_s: float | None = Field(
        description="standard deviation; null where it was given, not estimated, and where the motion does not tell it"
    )


class LogFields(_Report):
    """Where a calibration's measurements came from, and what became of them."""

    sensor_carrier: str = Field(description="name of the frame that carries the sensors")
    target_carrier: str = Field(description="name of the frame that carries the targets")
    detection: DetectionReport = Field(description="what the detection stage reported")
    cleaning: CleaningReport = Field(description="what the cleaning stage reported")
    outliers: tuple[TrackCount, ...] = Field(description="what the robust estimation used, and left out")
    sizes: tuple[SizeFields, ...] = Field(description="what the measurements say of them, if they say anything")
    time_offsets: tuple[TimeOffsetFields, ...] = Field(description="of every sensor that was used")
    contradicted: tuple[str, ...] = Field(
        default=(), description="sensors and targets whose poses are not to be used: most of what saw them contradicts"
    )

    @property
    def contradictions(self) -> tuple[str, ...]:
        """What is contradicted, in sentences."""
        counts = _counted(self.outliers)
        return tuple(
            f"{name}: {counts[name][1]} of its {sum(counts[name])} measurements contradict the answer"
            for name in self.contradicted
        )


def contradicted(outliers: tuple[TrackCount, ...]) -> tuple[str, ...]:
    """Sensors and targets of which more than half of the measurements were left out as outliers.

    The one that explains most comes first. Then it is as likely that the rest are the wrong ones: a clock, a size or a
    mounting that changed. What a name explains counts for no other: targets are not to blame for a camera that
    contradicts all of them.
    """
    names: list[str] = []
    while True:
        counts = _counted([t for t in outliers if t.target not in names and t.sensor not in names])
        worst = max((name for name in counts if _is_mostly_out(counts[name])), key=lambda n: counts[n][1], default=None)
        if worst is None:
            break
        names.append(worst)
    # Seen by nothing else, and mostly left out: it rests on what is contradicted.
    return tuple(names + [n for n, c in _counted(outliers).items() if n not in {*names, *counts} and _is_mostly_out(c)])


def _counted(tracks: Sequence[TrackCount]) -> dict[str, tuple[int, int]]:
    """How many measurements were used and left out, of each sensor and target."""
    counts: dict[str, tuple[int, int]] = {}
    for track in tracks:
        for name in track.pair:
            used, out = counts.get(name, (0, 0))
            counts[name] = used + track.used, out + sum(track.removed.values())
    return counts


def _is_mostly_out(count: tuple[int, int]) -> bool:
    used, out = count
    return out > used
