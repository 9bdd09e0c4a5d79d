"""Drift of each robot of a fleet over time: a control chart for each, on the rows of the fleet's runs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from gtsam_rwhec.fleet.drift_events import (
    AlarmEvent,
    Event,
    FramesEvent,
    FreeEvent,
    MovedFrame,
    NightEvent,
    NoAnswerEvent,
)
from gtsam_rwhec.fleet.fleet_rows import RobotRow
from gtsam_rwhec.fleet.night_rows import Night, RobotFrames, names_of, why_not
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.results.control_chart import RATE, Alarm, Chart, NightTest
from gtsam_rwhec.results.nights import FoundSpread, Nights, SpreadPool

#: Nanoseconds of a day.
DAY_NS = 86_400_000_000_000


@dataclass(frozen=True, eq=False)
class Watched:
    """What the charts of a fleet say."""

    rate: float  #: False alarms a night of one robot
    events: tuple[Event, ...]  #: In order of time
    robots: dict[str, RobotChart]  #: Robots with at least one night that can be used
    spread: FoundSpread  #: How the nights scatter beside what their covariances say, from all of them

    @property
    def alarms(self) -> tuple[AlarmEvent, ...]:
        """The alarms, in order of time."""
        return tuple(event for event in self.events if isinstance(event, AlarmEvent))

    @property
    def changed(self) -> tuple[str, ...]:
        """The robots with an alarm, those with the last one first."""
        return tuple(dict.fromkeys(alarm.robot for alarm in reversed(self.alarms)))


@dataclass(eq=False)
class RobotChart:
    """The chart of one robot as it stands, with what it said."""

    number: int
    frames: RobotFrames
    names: dict[tuple[str, str], str]
    chart: Chart
    when_ns: list[int] = field(default_factory=list)  #: Of each night
    #: Its numbers, in the frames' units; nan in what it does not determine
    x: list[Array] = field(default_factory=list)
    tests: list[NightTest] = field(default_factory=list)
    alarms: list[AlarmEvent] = field(default_factory=list)
    last: list[Night] = field(default_factory=list)
    free: dict[str, tuple[str, ...]] = field(default_factory=dict)


@one_blas_thread()
def watch(rows: Iterable[RobotRow], rate: float = RATE) -> Watched:
    """The control charts of all robots, night by night.

    What a night says rests on that night and on earlier ones, so more nights later change no event.

    Parameters
    ----------
    rows : RobotRow
        Of one or several runs, in any order. Of two rows of one robot that overlap in time, the one given last counts.
    rate : float
        False alarms a night of one robot (`rw.results.checked_rate`).
    """
    given = _one_for_each_time(list(rows))
    usable = [row for row in given if not why_not(row)]
    robots: dict[str, RobotChart] = {}
    rows_of: dict[str, list[RobotRow]] = {}
    for row in usable:
        rows_of.setdefault(row.robot, []).append(row)
    for name, own in rows_of.items():
        frames = RobotFrames.of(own)
        robots[name] = RobotChart(len(robots), frames, names_of(own), Chart(Nights.none(frames.groups)))
    events: list[Event] = []
    pool, spread = SpreadPool(), SpreadPool().found()
    fresh: list[tuple[int, int, Array, Array]] = []
    day = None
    for row in given:
        if row.begin_ns is not None and row.begin_ns // DAY_NS != day:
            day = row.begin_ns // DAY_NS
            for each in fresh:
                pool.add(*each)
            if fresh:
                spread = pool.found()
            fresh = []
        why = why_not(row)
        if why:
            events.append(NoAnswerEvent(row.robot, row.begin_ns, why))
            continue
        robot = robots[row.robot]
        night = robot.frames.night(row, robot.names)
        said = _night_events(robot, row, night, spread, rate)
        events += said
        if said and isinstance(said[-1], AlarmEvent):  # what lies across a change says nothing of quiet nights
            robot.last = [each for each in robot.last if each.when_ns >= said[-1].first_changed_ns]
        fresh += _differences(robot, night)
        robot.last = [*robot.last[-1:], night]
    for each in fresh:
        pool.add(*each)
    return Watched(rate, tuple(events), robots, pool.found())


def _one_for_each_time(rows: list[RobotRow]) -> list[RobotRow]:
    """The rows in order of time, without those whose time a row of the same robot covers that was given later."""
    kept: list[RobotRow] = []
    taken: dict[str, list[tuple[int, int]]] = {}
    for row in reversed(rows):
        spans = taken.setdefault(row.robot, [])
        if row.begin_ns is not None:
            end = row.begin_ns if row.end_ns is None else row.end_ns
            if any(row.begin_ns <= last and first <= end for first, last in spans):
                continue
            if row.verdict is not None:
                spans.append((row.begin_ns, end))
        kept.append(row)
    return sorted(kept, key=lambda row: (-1 if row.begin_ns is None else row.begin_ns, row.robot))


def _night_events(robot: RobotChart, row: RobotRow, night: Night, spread: FoundSpread, rate: float) -> list[Event]:
    """Put a night into a robot's chart, and say what it says."""
    when = row.begin_ns
    assert when is not None
    events: list[Event] = []
    if robot.last:
        there, was = (
            {n for n, at in robot.frames.groups.items() if each.seen[at].any()} for each in (night, robot.last[-1])
        )
        if there != was:
            events.append(FramesEvent(row.robot, when, tuple(sorted(there - was)), tuple(sorted(was - there))))
    free = robot.frames.free_of(night)
    if free != robot.free:
        events.append(FreeEvent(row.robot, when, free))
        robot.free = free
    chart, test, alarm = robot.chart.next(
        when / DAY_NS, night.x, night.information, spread.of_robot(robot.number), rate
    )
    robot.chart = chart
    robot.when_ns.append(when)
    robot.x.append(np.where(night.seen, night.x, np.nan))
    robot.tests.append(test)
    events.append(NightEvent(row.robot, when, test.nights, test.chance, test.limit))
    if alarm is not None:
        event = _alarm_event(robot, row, test, alarm)
        robot.alarms.append(event)
        events.append(event)
    return events


def _alarm_event(robot: RobotChart, row: RobotRow, test: NightTest, alarm: Alarm) -> AlarmEvent:
    found, nights = alarm.found, alarm.nights
    times = [round(day * DAY_NS) for day in nights.days]
    exact = {round(when / DAY_NS * DAY_NS): when for when in robot.when_ns}
    times = [exact.get(each, each) for each in times]
    moved = []
    for name in found.groups:
        at = nights.groups[name]
        before = nights.x[: found.first, at]
        seen = nights.seen[: found.first, at]
        mean = np.where(seen, before, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
        movement = robot.frames.movement(name, mean, found.change[name])
        deviations = found.deviations[name]
        moved.append(
            MovedFrame(name, movement.translation_mm, movement.rotation_deg, deviations, tuple(map(float, movement.xi)))
        )
    assert row.begin_ns is not None
    return AlarmEvent(
        robot=row.robot,
        when_ns=row.begin_ns,
        last_unchanged_ns=times[found.first - 1],
        first_changed_ns=times[found.first],
        earliest_ns=times[found.earliest],
        latest_ns=times[found.latest],
        frames=tuple(moved),
        is_of_all=found.is_of_all,
        kind=found.kind,
        drift_gain=found.drift_gain if math.isfinite(found.drift_gain) else 0.0,
        chance=test.chance,
        limit=test.limit,
        is_back=alarm.is_back,
        unit=row.unit,
    )


def _differences(robot: RobotChart, night: Night) -> Sequence[tuple[int, int, Array, Array]]:
    """The differences of a night from the one before and from the one before that, where both determine the same."""
    found = []
    for lag, other in enumerate(reversed(robot.last), start=1):
        at = np.flatnonzero(night.seen & other.seen)
        if len(at):
            C = (night.covariance + other.covariance)[np.ix_(at, at)]
            found.append((robot.number, lag, (night.x - other.x)[at], C))
    return found
