"""A fleet's run on the terminal: how many robots may be used, the worst, what failed, where things are, its costs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from gtsam_rwhec.calibration.verdict import Verdict
from gtsam_rwhec.fleet.fleet_rows import ROWS_FILE, RobotRow
from gtsam_rwhec.fleet.fleet_run import FleetRun
from gtsam_rwhec.report.report_blocks import Table
from gtsam_rwhec.report.terminal_report import (
    STYLES,
    print_heading,
    print_list,
    print_sentence,
    print_tables,
    report_console,
)

#: So many robots and failures are named.
MOST_NAMED = 10
#: Characters of a reason in a list.
LONGEST_REASON = 600
HEADINGS = ("verdict", "logs", "n", "mm", "deg")
LEGEND = (
    "n: measurements. mm, deg: the largest standard deviation of a sensor's position along, and of its rotation about, "
    "one axis; - where the motion leaves it free."
)
_WORDS = {Verdict.USE: "may be used", Verdict.CARE: "to be used with care", Verdict.DO_NOT_USE: "not to be used"}


def print_fleet(run: FleetRun) -> None:
    """Print a run: verdicts first, then the worst, failures, places and costs."""
    console = report_console()
    print_sentence(console, summary(run.rows), STYLES[_worst(run.rows)])
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
    logs = f" {lost} log{'s' * (lost != 1)} could not be used." if lost else ""
    return f"{len(rows)} calibration{'s' * (len(rows) != 1)}: {', '.join(parts) or 'none'}.{logs}"


def worst_first(rows: Sequence[RobotRow]) -> list[RobotRow]:
    """The calibrations, those that are not to be used first, then by how well positions of sensors are known."""
    there = [row for row in rows if row.verdict is not None]
    order = list(Verdict)
    return sorted(there, key=lambda row: (-order.index(row.verdict), -row.largest_deviations("sensor")[1], row.unit))  # type: ignore[arg-type]


def failures_of(rows: Sequence[RobotRow]) -> list[str]:
    """Robots without a calibration, and logs that were left out, with their reasons."""
    failures = [f"{_name(row)}: {_short(row.failure)}" for row in rows if row.failure is not None]
    return failures + [
        f"{_name(row)}, {log.url}: {_short(log.reason)}"
        for row in rows
        if row.failure is None
        for log in row.failed_logs
    ]


def remarks_of(rows: Sequence[RobotRow]) -> list[str]:
    """What logs said of themselves where the poses may be used: a log that ends in the middle, for one."""
    return [f"{_name(row)}: {_short(words)}" for row in rows if row.verdict is Verdict.USE for words in row.findings]


def _worst(rows: Sequence[RobotRow]) -> Verdict:
    if not rows or any(row.failure is not None or row.verdict is Verdict.DO_NOT_USE for row in rows):
        return Verdict.DO_NOT_USE
    return Verdict.USE if all(row.is_fine and row.verdict is Verdict.USE for row in rows) else Verdict.CARE


def _name(row: RobotRow) -> str:
    return row.unit if row.site is None else f"{row.unit}, {row.robot}"


def _cells(rows: Sequence[RobotRow]) -> dict[str, tuple[str, ...]]:
    cells = {}
    for row in rows:
        turned, moved = row.largest_deviations("sensor")
        deviations = ("-" if math.isinf(value) else f"{value:.3g}" for value in (1e3 * moved, math.degrees(turned)))
        logs = str(row.logs) if not row.failed_logs else f"{row.logs} of {row.logs + len(row.failed_logs)}"
        words = "" if row.verdict is None else row.verdict.value.replace("_", " ")
        cells[_name(row)] = (words, logs, str(row.measurements), *deviations)
    return cells


def _short(words: str | None) -> str:
    text = words or ""
    return text if len(text) <= LONGEST_REASON else f"{text[:LONGEST_REASON]}..."


def _done(run: FleetRun) -> str:
    if not run.new_tasks and any(not row.is_fine and (row.failure or row.failed_logs) for row in run.rows):
        return f"Nothing new was computed; {run.earlier_tasks} files were there already. {run.seconds:.1f} s."
    if not run.new_tasks:
        return f"Everything was done already ({run.earlier_tasks} files); nothing was computed. {run.seconds:.1f} s."
    earlier = f" {run.earlier_tasks} were there already." if run.earlier_tasks else ""
    read = sum(row.bytes_read for row in run.rows)
    peak = max((row.peak_bytes for row in run.rows), default=0)
    return (
        f"{run.new_tasks} tasks done in {run.seconds:.1f} s ({run.cpu_s:.1f} s of processors).{earlier} "
        f"{read / 1e6:.3g} MB of logs read, {peak / 1e6:.0f} MB of memory at most."
    )
