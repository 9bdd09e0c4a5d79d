"""The events of a fleet's drift watch: as records, and as JSON lines for other programs, one event a line.

The first line, ``"event": "watch"``, has the format's name, version and settings; the last is ``"event": "end"``.
Times are UTC, as ISO 8601 text and as nanoseconds (``_ns``). docs/drift.md describes every field.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

from gtsam_rwhec.files.terminal_text import rounded, shown
from gtsam_rwhec.geometry.real_numbers import finite_or_none


@dataclass(frozen=True)
class NightEvent:
    """The state of a robot's control chart after one night."""

    robot: str
    when_ns: int  #: The night's first measurement
    nights: int  #: Nights in the chart since the last change
    #: chance, limit: the statistic, and the limit below which it raises an alarm. The limit is 0 at the first night,
    #: when nothing is tested
    chance: float
    limit: float


@dataclass(frozen=True)
class NoAnswerEvent:
    """A night that does not determine any frame, and why; without a time if nothing was measured."""

    robot: str
    when_ns: int | None
    reason: str


@dataclass(frozen=True)
class FramesEvent:
    """Frames that are new in this night, and frames that only the night before had."""

    robot: str
    when_ns: int
    appeared: tuple[str, ...]
    missing: tuple[str, ...]


@dataclass(frozen=True)
class FreeEvent:
    """What a night leaves free of its frames, if this differs from the night before."""

    robot: str
    when_ns: int
    free: Mapping[str, tuple[str, ...]]


@dataclass(frozen=True)
class MovedFrame:
    """How a frame moved: old pose Expmap(xi) = new pose, xi = [omega (rad), v (m)]; and its size in deviations."""

    name: str
    translation_mm: float
    rotation_deg: float
    deviations: float
    xi: tuple[float, ...]

    def __str__(self) -> str:
        return f"{shown(self.name)} {rounded(self.translation_mm, 3)} mm and {rounded(self.rotation_deg)} degrees"


@dataclass(frozen=True)
class AlarmEvent:
    """A robot's frames moved; ``str()`` gives the sentence."""

    robot: str
    when_ns: int  #: The night of the alarm
    #: last_unchanged_ns, first_changed_ns: the frames moved, or began to drift, between these two nights
    last_unchanged_ns: int
    first_changed_ns: int
    #: earliest_ns, latest_ns: the range of first changed nights that are almost as likely
    earliest_ns: int
    latest_ns: int
    frames: tuple[MovedFrame, ...]  #: The smallest set whose movement explains the change, the most certain first
    is_of_all: bool  #: Whether these are all frames that were tested
    kind: str
    drift_gain: float  #: Log likelihood of a drift minus that of a step
    #: chance, limit: as in `NightEvent`
    chance: float
    limit: float
    is_back: bool  #: Whether the frames are back where they were before the previous alarm
    unit: str  #: The row's unit, which names its result

    def __str__(self) -> str:
        moved = "; ".join(map(str, self.frames))
        verb = "drifts" if self.kind == "drift" else "moved"
        what = "all frames" if self.is_of_all else ", ".join(shown(frame.name) for frame in self.frames)
        since = f"since {day_text(self.last_unchanged_ns)}" if self.kind == "drift" else self.between
        back = " It is back where it was before the last alarm." if self.is_back else ""
        return f"{shown(self.robot)}: {what} {verb} {since} ({moved}), seen on {day_text(self.when_ns)}.{back}"

    @property
    def between(self) -> str:
        """The nights between which the frames moved, in words."""
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


_NAMES = {
    NightEvent: "night",
    NoAnswerEvent: "no_answer",
    FramesEvent: "frames",
    FreeEvent: "free",
    AlarmEvent: "alarm",
}


def event_fields(event: Event) -> dict[str, Any]:
    """The fields of an event's line."""
    fields: dict[str, Any] = {"event": _NAMES[type(event)]}
    for name, value in asdict(event).items():
        fields |= time_fields(name[:-3], value) if name.endswith("_ns") else {name: value}
    if isinstance(event, AlarmEvent):
        for frame in fields["frames"]:
            frame["deviations"] = finite_or_none(frame["deviations"])
        fields["words"] = str(event)
    return fields


def time_fields(name: str, when_ns: int | None) -> dict[str, Any]:
    """A time as two fields: as text, and in nanoseconds."""
    return {name: None if when_ns is None else time_text(when_ns), f"{name}_ns": when_ns}


def json_line(fields: Mapping[str, Any]) -> str:
    """A line of the stream."""
    return json.dumps(fields, ensure_ascii=True, allow_nan=False)
