"""The summary page over all robots of a fleet: how many may be used, which may not and why, and what it cost."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.files.terminal_text import shown
from gtsam_rwhec.files.whole_files import checked_path
from gtsam_rwhec.fleet.receipts import below
from gtsam_rwhec.fleet.rows import RobotRow
from gtsam_rwhec.fleet.stores import write_once
from gtsam_rwhec.fleet.summary_charts import cost_chart, uncertainty_chart
from gtsam_rwhec.fleet.watch_events import day_text
from gtsam_rwhec.fleet.watch_page import alarm_table, drift_charts
from gtsam_rwhec.fleet.watch_words import remarks, verdict
from gtsam_rwhec.fleet.watching import Watched, watch
from gtsam_rwhec.report.html_page import page_html, write_page
from gtsam_rwhec.report.report_blocks import Block, Chart, Link, Listing, Number, Page, Paragraph, Section, Table, Words

#: Robots that are named one by one, and reasons that are.
WORST, REASONS = 10, 12
MADE_BY = "Written by gtsam-rwhec fleet run."
#: The page, below a run's output.
SUMMARY_FILE = "summary.html"
#: The file of rows that numbers of the page come from.
ROWS_FILE = "fleet.json"


def write_summary(rows: Sequence[RobotRow], path: str | Path, watched: Watched | None = None) -> None:
    """Write the summary as one HTML file that needs no network.

    Parameters
    ----------
    rows : sequence of RobotRow
    path : str or Path
        The HTML file in the run's output, so that its links lead to the results; an existing file is replaced.
    watched : Watched, optional
        Where there is a history: the page says what drifted.

    Raises
    ------
    FileFormatError
        The file cannot be written.
    """
    write_page(summary_page(rows, watched), checked_path(path))


def put_summary(rows: Sequence[RobotRow], output: str) -> str:
    """Write the summary into a run's output, a folder or a URL, and give its place there.

    Where a robot has several calibrations (``--each day``), the page says what moved between them.

    Raises
    ------
    StoreError
        The output cannot be written.
    """
    times = Counter(row.robot for row in rows if row.begin_ns is not None)
    watched = watch(rows) if max(times.values(), default=0) > 1 else None
    url = below(output, SUMMARY_FILE)
    write_once(url, f"{page_html(summary_page(rows, watched))}\n".encode("utf-8", "replace"))
    return url


def summary_page(rows: Sequence[RobotRow], watched: Watched | None = None) -> Page:
    """The page."""
    counts = Counter(row.verdict for row in rows)
    has_drifted = watched is not None and bool(watched.alarms)
    is_bad = bool(counts[None] or counts[Verdict.DO_NOT_USE])
    has_failures = any(row.failed_logs for row in rows)
    needs_care = bool(counts[Verdict.CARE]) or has_drifted or has_failures or not rows
    tone: Literal["good", "care", "bad"] = "bad" if is_bad else "care" if needs_care else "good"
    first: list[Block] = [Paragraph(counts_in_words(rows), tone)]
    steps = _what_to_do(rows, watched)
    if steps:
        first.append(Listing(tuple(steps)))
    sections = [Section("verdict", "The verdict", tuple(first))]
    worst = _worst(rows)
    if worst:
        sections.append(Section("worst", "The worst robots", (worst,)))
    if watched is not None and watched.robots:
        drift: list[Block] = [
            Paragraph(verdict(watched), "bad" if watched.alarms else "good"),
            Listing(remarks(watched)),
        ]
        if watched.alarms:
            drift += [alarm_table(list(reversed(watched.alarms))), *drift_charts(watched)]
        sections.append(Section("drift", "What moved over time", tuple(drift)))
    failures = _failures(rows)
    if failures:
        sections.append(Section("failures", "What failed, and why", failures))
    charts: list[Chart] = [chart for chart in (uncertainty_chart(rows), cost_chart(rows)) if chart is not None]
    if charts:
        sections.append(Section("figures", "How well, and at what cost", tuple(charts)))
    if rows:
        sections.append(Section("robots", "All robots", (_table(rows),)))
    return Page(title="A fleet's calibrations", tone=tone, sections=tuple(sections), made_by=MADE_BY)


def counts_in_words(rows: Sequence[RobotRow]) -> str:
    """How many calibrations may be used, in a sentence."""
    if not rows:
        return "There is no robot in this run."
    counts = Counter(row.verdict for row in rows)
    said = [
        (counts[Verdict.USE], "may be used"),
        (counts[Verdict.CARE], "may be used with care"),
        (counts[Verdict.DO_NOT_USE], "must not be used"),
        (counts[None], "failed"),
    ]
    words = [f"{count} {what}" for count, what in said if count]
    robots = len({row.robot for row in rows})
    return f"Of {_many(len(rows), 'calibration')} of {_many(robots, 'robot')}, {', '.join(words)}."


def _what_to_do(rows: Sequence[RobotRow], watched: Watched | None) -> list[Words]:
    steps: list[Words] = []
    if any(row.verdict is None for row in rows):
        steps.append("Robots without a calibration: see below why, mend it, and run again. What is done stays.")
    lost = sum(len(row.failed_logs) for row in rows)
    if lost:
        steps.append(f"{_many(lost, 'log')} gave nothing, and the answers rest on the others: see below.")
    if any(row.verdict is Verdict.DO_NOT_USE for row in rows):
        steps.append("Poses that must not be used: do what each robot's reason says, and record again.")
    if any(row.verdict is Verdict.CARE for row in rows):
        steps.append("Poses to be used with care: read the reason in the table first.")
    if watched is not None and watched.alarms:
        steps.append("Robots that drifted: look at the mounts of the frames that are named.")
    return steps


def _worst(rows: Sequence[RobotRow]) -> Table | None:
    """Those that must not be used, then those with care, the least certain first."""
    order = {Verdict.DO_NOT_USE: 0, Verdict.CARE: 1}
    bad = sorted(
        (row for row in rows if row.verdict in order),
        key=lambda row: (order[row.verdict], -_uncertainty_mm(row), row.unit),  # type: ignore[index]
    )
    if not bad:
        return None
    more = f" {len(bad) - WORST} more are in the table of all robots." if len(bad) > WORST else ""
    cells = tuple((_name(row), _verdict(row), row.reason) for row in bad[:WORST])
    return Table(
        "Poses that must not be used first, the least certain first", ("calibration", "verdict", "why"), cells, more
    )


def _failures(rows: Sequence[RobotRow]) -> tuple[Block, ...]:
    blocks: list[Block] = []
    failed = [row for row in rows if row.verdict is None]
    if failed:
        reasons: dict[str, list[str]] = {}
        for row in failed:
            reasons.setdefault(row.failure or row.reason or "no reason is known", []).append(shown(row.unit))
        blocks.append(
            Table(
                "Without a calibration, by reason",
                ("reason", "which"),
                tuple((reason, _some(names)) for reason, names in reasons.items()),
            )
        )
    logs = [(row, log) for row in rows for log in row.failed_logs]
    if logs:
        blocks.append(
            Table(
                "Logs that gave nothing",
                ("log", "calibration", "why"),
                tuple((shown(log.url), _name(row), log.reason) for row, log in logs),
                sorts=len(logs) > REASONS,
            )
        )
    return tuple(blocks)


def _table(rows: Sequence[RobotRow]) -> Table:
    several = len({row.robot for row in rows}) < len(rows)
    has_site = any(row.site for row in rows)
    headings = (
        "calibration", "verdict", *(["site"] if has_site else []), *(["day (UTC)"] if several else []), "position (mm)",
        "rotation (degrees)", "logs", "failed logs", "measurements", "CPU (s)", "read (MB)", "memory (MB)", "reason",
    )  # fmt: skip
    return Table(
        "Every calibration; a click on a heading sorts",
        headings,
        tuple(_cells(i, row, has_site=has_site, several=several) for i, row in enumerate(rows)),
        "Position and rotation: the largest standard deviation of any frame along or about an axis; free where one is "
        "not determined. CPU and bytes are of all tasks of the calibration, memory of the largest.",
        sorts=True,
    )


def _cells(i: int, row: RobotRow, *, has_site: bool, several: bool) -> tuple[Words, ...]:
    def number(field: str, value: float | None, times: float = 1.0, spec: str = ".3g") -> Number:
        return Number(f"{ROWS_FILE}#/rows/{i}/{field}", value, times, spec)

    rotation, position = _deviations(row)
    return (
        _name(row),
        _verdict(row),
        *([row.site or ""] if has_site else []),
        *(["" if row.begin_ns is None else day_text(row.begin_ns)] if several else []),
        "" if position is None else number("covariance", _finite(position), 1e3),
        "" if rotation is None else number("covariance", _finite(rotation), 180.0 / math.pi),
        number("logs", row.logs, spec=".0f"),
        number("failed_logs", len(row.failed_logs), spec=".0f"),
        number("measurements", row.measurements, spec=".0f"),
        number("cpu_s", row.cpu_s),
        number("bytes_read", row.bytes_read, 1e-6),
        number("peak_bytes", row.peak_bytes, 1e-6),
        row.failure or row.reason,
    )


def _name(row: RobotRow) -> Words:
    return Link(shown(row.unit), row.result) if row.result else shown(row.unit)


def _verdict(row: RobotRow) -> str:
    if row.verdict is None:
        return "failed"
    return {Verdict.USE: "use", Verdict.CARE: "with care", Verdict.DO_NOT_USE: "do not use"}[row.verdict]


def _deviations(row: RobotRow) -> tuple[float | None, float | None]:
    """The largest standard deviations of a rotation (rad) and a position (m); None without covariances."""
    if row.covariance is None or not len(row.covariance):
        return None, None
    variances = np.diagonal(row.covariance).reshape(-1, 6)
    return math.sqrt(variances[:, :3].max()), math.sqrt(variances[:, 3:].max())


def _uncertainty_mm(row: RobotRow) -> float:
    position = _deviations(row)[1]
    return math.inf if position is None else 1e3 * position


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _many(count: int, what: str) -> str:
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def _some(names: list[str]) -> str:
    return ", ".join(names[:REASONS]) + (f", and {len(names) - REASONS} more" if len(names) > REASONS else "")
