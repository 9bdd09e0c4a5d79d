"""Find drift in a fleet: one control chart for each robot, from the rows of the fleet's runs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version

import gtsam
import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.calibration.verdict import Ground, Verdict
from gtsam_rwhec.fleet.drift_events import (
    AlarmEvent,
    Event,
    FramesEvent,
    FreeEvent,
    MovedFrame,
    NightEvent,
    NoAnswerEvent,
    event_fields,
    json_line,
    time_fields,
)
from gtsam_rwhec.fleet.fleet_rows import RobotRow
from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.results.common_quantities import Movement, less_common_errors
from gtsam_rwhec.results.control_chart import RATE, Alarm, Chart, NightTest
from gtsam_rwhec.results.nights import FoundSpread, Nights, SpreadPool

#: Rows that are "do not use" only for these grounds still count in what they determine.
DETERMINES_SOMETHING = {Ground.NOT_UNIQUE, Ground.NO_ANSWER, Ground.FEW_MEASUREMENTS}
#: Smaller eigenvalues of a correlation matrix are rounding error and are set to this.
ROUNDING = 1e-12
#: Names of a tangent's numbers.
AXES = ("rotation about x", "rotation about y", "rotation about z", "x", "y", "z")


@dataclass(frozen=True, eq=False)
class RobotFrames:
    """The frames of a robot over all its nights, and the place of each frame in the chart's numbers."""

    #: By name. If a name is a sensor in some nights and a target in others, the target has "(target)" after it
    groups: dict[str, slice]
    reference: dict[str, Array]  #: The pose of its first night
    unit: Array  #: (m,): the deviation of each number at its first night, rad and m: the numbers are multiples of it
    names: dict[tuple[str, str], str]  #: The name of each frame and kind

    @staticmethod
    def of(rows: Sequence[RobotRow]) -> RobotFrames:
        """Make it from usable rows in order of time."""
        reference: dict[str, Array] = {}
        units: dict[str, Array] = {}
        names: dict[tuple[str, str], str] = {}
        for row in rows:
            assert row.covariance is not None
            variances = np.diagonal(row.covariance)
            for i, frame in enumerate(row.frames):
                taken = any(name == frame.name and kind != frame.kind for name, kind in names)
                own_name = f"{frame.name} ({frame.kind})" if taken else frame.name
                name = names.setdefault((frame.name, frame.kind), own_name)
                reference.setdefault(name, frame.T)
                own = variances[6 * i : 6 * i + 6]
                known = np.isfinite(own) & (own > 0.0)
                unit = units.setdefault(name, np.zeros(6))
                fresh = known & (unit == 0.0)
                unit[fresh] = np.sqrt(own[fresh])
        unit = np.concatenate([np.where(each > 0.0, each, 1.0) for each in units.values()] or [np.zeros(0)])
        return RobotFrames({name: slice(6 * i, 6 * i + 6) for i, name in enumerate(reference)}, reference, unit, names)

    def night(self, row: RobotRow) -> Night:
        """The numbers of one row."""
        assert row.covariance is not None
        m = len(self.unit)
        x, J, rows = np.zeros(m), np.zeros((m, 6 * len(row.frames))), np.zeros(m, bool)
        called = [self.names[frame.name, frame.kind] for frame in row.frames]
        before = np.stack([self.reference[name] for name in called])
        xi = se3.logmap(se3.inverse(before) @ np.stack([frame.T for frame in row.frames]))
        inward = se3.right_jacobian_inverse(xi)
        variances = np.diagonal(row.covariance).reshape(-1, 6)
        # With a free rotation nothing is linear. A number without variance was given, not estimated.
        known = (variances > 0.0) & np.isfinite(variances) & np.isfinite(variances[:, :3]).all(axis=1, keepdims=True)
        for i, name in enumerate(called):
            at = self.groups[name]
            x[at], rows[at] = np.where(known[i], xi[i], 0.0), known[i]
            J[at, 6 * i : 6 * i + 6] = inward[i]
        J[~rows] = 0.0
        finite = _without_constant_errors(row)
        C = (J @ finite @ J.T) / self.unit[:, None] / self.unit
        assert row.begin_ns is not None
        return Night(row.begin_ns, x / self.unit, _information(C, rows), np.where(np.outer(rows, rows), C, 0.0), rows)

    def movement(self, name: str, before: Array, change: Array) -> Movement:
        """The movement of a frame for a change (6,) of its numbers."""
        unit = self.unit[self.groups[name]]
        T = gtsam.Pose3(self.reference[name])
        return Movement.of(T.expmap(unit * before), T.expmap(unit * (before + change)))

    def free_of(self, night: Night) -> dict[str, tuple[str, ...]]:
        """By frame, the numbers that a night leaves free, for frames that it determines in part."""
        found = {}
        for name, rows in self.groups.items():
            seen = night.seen[rows]
            if seen.any() and not seen.all():
                found[name] = tuple(axis for axis, there in zip(AXES, seen, strict=True) if not there)
        return found


@dataclass(frozen=True, eq=False)
class Night:
    """One night in the chart's numbers."""

    when_ns: int
    x: Array  #: (m,)
    #: information, covariance: (m, m): zero in rows that the night does not determine
    information: Array
    covariance: Array
    seen: np.ndarray  #: (m,): rows that it determines


def why_not(row: RobotRow) -> str:
    """Why a row does not determine where the frames are; empty if it does."""
    if row.verdict is None or not row.frames:
        return row.failure or row.reason or "there is no calibration"
    if row.verdict is Verdict.DO_NOT_USE and not set(row.grounds) <= DETERMINES_SOMETHING:
        return f"its poses are not to be used: {row.reason}"
    if row.covariance is None:
        return "its poses have no covariance, because it was not refined"
    variances = np.diagonal(row.covariance)
    finite = np.flatnonzero(np.isfinite(variances))
    is_damaged = np.isnan(variances).any() or (variances < 0.0).any()
    if is_damaged or not np.isfinite(row.covariance[np.ix_(finite, finite)]).all():
        return "its covariance has a variance below zero or what is no number; run this night again"
    if not all(np.isfinite(frame.T).all() for frame in row.frames):
        return "a pose of it has what is no finite number; run this night again"
    if not ((variances > 0.0) & np.isfinite(variances)).any():
        return "nothing of it is determined"
    if row.begin_ns is None:
        return "its measurements have no time"
    return ""


def _without_constant_errors(row: RobotRow) -> Array:
    """The finite covariances minus the errors that all nights share; unchanged if they do not include them."""
    assert row.covariance is not None
    finite: Array = np.where(np.isfinite(row.covariance), row.covariance, 0.0)
    if not row.constant_errors:
        return finite
    shifts = np.zeros((2, len(finite), 6))  # the errors of the two carriers are independent
    for i, frame in enumerate(row.frames):
        carrier = int(frame.kind == "sensor")
        deviations = np.array(row.constant_errors[carrier])
        shifts[carrier, 6 * i : 6 * i + 6] = se3.adjoint(se3.inverse(frame.T)[None])[0] * deviations
    rest = less_common_errors(finite, np.einsum("kma,kna->mn", shifts, shifts))
    return finite if rest is None else rest


def _information(C: Array, rows: np.ndarray) -> Array:
    """The inverse of the covariance over some rows, zero in the others."""
    found: Array = np.zeros_like(C)
    at = np.flatnonzero(rows)
    if len(at):
        size = np.sqrt(np.diagonal(C)[at])
        values, vectors = np.linalg.eigh(C[np.ix_(at, at)] / size[:, None] / size)
        root = vectors / np.sqrt(np.maximum(values, ROUNDING * len(at))) / size[:, None]
        found[np.ix_(at, at)] = root @ root.T
    return found


#: Nanoseconds of a day.
DAY_NS = 86_400_000_000_000


@dataclass(frozen=True, eq=False)
class Watched:
    """The control charts of a fleet with their events."""

    rate: float  #: False alarms a night of one robot
    events: tuple[Event, ...]  #: In order of time
    robots: dict[str, RobotChart]  #: Robots with at least one night that can be used
    spread: FoundSpread  #: The scatter of all nights compared with their covariances

    @property
    def alarms(self) -> tuple[AlarmEvent, ...]:
        """The alarms, in order of time."""
        return tuple(event for event in self.events if isinstance(event, AlarmEvent))

    @property
    def changed(self) -> tuple[str, ...]:
        """The robots with an alarm, the latest alarm first."""
        return tuple(dict.fromkeys(alarm.robot for alarm in reversed(self.alarms)))


@dataclass(eq=False)
class RobotChart:
    """The chart of one robot: its present state and its past tests."""

    number: int
    frames: RobotFrames
    chart: Chart
    when_ns: list[int] = field(default_factory=list)  #: Of each night
    #: Each night's numbers, in the frames' units; nan if the night does not determine a number
    x: list[Array] = field(default_factory=list)
    tests: list[NightTest] = field(default_factory=list)
    alarms: list[AlarmEvent] = field(default_factory=list)
    last: list[Night] = field(default_factory=list)
    free: dict[str, tuple[str, ...]] = field(default_factory=dict)


@one_blas_thread()
def watch(rows: Iterable[RobotRow], rate: float = RATE) -> Watched:
    """The control charts of all robots, night by night.

    The events of a night depend on this night and earlier ones only: later nights do not change them.

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
        robots[name] = RobotChart(len(robots), frames, Chart(Nights.none(frames.groups)))
    events: list[Event] = []
    pool = SpreadPool()
    spread = pool.found()
    fresh: list[tuple[int, int, Array, Array]] = []
    day = None

    def pooled() -> FoundSpread:
        """The spread with the differences of the day that ends."""
        for each in fresh:
            pool.add(*each)
        fresh.clear()
        return pool.found()

    for row in given:
        if row.begin_ns is not None and row.begin_ns // DAY_NS != day:
            day, spread = row.begin_ns // DAY_NS, pooled()
        why = why_not(row)
        if why:
            events.append(NoAnswerEvent(row.robot, row.begin_ns, why))
            continue
        robot = robots[row.robot]
        night = robot.frames.night(row)
        said = _night_events(robot, row, night, spread, rate)
        events += said
        if said and isinstance(said[-1], AlarmEvent):  # differences across a change do not show the noise
            robot.last = [each for each in robot.last if each.when_ns >= said[-1].first_changed_ns]
        fresh += _differences(robot, night)
        robot.last = [*robot.last[-1:], night]
    return Watched(rate, tuple(events), robots, pooled())


def _one_for_each_time(rows: list[RobotRow]) -> list[RobotRow]:
    """The rows in order of time, without rows that overlap in time with a row of the same robot given later."""
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
    """Add a night to a robot's chart; return its events."""
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
    """The differences of a night from the previous one and the one before, if they determine the same numbers."""
    found = []
    for lag, other in enumerate(reversed(robot.last), start=1):
        at = np.flatnonzero(night.seen & other.seen)
        if len(at):
            C = (night.covariance + other.covariance)[np.ix_(at, at)]
            found.append((robot.number, lag, (night.x - other.x)[at], C))
    return found


#: The stream's format name, and the version of its fields.
FORMAT, FORMAT_VERSION = "gtsam-rwhec watch", 1


def stream(watched: Watched, *, every_night: bool = False) -> Iterator[str]:
    """The lines of the stream, without line ends; lines of nights only on request."""
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
