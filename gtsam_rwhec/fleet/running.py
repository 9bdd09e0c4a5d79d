"""A run over a fleet: plan, map the logs, merge, solve, and put the rows together.

What an earlier run did is read from its receipts and not given to the engine; a run that finds everything done starts
no engine. Nothing in the output is changed but result files and the table of rows, so two runs at once agree.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from importlib.util import find_spec

from gtsam_rwhec.errors import FileFormatError, ResultVersionError, StoreError, StoreInterruptedError
from gtsam_rwhec.files.progress import Counted, Progress, Remark, check_progress, silent
from gtsam_rwhec.fleet.in_process import InProcess
from gtsam_rwhec.fleet.manifest import Manifest
from gtsam_rwhec.fleet.map_log import LogTask, map_log
from gtsam_rwhec.fleet.merging import MergeTask, in_order, merge_task
from gtsam_rwhec.fleet.parquet import rows_parquet
from gtsam_rwhec.fleet.planning import FleetOptions, Plan, PlannedLog, many, planned
from gtsam_rwhec.fleet.receipts import below, kept_receipt
from gtsam_rwhec.fleet.rows import FailedLog, RobotRow, read_rows, rows_json
from gtsam_rwhec.fleet.solve_robot import UnitTask, read_answer, solve_unit, write_results
from gtsam_rwhec.fleet.stores import exists, read_bytes, write_once
from gtsam_rwhec.fleet.tasks import Engine, Failed, Receipt, Task
from gtsam_rwhec.fleet.without_secrets import shown

#: Which version wrote the output; written before the first task.
ABOUT_FILE = "about.json"
#: All rows of the last run, below the output.
ROWS_FILE = "fleet.json"
#: The same for programs that read tables, where pyarrow is installed.
PARQUET_FILE = "fleet.parquet"


@dataclass(frozen=True)
class FleetRun:
    """What a run found and did.

    Attributes
    ----------
    output : str
        Its URL, without credentials.
    rows : tuple of RobotRow
        Robots in the manifest's order, sites after them; of each, calibrations in order of time.
    logs : int
        How many logs were asked for.
    new_tasks : int
        How many tasks this run did.
    earlier_tasks : int
        How many an earlier run, or another one, had done.
    seconds : float
        On the clock.
    cpu_s : float
        Of the tasks that this run did.
    remarks : tuple of str
        What the user should know of the output.
    """

    output: str
    rows: tuple[RobotRow, ...]
    logs: int
    new_tasks: int
    earlier_tasks: int
    seconds: float
    cpu_s: float
    remarks: tuple[str, ...] = ()

    @property
    def is_fine(self) -> bool:
        """Whether every log was read, and all poses may be used."""
        return all(row.is_fine for row in self.rows)


def run(
    manifest: Manifest,
    output: str,
    options: FleetOptions | None = None,
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> FleetRun:
    """Calibrate every robot of a fleet.

    Parameters
    ----------
    manifest : Manifest
    output : str
        A folder, or a URL of fsspec. It is made where it is not there; files of another version, or of another rig
        file, stay and are not used.
    options : FleetOptions, optional
    engine : Engine, optional
        By default this process. The caller closes it.
    progress : callable, optional
        Is called with each stage, counted.

    Raises
    ------
    RigError
        The rig file of all robots cannot be read.
    ManifestError
        A log is said to be of two robots.
    StoreError
        The output cannot be written.
    """
    check_progress(progress)
    try:
        return _run(manifest, output, options or FleetOptions(), engine or InProcess(), progress or silent)
    except StoreInterruptedError as error:
        raise StoreError(f"{error}. What is done is kept: run again to go on from there") from error


def _run(manifest: Manifest, output: str, options: FleetOptions, engine: Engine, tell: Progress) -> FleetRun:
    began_s = time.monotonic()
    tell("looking for logs")
    plan = planned(manifest, options)
    remarks = _of_earlier_rows(output)
    for remark in remarks:
        tell(Remark(remark))
    tell("looking for what is done already")
    outcomes = _earlier(plan, output)
    tasks = _tasks(plan, output, outcomes)
    if tasks:
        # Hours of work are not begun for an output that cannot be written.
        write_once(below(output, ABOUT_FILE), json.dumps({"gtsam-rwhec fleet": version("gtsam-rwhec")}).encode())
        _carry_out(tasks, engine, outcomes, plan, tell)
    tell("putting the rows together")
    rows = _rows(manifest, plan, output, outcomes)
    write_once(below(output, ROWS_FILE), rows_json(rows))
    if find_spec("pyarrow") is not None:
        write_once(below(output, PARQUET_FILE), rows_parquet(rows))
    found = [one for one in outcomes.values() if isinstance(one, Receipt)]
    return FleetRun(
        output=shown(output),
        rows=rows,
        logs=len(plan.logs),
        new_tasks=sum(not one.was_there for one in found),
        earlier_tasks=sum(one.was_there for one in found),
        seconds=time.monotonic() - began_s,
        cpu_s=sum(one.cpu_s for one in found if not one.was_there),
        remarks=remarks,
    )


def read_fleet(output: str) -> tuple[RobotRow, ...]:
    """The rows of the last run in an output; a FileFormatError where there is none, or of another version."""
    url = below(output, ROWS_FILE)
    return read_rows(read_bytes(url), shown(url))


def _of_earlier_rows(output: str) -> tuple[str, ...]:
    """What to say where the output has rows that this version does not read."""
    if not exists(below(output, ROWS_FILE)):
        return ()
    try:
        read_fleet(output)
    except ResultVersionError as error:
        return (
            f"{error}. They are not used: everything is done anew, beside the partial results of the other version, "
            f"and {ROWS_FILE} is replaced by the rows of gtsam-rwhec {version('gtsam-rwhec')}",
        )
    except FileFormatError as error:
        return (f"{error}; it is replaced",)
    return ()


Outcomes = dict[str, Receipt | Failed]


def _earlier(plan: Plan, output: str) -> Outcomes:
    """The receipts of what is done already; those of sums and answers where all that they are made of is done."""
    outcomes: Outcomes = {}
    logs = [log.task for log in plan.logs if log.task is not None]

    def note(tasks: Sequence[LogTask | MergeTask | UnitTask], files: Sequence[str]) -> None:
        for task, kept in zip(tasks, many(lambda file: kept_receipt(output, file), files), strict=True):
            if kept is not None:
                outcomes[task.key] = replace(kept, key=task.key)

    note(logs, [task.file for task in logs])
    for merge in plan.merges:
        if all(key in outcomes for key in merge.inputs):
            note([merge], [merge.file(_of(merge.inputs, outcomes))])
    units = [unit for unit in plan.units if all(key in outcomes for key in unit.inputs)]
    note(units, [unit.file(_of(unit.inputs, outcomes)) for unit in units])
    return outcomes


def _of(keys: Sequence[str], outcomes: Mapping[str, Receipt | Failed]) -> tuple[Receipt | Failed, ...]:
    return tuple(outcomes[key] for key in keys if key in outcomes)


def _tasks(plan: Plan, output: str, outcomes: Outcomes) -> list[Task]:
    """The tasks that are left; each gets the receipts of its inputs that are there as an argument."""
    tasks = {
        log.task.key: Task(log.task.key, map_log, (log.task, output))
        for log in plan.logs
        if log.task is not None and log.task.key not in outcomes
    }
    for function, later in ((merge_task, plan.merges), (solve_unit, plan.units)):
        for task in later:
            if task.key not in outcomes:
                there = tuple(one for one in _of(task.inputs, outcomes) if isinstance(one, Receipt))
                after = tuple(key for key in task.inputs if key not in outcomes)
                tasks[task.key] = Task(task.key, function, (task, output, there), after)
    return list(tasks.values())


def _carry_out(tasks: Sequence[Task], engine: Engine, outcomes: Outcomes, plan: Plan, tell: Progress) -> None:
    logs = {log.task.key for log in plan.logs if log.task is not None}
    total = {True: sum(task.key in logs for task in tasks), False: sum(task.key not in logs for task in tasks)}
    done = {True: 0, False: 0}
    what = {True: "reading logs:", False: "solving robots:"}
    tell(Counted(what[total[True] > 0], 0, total[total[True] > 0]))
    for outcome in engine.run(tasks):
        outcomes[outcome.key] = outcome
        is_log = outcome.key in logs
        done[is_log] += 1
        shown_now = is_log or done[True] == total[True]
        tell(Counted(what[shown_now and is_log], done[is_log], total[is_log]) if shown_now else what[False])


def _rows(manifest: Manifest, plan: Plan, output: str, outcomes: Outcomes) -> tuple[RobotRow, ...]:
    """All rows, in the manifest's order, with costs and failures."""
    failed_logs = _failed_logs(plan, outcomes)
    taken: set[tuple[str, str]] = set()
    rows: list[RobotRow] = []
    answers = many(lambda unit: _answer_rows(unit, output, outcomes), plan.units)
    for unit, found in zip(plan.units, answers, strict=True):
        for row in found:
            rows.append(_with_costs(row, outcomes, unit))
            if unit.each == "robot" and row.robot in failed_logs:
                rows[-1] = replace(rows[-1], failed_logs=tuple(failed_logs[row.robot]))
            taken.add((unit.name, row.robot))
    answered = {row.robot for row in rows}
    for robot in manifest.robots:
        failed = failed_logs.get(robot.name, [])
        if failed and (robot.name not in answered or any(unit.each != "robot" for unit in plan.units)):
            rows.append(_failed_row(robot.name, robot.site, failed))
    place = {robot.name: i for i, robot in enumerate(manifest.robots)}
    return tuple(sorted(rows, key=lambda row: (row.site or "", place[row.robot], row.begin_ns or 0, row.unit)))


def _failed_logs(plan: Plan, outcomes: Outcomes) -> dict[str, list[FailedLog]]:
    """Logs that gave nothing, by robot."""
    found: dict[str, list[FailedLog]] = {}
    for log in plan.logs:
        reason = _failure(log, outcomes)
        if reason:
            found.setdefault(log.robot, []).append(FailedLog(shown(log.url), reason))
    return found


def _failure(log: PlannedLog, outcomes: Outcomes) -> str:
    if log.task is None:
        return log.failure
    outcome = outcomes.get(log.task.key)
    if isinstance(outcome, Failed):
        return outcome.reason
    return "" if outcome is not None else "the engine ended before it was read; run again"


def _answer_rows(unit: UnitTask, output: str, outcomes: Outcomes) -> list[RobotRow]:
    """The rows of a unit's answer, or one of failure for each of its robots that has a log."""
    outcome = outcomes.get(unit.key)
    if isinstance(outcome, Receipt):
        answer = read_answer(read_bytes(below(output, outcome.file)), outcome.file)
        if outcome.was_there:
            write_results(output, answer)
        return list(answer.rows)
    if not in_order(unit.inputs, list(outcomes.values())):
        return []  # all logs failed: the robot's row says why
    reason = outcome.reason if isinstance(outcome, Failed) else "the engine ended before it was solved; run again"
    robots = dict.fromkeys(robot for robot, _ in unit.rigs)
    return [RobotRow(unit.name, robot, unit.site, failure=reason) for robot in robots]


def _failed_row(robot: str, site: str | None, failed: Sequence[FailedLog]) -> RobotRow:
    more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
    words = f"no calibration from {failed[0].url}{more}: {failed[0].reason}"
    return RobotRow(robot, robot, site, failed_logs=tuple(failed), failure=words)


def _with_costs(row: RobotRow, outcomes: Outcomes, unit: UnitTask) -> RobotRow:
    """The row with the costs of its logs' tasks, and of the unit's own."""
    keys = dict.fromkeys((*row.receipts, unit.key))
    receipts = [one for key in keys if isinstance(one := outcomes.get(key), Receipt)]
    return replace(
        row,
        cpu_s=sum(one.cpu_s for one in receipts),
        bytes_read=sum(one.bytes_read for one in receipts if one.key != unit.key),
        peak_bytes=max((one.peak_bytes for one in receipts), default=0),
        receipts=tuple(keys),
    )
