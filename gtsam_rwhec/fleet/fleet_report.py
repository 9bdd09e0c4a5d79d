"""The report of a fleet's run on the terminal: usable robots, the worst, failures, where the files are, costs."""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, date, datetime
from typing import Literal

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.terminal_text import brief, counted, shown, some
from gtsam_rwhec.fleet.drift_events import NoAnswerEvent, day_text
from gtsam_rwhec.fleet.fleet_rows import ROWS_FILE, RobotRow
from gtsam_rwhec.fleet.fleet_run import FleetRun
from gtsam_rwhec.fleet.watching import Watched
from gtsam_rwhec.report.report_blocks import Table
from gtsam_rwhec.report.terminal_report import (
    TONE_STYLES,
    print_heading,
    print_list,
    print_sentence,
    print_tables,
    report_console,
)

#: The most robots and failures that are named.
MOST_NAMED = 10
#: The most characters of a reason in a list.
LONGEST_REASON = 600
HEADINGS = ("verdict", "logs", "n", "mm", "deg")
LEGEND = (
    "n: measurements. mm, deg: the largest standard deviation of a sensor's position along, and of its rotation about, "
    "one axis; - where the motion leaves it free."
)
_WORDS = {Verdict.USE: "may be used", Verdict.CARE: "to be used with care", Verdict.DO_NOT_USE: "not to be used"}
_CELLS = {None: "failed", Verdict.USE: "use", Verdict.CARE: "with care", Verdict.DO_NOT_USE: "do not use"}


def print_fleet(run: FleetRun) -> None:
    """Print a run: verdicts first, then the worst, failures, places and costs."""
    console = report_console()
    print_sentence(console, summary(run.rows), TONE_STYLES[tone_of(run.rows)])
    named = worst_first(run.rows)[:MOST_NAMED]
    if named:
        console.print()
        print_tables(console, [Table.of("The worst calibrations", "unit", HEADINGS, _cells(named), LEGEND)])
    doubtful = [row for row in named if row.verdict in (Verdict.CARE, Verdict.DO_NOT_USE)]
    if doubtful:
        print_heading(console, "What speaks against them", tight=True)
        print_list(console, [f"{_name(row)}: {_short(row.reason)}" for row in doubtful])
    for heading, said in (("What failed", failures_of(run.rows)), ("What was remarked", remarks_of(run.rows))):
        if said:
            print_heading(console, heading, tight=True)
            more = len(said) - MOST_NAMED
            print_list(console, [*said[:MOST_NAMED], *([f"and {more} more, in {ROWS_FILE}"] if more > 0 else [])])
    console.print()
    print_sentence(console, f"Results: {run.output}/robots/; all rows: {run.output}/{ROWS_FILE}.")
    print_sentence(console, _done(run), "dim")


def summary(rows: Sequence[RobotRow]) -> str:
    """How many calibrations may be used: "12 calibrations: 10 may be used, 1 not to be used, 1 failed."."""
    counts = Counter(row.verdict for row in rows if row.failure is None)
    failed = sum(row.failure is not None for row in rows)
    parts = [f"{counts[verdict]} {words}" for verdict, words in _WORDS.items() if counts[verdict]]
    parts += [f"{failed} failed"] if failed else []
    lost = sum(len(row.failed_logs) for row in rows)
    logs = f" {counted(lost, 'log')} could not be used." if lost else ""
    return f"{counted(len(rows), 'calibration')}: {', '.join(parts) or 'none'}.{logs}"


def worst_first(rows: Sequence[RobotRow]) -> list[RobotRow]:
    """The calibrations: first those that are not to be used, then by the uncertainty of the sensors' positions."""
    there = [row for row in rows if row.verdict is not None]
    order = list(Verdict)
    return sorted(there, key=lambda row: (-order.index(row.verdict), -row.largest_deviations("sensor")[1], row.unit))  # type: ignore[arg-type]


def failures_of(rows: Sequence[RobotRow]) -> list[str]:
    """Robots without a calibration and logs that were left out, with the reasons."""
    failures = [f"{_name(row)}: {_short(row.failure)}" for row in rows if row.failure is not None]
    return failures + [
        f"{_name(row)}, {log.url}: {_short(log.reason)}"
        for row in rows
        if row.failure is None
        for log in row.failed_logs
    ]


def remarks_of(rows: Sequence[RobotRow]) -> list[str]:
    """Findings about logs whose poses may be used, for example that a log is cut off."""
    return [f"{_name(row)}: {_short(words)}" for row in rows if row.verdict is Verdict.USE for words in row.findings]


def tone_of(rows: Sequence[RobotRow]) -> Literal["good", "care", "bad"]:
    """The tone of the worst row."""
    if any(row.verdict in (None, Verdict.DO_NOT_USE) for row in rows):
        return "bad"
    return "good" if rows and all(row.is_fine and row.verdict is Verdict.USE for row in rows) else "care"


def _name(row: RobotRow) -> str:
    return row.unit if row.site is None else f"{row.unit}, {row.robot}"


def _cells(rows: Sequence[RobotRow]) -> dict[str, tuple[str, ...]]:
    cells = {}
    for row in rows:
        turned, moved = row.largest_deviations("sensor")
        deviations = ("-" if math.isinf(value) else f"{value:.3g}" for value in (1e3 * moved, math.degrees(turned)))
        logs = str(row.logs) if not row.failed_logs else f"{row.logs} of {row.logs + len(row.failed_logs)}"
        cells[_name(row)] = (verdict_cell(row), logs, str(row.measurements), *deviations)
    return cells


def verdict_cell(row: RobotRow) -> str:
    """The verdict in a table."""
    return _CELLS[row.verdict]


def _short(words: str | None) -> str:
    return textwrap.shorten(words or "", LONGEST_REASON, placeholder="...")


def _done(run: FleetRun) -> str:
    earlier = f"{run.earlier_tasks} files were there already. {run.seconds:.1f} s."
    if not run.new_tasks:
        return f"Nothing new was computed; {earlier}"
    read = sum(row.bytes_read for row in run.rows)
    peak = max((row.peak_bytes for row in run.rows), default=0)
    return (
        f"{run.new_tasks} tasks done ({run.cpu_s:.1f} s of processors, {read / 1e6:.3g} MB of logs read, "
        f"{peak / 1e6:.0f} MB of memory at most); {earlier}"
    )


#: Ratios of a variance to the stated one that count as 1, and correlations that count as 0.
AS_STATED, NO_CORRELATION = (0.8, 1.25), 0.05
#: The most names or reasons that are listed; of others only the number.
SAID = 5


def drift_verdict(watched: Watched, since_ns: int = 0) -> str:
    """What the watch found and what to do, in a sentence or two."""
    if not watched.robots:
        return "Nothing was watched: no robot has a night that says where its frames are."
    changed = list(dict.fromkeys(alarm.robot for alarm in watched.alarms if alarm.when_ns >= since_ns))
    nights = sum(len(robot.tests) for robot in watched.robots.values())
    of = f"{counted(len(watched.robots), 'robot')}, {counted(nights, 'night')}"
    since = f" since {day_text(since_ns)}" if since_ns else ""
    if not changed:
        return f"Nothing moved by more than chance{since}: {of}."
    return (
        f"Moved by more than chance{since}: {len(changed)} of {of}: {some(list(map(shown, changed)), SAID)}. "
        "Look at the mounts of the frames that are named, and use the calibrations since the date of the change."
    )


def drift_remarks(watched: Watched) -> tuple[str, ...]:
    """The limits of what the watch found."""
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
        found.append(f"{len(missing)} nights say nothing and are left out: {some(named, SAID, between='; ')}.")
    once = [name for name, robot in watched.robots.items() if len(robot.tests) == 1]
    if once:
        found.append(f"One night only, so nothing is tested: {some(list(map(shown, once)), SAID)}.")
    several = [name for name, count in Counter(alarm.robot for alarm in watched.alarms).items() if count > 2]
    if several:
        found.append(f"More than two alarms: {some(list(map(shown, several)), SAID)}. Something moves again and again.")
    return tuple(found)


def alarm_lines(watched: Watched, since_ns: int = 0) -> tuple[str, ...]:
    """One sentence for each alarm, the latest first."""
    return tuple(str(alarm) for alarm in reversed(watched.alarms) if alarm.when_ns >= since_ns)


def day_ns_of(text: str | None) -> int:
    """The start of a day in UTC, nanoseconds; 0 without a day; OptionError if the text is not a day."""
    if text is None:
        return 0
    try:
        day = date.fromisoformat(text)
    except ValueError as error:
        raise OptionError(f"since: {brief(text)} is no day; give one as 2026-11-23") from error
    return int(datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()) * 1_000_000_000
