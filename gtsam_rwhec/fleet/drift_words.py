"""What the watch of a fleet found, in words for people, and as the stream of JSON lines."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from datetime import UTC, date, datetime
from importlib.metadata import version

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.terminal_text import brief, shown
from gtsam_rwhec.fleet.drift_events import (
    AlarmEvent,
    NightEvent,
    NoAnswerEvent,
    day_text,
    event_fields,
    json_line,
    time_fields,
)
from gtsam_rwhec.fleet.watching import Watched

#: What the stream calls itself, and the version of its fields.
FORMAT, FORMAT_VERSION = "gtsam-rwhec watch", 1
#: Variances over the stated ones that are as good as one, and correlations as good as none.
AS_STATED, NO_CORRELATION = (0.8, 1.25), 0.05
#: So many names, or reasons, are said; of more, how many.
SAID = 5


def drift_verdict(watched: Watched, since_ns: int = 0) -> str:
    """What the watch found, in a sentence or two, with what to do."""
    if not watched.robots:
        return "Nothing was watched: no robot has a night that says where its frames are."
    changed = list(dict.fromkeys(alarm.robot for alarm in watched.alarms if alarm.when_ns >= since_ns))
    nights = sum(len(robot.tests) for robot in watched.robots.values())
    of = f"{len(watched.robots)} robot{'s' * (len(watched.robots) != 1)}, {nights} night{'s' * (nights != 1)}"
    since = f" since {day_text(since_ns)}" if since_ns else ""
    if not changed:
        return f"Nothing moved by more than chance{since}: {of}."
    return (
        f"Moved by more than chance{since}: {len(changed)} of {of}: {_some(list(map(shown, changed)))}. "
        "Look at the mounts of the frames that are named, and use the calibrations since the date of the change."
    )


def drift_remarks(watched: Watched) -> tuple[str, ...]:
    """What to keep in mind."""
    tests = [test for robot in watched.robots.values() for test in robot.tests]
    found = []
    if watched.robots:
        tested = sum(test.limit > 0.0 for test in tests)
        found.append(
            f"A robot that nothing happens to has one false alarm in {1.0 / watched.rate:,.0f} nights: of the {tested} "
            f"nights that were tested, about {tested * watched.rate:.2g}."
        )
    variance, correlation = watched.spread.variance, watched.spread.correlation
    if not AS_STATED[0] <= variance <= AS_STATED[1]:
        found.append(
            f"The nights scatter {variance**0.5:.2g} times as much as their covariances say, and are tested by that."
        )
    if correlation > NO_CORRELATION:
        found.append(f"Errors of successive nights have a correlation of {correlation:.2f}, and are tested by that.")
    missing = [event for event in watched.events if isinstance(event, NoAnswerEvent)]
    if missing:
        named = [
            f"{shown(event.robot)}"
            f"{'' if event.when_ns is None else f' {day_text(event.when_ns)}'} ({shown(event.reason)})"
            for event in missing
        ]
        found.append(f"{len(missing)} nights say nothing and are left out: {_some(named, '; ')}.")
    once = [name for name, robot in watched.robots.items() if len(robot.tests) == 1]
    if once:
        found.append(f"One night only, so nothing is tested: {_some(list(map(shown, once)))}.")
    several = [name for name, count in Counter(alarm.robot for alarm in watched.alarms).items() if count > 2]
    if several:
        found.append(f"More than two alarms: {_some(list(map(shown, several)))}. Something moves again and again.")
    return tuple(found)


def alarm_lines(watched: Watched, since_ns: int = 0) -> tuple[str, ...]:
    """One sentence for each alarm, the last one first."""
    alarms: list[AlarmEvent] = [alarm for alarm in reversed(watched.alarms) if alarm.when_ns >= since_ns]
    return tuple(map(str, alarms))


def day_ns_of(text: str | None) -> int:
    """The beginning of a day in UTC, nanoseconds; 0 for none; OptionError for what is no day."""
    if text is None:
        return 0
    try:
        day = date.fromisoformat(text)
    except ValueError as error:
        raise OptionError(f"since: {brief(text)} is no day; give one as 2026-11-23") from error
    return int(datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()) * 1_000_000_000


def _some(names: list[str], between: str = ", ") -> str:
    more = len(names) - SAID
    return between.join(names[:SAID]) + (f"{between}and {more} more" if more > 0 else "")


def stream(watched: Watched, *, every_night: bool = False) -> Iterator[str]:
    """The lines of the stream, without line ends; lines of nights only where they are asked for."""
    times = [when for robot in watched.robots.values() for when in (robot.when_ns[0], robot.when_ns[-1])]
    spread = watched.spread
    yield json_line(
        {
            "event": "watch",
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "written_by": f"gtsam-rwhec {version('gtsam-rwhec')}",
            "nights_between_false_alarms": 1.0 / watched.rate,
            "robots": len(watched.robots),
            "nights": sum(len(robot.tests) for robot in watched.robots.values()),
            **time_fields("first", min(times, default=None)),
            **time_fields("last", max(times, default=None)),
            "variance_over_stated": spread.variance,
            "correlation_of_nights": spread.correlation,
        }
    )
    for event in watched.events:
        if every_night or not isinstance(event, NightEvent):
            yield json_line(event_fields(event))
    changed = sorted(watched.changed)
    yield json_line({"event": "end", "alarms": len(watched.alarms), "robots_changed": changed})
