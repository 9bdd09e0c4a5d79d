"""What the watch says, one event a line, as records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from gtsam_rwhec.files.terminal_text import rounded, shown


@dataclass(frozen=True)
class NightEvent:
    """What a robot's chart says at one night.

    Attributes
    ----------
    robot : str
    when_ns : int
        The night's first measurement.
    nights : int
        Nights in the chart since the last change.
    chance, limit : float
        The statistic, and the limit below which it is an alarm. The limit is 0 at the first night: nothing is tested.
    """

    robot: str
    when_ns: int
    nights: int
    chance: float
    limit: float


@dataclass(frozen=True)
class NoAnswerEvent:
    """A night that says nothing of where the frames are, and why; without a time where nothing was measured."""

    robot: str
    when_ns: int | None
    reason: str


@dataclass(frozen=True)
class FramesEvent:
    """Frames that the night before did not have, and that only that one had."""

    robot: str
    when_ns: int
    appeared: tuple[str, ...]
    missing: tuple[str, ...]


@dataclass(frozen=True)
class FreeEvent:
    """What a night leaves free of frames that it has, where that is another than at the night before."""

    robot: str
    when_ns: int
    free: Mapping[str, tuple[str, ...]]


@dataclass(frozen=True)
class MovedFrame:
    """How a frame moved: old pose Expmap(xi) = new pose, xi = [omega (rad), v (m)]; how many deviations that is."""

    name: str
    translation_mm: float
    rotation_deg: float
    deviations: float
    xi: tuple[float, ...]

    def __str__(self) -> str:
        return f"{shown(self.name)} {rounded(self.translation_mm, 3)} mm and {rounded(self.rotation_deg)} degrees"


@dataclass(frozen=True)
class AlarmEvent:
    """A robot's frames moved; ``str()`` says it.

    Attributes
    ----------
    robot : str
    when_ns : int
        The night of the alarm.
    last_unchanged_ns, first_changed_ns : int
        It was between these two nights. Of a drift: it began there.
    earliest_ns, latest_ns : int
        First changed nights that are hardly less likely.
    frames : tuple of MovedFrame
        The fewest whose movement explains everything, the surest first.
    is_of_all : bool
        Whether these are all frames that were tested.
    kind : "step", "drift" or "step or drift"
    drift_gain : float
        Log likelihood of a drift less that of a step.
    chance, limit : float
        As in `NightEvent`.
    is_back : bool
        Whether the frames are back where they were before the alarm before this one.
    unit : str
        The row's unit, which names its result.
    """

    robot: str
    when_ns: int
    last_unchanged_ns: int
    first_changed_ns: int
    earliest_ns: int
    latest_ns: int
    frames: tuple[MovedFrame, ...]
    is_of_all: bool
    kind: str
    drift_gain: float
    chance: float
    limit: float
    is_back: bool
    unit: str

    def __str__(self) -> str:
        moved = "; ".join(map(str, self.frames))
        verb = "drifts" if self.kind == "drift" else "moved"
        what = "all frames" if self.is_of_all else ", ".join(shown(frame.name) for frame in self.frames)
        since = f"since {day_text(self.last_unchanged_ns)}" if self.kind == "drift" else self.between
        back = " It is back where it was before the last alarm." if self.is_back else ""
        return f"{shown(self.robot)}: {what} {verb} {since} ({moved}), seen on {day_text(self.when_ns)}.{back}"

    @property
    def between(self) -> str:
        """Between which nights, in words."""
        return f"between {day_text(self.last_unchanged_ns)} and {day_text(self.first_changed_ns)}"


Event = NightEvent | NoAnswerEvent | FramesEvent | FreeEvent | AlarmEvent


def time_text(when_ns: int) -> str:
    """A time as ISO 8601 in UTC, to the microsecond."""
    return (
        (datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=when_ns // 1000)).isoformat().replace("+00:00", "Z")
    )


def day_text(when_ns: int) -> str:
    """A day in UTC."""
    return time_text(when_ns)[:10]
