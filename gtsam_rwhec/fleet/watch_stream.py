"""What the watch says as a stream of JSON lines, which programs read.

The stream begins with a line ``"event": "watch"`` with the format's name and version and how it was counted, and ends
with ``"event": "end"``. Times are UTC, as ISO 8601 text and as nanoseconds (``_ns``). docs/drift.md has every field.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import Any

from gtsam_rwhec.fleet.watch_events import (
    AlarmEvent,
    Event,
    FramesEvent,
    FreeEvent,
    NightEvent,
    NoAnswerEvent,
    time_text,
)
from gtsam_rwhec.fleet.watching import Watched

#: What the stream calls itself, and the version of its fields.
FORMAT, FORMAT_VERSION = "gtsam-rwhec watch", 1
_NAMES = {
    NightEvent: "night",
    NoAnswerEvent: "no_answer",
    FramesEvent: "frames",
    FreeEvent: "free",
    AlarmEvent: "alarm",
}


def stream(watched: Watched, *, every_night: bool = False) -> Iterator[str]:
    """The lines of the stream, without line ends; lines of nights only where they are asked for."""
    times = [when for robot in watched.robots.values() for when in (robot.when_ns[0], robot.when_ns[-1])]
    spread = watched.spread
    yield _line(
        {
            "event": "watch",
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "written_by": f"gtsam-rwhec {version('gtsam-rwhec')}",
            "nights_between_false_alarms": 1.0 / watched.rate,
            "robots": len(watched.robots),
            "nights": sum(len(robot.tests) for robot in watched.robots.values()),
            **_time("first", min(times, default=None)),
            **_time("last", max(times, default=None)),
            "variance_over_stated": spread.variance,
            "correlation_of_nights": spread.correlation,
        }
    )
    for event in watched.events:
        if every_night or not isinstance(event, NightEvent):
            yield _line(event_fields(event))
    changed = sorted(watched.changed)
    yield _line({"event": "end", "alarms": len(watched.alarms), "robots_changed": changed})


def event_fields(event: Event) -> dict[str, Any]:
    """The fields of an event's line."""
    fields: dict[str, Any] = {"event": _NAMES[type(event)], "robot": event.robot, **_time("when", event.when_ns)}
    match event:
        case NightEvent():
            fields |= {"nights": event.nights, "chance": event.chance, "limit": event.limit}
        case NoAnswerEvent():
            fields |= {"reason": event.reason}
        case FramesEvent():
            fields |= {"appeared": event.appeared, "missing": event.missing}
        case FreeEvent():
            fields |= {"free": dict(event.free)}
        case AlarmEvent():
            for name in ("last_unchanged", "first_changed", "earliest", "latest"):
                fields |= _time(name, getattr(event, f"{name}_ns"))
            fields["frames"] = [
                {
                    "name": frame.name,
                    "translation_mm": frame.translation_mm,
                    "rotation_deg": frame.rotation_deg,
                    "deviations": frame.deviations if math.isfinite(frame.deviations) else None,
                    "xi": frame.xi,
                }
                for frame in event.frames
            ]
            for name in ("is_of_all", "kind", "drift_gain", "chance", "limit", "is_back", "unit"):
                fields[name] = getattr(event, name)
            fields["words"] = str(event)
    return fields


def _time(name: str, when_ns: int | None) -> dict[str, Any]:
    return {name: None if when_ns is None else time_text(when_ns), f"{name}_ns": when_ns}


def _line(fields: Mapping[str, Any]) -> str:
    return json.dumps(fields, ensure_ascii=True, allow_nan=False)
