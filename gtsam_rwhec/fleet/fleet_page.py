"""The HTML page of a fleet: usable calibrations, what moved over time, the worst robots, failures, costs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.files.terminal_text import shown, some
from gtsam_rwhec.files.whole_files import checked_path
from gtsam_rwhec.fleet.drift_events import AlarmEvent, day_text
from gtsam_rwhec.fleet.fleet_report import drift_remarks, drift_verdict, summary, tone_of, verdict_cell, worst_first
from gtsam_rwhec.fleet.fleet_rows import ROWS_FILE, RobotRow
from gtsam_rwhec.fleet.stores import write_once
from gtsam_rwhec.fleet.tasks import below
from gtsam_rwhec.fleet.watching import DAY_NS, RobotChart, Watched, watch
from gtsam_rwhec.geometry.real_numbers import finite_or_none
from gtsam_rwhec.report.figures import INK, VERMILLION, shortened, svg_figure
from gtsam_rwhec.report.html_page import page_html, write_page
from gtsam_rwhec.report.report_blocks import Block, Chart, Link, Listing, Number, Page, Paragraph, Section, Table, Words

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The most robots that are named one by one.
MOST_WORST = 10
#: The most control charts, and the most names in a table cell.
MOST_CHARTS, MOST_NAMES = 24, 12
#: The page's path in a run's output.
PAGE_FILE = "summary.html"
MADE_BY = "Written by gtsam-rwhec fleet."
#: A blue that is visible on dark and on light.
BLUE = "#2C8CC9"
#: Chances below this are drawn at this value.
LEAST_CHANCE = 1e-16


def put_page(rows: Sequence[RobotRow], output: str) -> str:
    """Write the page into a run's output (a folder or a URL); return its path there.

    If a robot has several calibrations (``--each day``), the page shows what moved between them. Raises StoreError
    if the output cannot be written.
    """
    times = Counter(row.robot for row in rows if row.begin_ns is not None)
    watched = watch(rows) if max(times.values(), default=0) > 1 else None
    url = below(output, PAGE_FILE)
    write_once(url, f"{page_html(fleet_page(rows, watched, has_results=True))}\n".encode("utf-8", "replace"))
    return url


def write_fleet_page(rows: Sequence[RobotRow], watched: Watched, path: str | Path, since_ns: int = 0) -> None:
    """Write the page of several runs as one HTML file that needs no network; older alarms do not count."""
    write_page(fleet_page(rows, watched, since_ns), checked_path(path))


def fleet_page(
    rows: Sequence[RobotRow], watched: Watched | None = None, since_ns: int = 0, *, has_results: bool = False
) -> Page:
    """The page. With `has_results` it is in a run's output, and links to the results of `rows` there."""
    alarms = [] if watched is None else [one for one in reversed(watched.alarms) if one.when_ns >= since_ns]
    tone = tone_of(rows)
    tone = "care" if tone == "good" and alarms else tone
    steps = _what_to_do(rows, has_moved=bool(alarms))
    sections = [
        Section("verdict", "The verdict", (Paragraph(summary(rows), tone), *([Listing(tuple(steps))] if steps else [])))
    ]
    if watched is not None:
        drift: list[Block] = [
            Paragraph(drift_verdict(watched, since_ns), "bad" if alarms else "good" if watched.robots else "care"),
            *([_alarm_table(alarms), *_drift_charts(watched, alarms)] if alarms else []),
            Listing(drift_remarks(watched)),
        ]
        sections.append(Section("drift", "What moved over time", tuple(drift)))
    worst = [row for row in worst_first(rows) if row.verdict is not Verdict.USE]
    if worst:
        sections.append(Section("worst", "The worst calibrations", (_worst(worst, has_results=has_results),)))
    failures = _failures(rows)
    if failures:
        sections.append(Section("failures", "What failed, and why", failures))
    if rows:
        costs = _costs(rows)
        table = _table(rows, has_results=has_results)
        sections.append(Section("robots", "All calibrations", (*([Paragraph(costs)] if costs else []), table)))
    return Page(title="A fleet's calibrations", tone=tone, sections=tuple(sections), made_by=MADE_BY)


def _what_to_do(rows: Sequence[RobotRow], *, has_moved: bool) -> list[Words]:
    verdicts = {row.verdict for row in rows}
    steps = (
        (has_moved, "Robots on which something moved: look at the mounts of the frames that are named."),
        (None in verdicts, "Robots without a calibration: see below why, mend it, and run again. What is done stays."),
        (any(row.failed_logs for row in rows), "Logs that gave nothing: the answers rest on the others; see below."),
        (Verdict.DO_NOT_USE in verdicts, "Poses not to be used: do what each robot's reason says, and record again."),
        (Verdict.CARE in verdicts, "Poses to be used with care: read the reason in the table first."),
    )
    return [words for is_so, words in steps if is_so]


def _worst(rows: Sequence[RobotRow], *, has_results: bool) -> Table:
    more = f"{len(rows) - MOST_WORST} more are in the table of all calibrations." if len(rows) > MOST_WORST else ""
    cells = tuple((_name(row, has_results), verdict_cell(row), row.reason) for row in rows[:MOST_WORST])
    return Table("Poses not to be used first, the least certain first", ("calibration", "verdict", "why"), cells, more)


def _failures(rows: Sequence[RobotRow]) -> tuple[Block, ...]:
    blocks: list[Block] = []
    reasons: dict[str, list[str]] = {}
    for row in rows:
        if row.verdict is None:
            reasons.setdefault(row.failure or row.reason or "no reason is known", []).append(shown(row.unit))
    if reasons:
        cells = tuple((reason, some(names, MOST_NAMES)) for reason, names in reasons.items())
        blocks.append(Table("Without a calibration, by reason", ("reason", "which"), cells))
    logs = tuple((shown(log.url), shown(row.unit), log.reason) for row in rows for log in row.failed_logs)
    if logs:
        blocks.append(Table("Logs that gave nothing", ("log", "calibration", "why"), logs, sorts=True))
    return tuple(blocks)


def _costs(rows: Sequence[RobotRow]) -> str:
    """What a log costs: one sentence."""
    counted = [row for row in rows if row.logs + len(row.failed_logs) and row.cpu_s > 0.0]
    if not counted:
        return ""
    logs = np.array([row.logs + len(row.failed_logs) for row in counted], float)
    cpu_s, megabytes = (np.array([getattr(row, name) for row in counted]) / logs for name in ("cpu_s", "bytes_read"))
    return (
        f"A log takes {np.median(cpu_s):.3g} CPU seconds (median; at most {cpu_s.max():.3g}) and "
        f"{1e-6 * np.median(megabytes):.3g} MB from its store (at most {1e-6 * megabytes.max():.3g})."
    )


def _table(rows: Sequence[RobotRow], *, has_results: bool) -> Table:
    several = len({row.robot for row in rows}) < len(rows)
    has_site = any(row.site for row in rows)

    def cells(i: int, row: RobotRow) -> tuple[Words, ...]:
        def number(field: str, value: float | None, times: float = 1.0, spec: str = ".3g") -> Number:
            return Number(f"{ROWS_FILE}#/rows/{i}/{field}", value, times, spec)

        turned, moved = map(finite_or_none, row.largest_deviations())
        known = row.covariance is not None and len(row.covariance) > 0
        return (
            _name(row, has_results),
            verdict_cell(row),
            *([row.site or ""] if has_site else []),
            *(["" if row.begin_ns is None else day_text(row.begin_ns)] if several else []),
            number("covariance", moved, 1e3) if known else "",
            number("covariance", turned, 180.0 / math.pi) if known else "",
            number("logs", row.logs, spec=".0f"),
            number("failed_logs", len(row.failed_logs), spec=".0f"),
            number("measurements", row.measurements, spec=".0f"),
            number("cpu_s", row.cpu_s),
            number("bytes_read", row.bytes_read, 1e-6),
            number("peak_bytes", row.peak_bytes, 1e-6),
            row.failure or row.reason,
        )

    headings = (
        "calibration", "verdict", *(["site"] if has_site else []), *(["day (UTC)"] if several else []), "position (mm)",
        "rotation (degrees)", "logs", "failed logs", "measurements", "CPU (s)", "read (MB)", "memory (MB)", "reason",
    )  # fmt: skip
    return Table(
        "Every calibration; a click on a heading sorts",
        headings,
        tuple(cells(i, row) for i, row in enumerate(rows)),
        "Position and rotation: the largest standard deviation of any frame along or about an axis; free where one is "
        "not determined. CPU and bytes are of all tasks of the calibration, memory of the largest.",
        sorts=True,
    )


def _name(row: RobotRow, has_results: bool) -> Words:
    return Link(shown(row.unit), row.result) if row.result and has_results else shown(row.unit)


def _alarm_table(alarms: list[AlarmEvent]) -> Table:
    rows = tuple(
        (
            shown(alarm.robot),
            day_text(alarm.first_changed_ns),
            day_text(alarm.when_ns),
            "all frames" if alarm.is_of_all else ", ".join(shown(frame.name) for frame in alarm.frames),
            "; ".join(map(str, alarm.frames)),
            alarm.kind + (", back where it was" if alarm.is_back else ""),
        )
        for alarm in alarms
    )
    headings = ("robot", "first changed night", "seen on", "what moved", "by how much", "how")
    return Table(
        "Alarms, the last one first", headings, rows, sorts=True,
        legend="A step or a drift: which fits better; with one or two nights after a change neither does.",
    )  # fmt: skip


def _drift_charts(watched: Watched, alarms: list[AlarmEvent]) -> list[Block]:
    """A small control chart of each robot that changed, the latest change first."""
    names = list(dict.fromkeys(alarm.robot for alarm in alarms))
    charts: list[Block] = [
        Paragraph(
            "Above: how unlikely each night is if nothing moved since the last change (one in so many nights, times "
            "the moments that are searched); an alarm is above the dashed line. Below: how far the frame that moved is "
            "from where it was before the last change, in mm. Vertical lines are dates of changes."
        )
    ]
    charts += [_drift_chart(number, name, watched.robots[name]) for number, name in enumerate(names[:MOST_CHARTS])]
    if len(names) > MOST_CHARTS:
        charts.append(Paragraph(f"{len(names) - MOST_CHARTS} more robots changed: see the table.", "note"))
    return charts


def _drift_chart(number: int, name: str, robot: RobotChart) -> Chart:
    alarm = robot.alarms[-1]
    frame = alarm.frames[0].name
    days = np.array([(when - robot.when_ns[0]) / DAY_NS for when in robot.when_ns])
    moved = _millimetres(robot, frame, alarm)
    odds = np.array([1.0 / max(test.chance, LEAST_CHANCE) for test in robot.tests])
    limits = np.array([1.0 / test.limit if test.limit > 0.0 else math.nan for test in robot.tests])
    alarmed = np.isin(robot.when_ns, [each.when_ns for each in robot.alarms])
    changes = [(each.first_changed_ns - robot.when_ns[0]) / DAY_NS for each in robot.alarms]

    def draw(figure: Figure) -> None:
        upper, lower = figure.subplots(2, 1, sharex=True)
        upper.plot(days, odds, "o-", color=BLUE, markersize=2.5, linewidth=0.8)
        upper.plot(days[alarmed], odds[alarmed], "D", color=VERMILLION, markersize=5)
        upper.plot(days, limits, "--", color=INK, linewidth=0.8)
        upper.set_yscale("log")
        powers = np.arange(0, int(math.log10(odds.max())) + 2, 2 if odds.max() < 1e8 else 4)
        upper.set_yticks(10.0**powers, [f"{10**power:,}" if power < 6 else f"1e{power}" for power in powers])
        upper.minorticks_off()
        upper.set_ylabel("one in")
        lower.plot(days, moved, "o", color=BLUE, markersize=2.5)
        lower.plot(days[alarmed], moved[alarmed], "D", color=VERMILLION, markersize=5)
        lower.set_ylim(bottom=0.0)
        lower.set_ylabel(f"{shortened(frame, 14)} (mm)")
        lower.set_xlabel(f"days since {day_text(robot.when_ns[0])}")
        for axes in (upper, lower):
            for change in changes:
                axes.axvline(change - 0.5, color=VERMILLION, linewidth=1.0)

    return Chart(name=f"drift-{number}", title=shown(name), says=str(alarm), svg=svg_figure(draw, 3.4))


def _millimetres(robot: RobotChart, frame: str, alarm: AlarmEvent) -> np.ndarray:
    """For each night, the distance (mm) of a frame from its position before the last change; nan if unknown."""
    own = np.stack([x[robot.frames.groups[frame]] for x in robot.x])
    known = np.asarray(np.isfinite(own).all(axis=1))
    earlier = [each.first_changed_ns for each in robot.alarms[:-1]]
    when = np.array(robot.when_ns)
    before = known & (when < alarm.first_changed_ns) & (when >= max(earlier, default=0))
    mean = own[before if bool(before.any()) else known].mean(axis=0)
    return np.array(
        [
            robot.frames.movement(frame, mean, each - mean).translation_mm if there else math.nan
            for each, there in zip(own, known, strict=True)
        ]
    )
