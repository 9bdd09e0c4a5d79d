"""A run over a fleet: list the logs, read each log, solve each robot or site, and collect the rows.

Tasks that an earlier run did are read from their receipts. If all tasks are done, no engine starts. A run changes only
result files and the table of rows in the output, so two runs at the same time do not disturb each other.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.metadata import version
from importlib.util import find_spec
from typing import TypeVar

from gtsam_rwhec.errors import (
    FileFormatError,
    ManifestError,
    ResultVersionError,
    RwhecError,
    StoreError,
    StoreInterruptedError,
)
from gtsam_rwhec.files.progress import Counted, Progress, Remark, check_progress, silent
from gtsam_rwhec.fleet.fleet_rows import (
    PARQUET_FILE,
    ROWS_FILE,
    FailedLog,
    RobotRow,
    read_rows,
    rows_json,
    rows_parquet,
)
from gtsam_rwhec.fleet.log_task import LogTask, map_log
from gtsam_rwhec.fleet.manifest import LogSource, Manifest, RigSource, Robot, read_rig_source
from gtsam_rwhec.fleet.stores import (
    exists,
    listed,
    local_path,
    read_bytes,
    shown,
    stamp_of,
    without_secrets,
    write_once,
)
from gtsam_rwhec.fleet.tasks import Engine, Failed, InProcess, Receipt, Task, below, kept_receipt
from gtsam_rwhec.fleet.unit_task import Answer, Each, UnitTask, solve_unit, write_results

#: This file has the version that wrote the output; it is written before the first task.
ABOUT_FILE = "about.json"
#: The most requests to stores at the same time.
THREADS = 16
_NOT_OF_NAMES = re.compile(r"[^A-Za-z0-9_.-]+")
Asked = TypeVar("Asked")
Told = TypeVar("Told")
Outcome = Receipt | Failed


@dataclass(frozen=True)
class FleetRun:
    """What a run found and did."""

    output: str  #: Its URL, without credentials
    #: Robots in the manifest's order, then sites; the calibrations of each in order of time
    rows: tuple[RobotRow, ...]
    logs: int  #: How many logs the manifest lists
    #: new_tasks, earlier_tasks: how many tasks this run did, and how many other runs had done
    new_tasks: int
    earlier_tasks: int
    #: seconds, cpu_s: duration of the run; CPU time of the tasks that this run did
    seconds: float
    cpu_s: float
    remarks: tuple[str, ...] = ()  #: What the user should know of the output

    @property
    def is_fine(self) -> bool:
        """Whether every log was read, and all poses may be used."""
        return all(row.is_fine for row in self.rows)


@dataclass(frozen=True)
class PlannedLog:
    """A log of a robot: the task that reads it, or why there is none."""

    robot: str
    url: str
    task: LogTask | None = None
    failure: str = ""


def run(
    manifest: Manifest,
    output: str,
    each: Each = "robot",
    engine: Engine | None = None,
    progress: Progress | None = None,
) -> FleetRun:
    """Calibrate every robot of a fleet.

    Parameters
    ----------
    manifest : Manifest
    output : str
        A folder, or a URL of fsspec; it is made if needed. Files of another version or of another rig file stay
        there and are not used.
    each : "robot", "day" or "log"
        What is solved together: all logs of a robot or of a site, the logs of a day (UTC), or each log alone.
    engine : Engine, optional
        By default this process. The caller closes it.
    progress : callable, optional
        Called with each stage, which has a count.

    Raises
    ------
    RigError
        The rig file of all robots cannot be read.
    ManifestError
        Two robots have the same log.
    StoreError
        The output cannot be written.
    """
    check_progress(progress)
    try:
        return _run(manifest, output, each, engine or InProcess(), progress or silent)
    except StoreInterruptedError as error:
        raise StoreError(f"{error}. What is done is kept: run again to go on from there") from error


def read_fleet(output: str) -> tuple[RobotRow, ...]:
    """The rows of the last run in an output; a FileFormatError if there are none or their version differs."""
    url = below(output, ROWS_FILE)
    return read_rows(read_bytes(url), shown(url))


def _run(manifest: Manifest, output: str, each: Each, engine: Engine, tell: Progress) -> FleetRun:
    began_s = time.monotonic()
    tell("looking for logs")
    logs = planned_logs(manifest)
    remarks = _of_earlier_rows(output)
    for remark in remarks:
        tell(Remark(remark))

    def carried_out(tasks: Sequence[LogTask | UnitTask], function: Callable[..., Receipt], what: str) -> list[Outcome]:
        tell("looking for what is done already")
        kept = _many(lambda task: kept_receipt(output, task.key, task.file), tasks)
        outcomes: dict[str, Outcome] = {receipt.key: receipt for receipt in kept if receipt is not None}
        new = [Task(task.key, function, (task, output)) for task in tasks if task.key not in outcomes]
        if new:
            # Check first that the output can be written: the run may take hours.
            write_once(below(output, ABOUT_FILE), json.dumps({"gtsam-rwhec fleet": version("gtsam-rwhec")}).encode())
            tell(Counted(what, 0, len(new)))
            for done, outcome in enumerate(engine.run(new), 1):
                outcomes[outcome.key] = outcome
                tell(Counted(what, done, len(new)))
        return [outcomes[task.key] for task in tasks]

    read_tasks = [log.task for log in logs if log.task is not None]
    read = carried_out(read_tasks, map_log, "reading logs:")
    by_key = {outcome.key: outcome for outcome in read}
    units = _units(manifest, logs, by_key, each)
    solved = carried_out(units, solve_unit, "solving robots:")
    tell("putting the rows together")
    rows = _rows(manifest, logs, by_key, list(zip(units, solved, strict=True)), output)
    write_once(below(output, ROWS_FILE), rows_json(rows))
    if find_spec("pyarrow") is not None:
        write_once(below(output, PARQUET_FILE), rows_parquet(rows))
    receipts = [one for one in (*read, *solved) if isinstance(one, Receipt)]
    return FleetRun(
        output=shown(output),
        rows=rows,
        logs=len(logs),
        new_tasks=sum(not one.was_there for one in receipts),
        earlier_tasks=sum(one.was_there for one in receipts),
        seconds=time.monotonic() - began_s,
        cpu_s=sum(one.cpu_s for one in receipts if not one.was_there),
        remarks=remarks,
    )


def _many(function: Callable[[Asked], Told], of: Iterable[Asked]) -> list[Told]:
    """Send many requests to stores at the same time; the answers have the order of the requests."""
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(function, of))


def _of_earlier_rows(output: str) -> tuple[str, ...]:
    """The remark for an output with rows that this version does not read."""
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


def planned_logs(manifest: Manifest) -> list[PlannedLog]:
    """All logs of a manifest, each once. Raises as `run` does; a fault of one robot becomes a failure of its logs."""
    if manifest.shared_rig is not None:
        read_rig_source(manifest.shared_rig)
    entries = [(robot, source) for robot in manifest.robots for source in robot.logs]
    urls = list(dict.fromkeys(source.rig for _, source in entries))
    rigs = dict(zip(urls, _many(lambda url: _or_why(read_rig_source, url), urls), strict=True))
    expanded = [log for several in _many(_listed, entries) for log in several]
    owner: dict[str, tuple[str, str]] = {}
    for robot, url, rig, failure in expanded:
        first = owner.setdefault(url, (robot, rig))
        if not failure and first != (robot, rig):
            twice = f"{shown(manifest.where)}: {shown(url)} is a log of {first[0]}"
            if first[0] != robot:
                raise ManifestError(f"{twice} and of {robot}; a log is of one robot")
            raise ManifestError(f"{twice} with {shown(first[1])} and with {shown(rig)}; give it once")
    return _many(lambda log: _planned(*log, rigs), dict.fromkeys(expanded))


def _or_why(function: Callable[[str], Told], url: str) -> Told | str:
    """What a function says of a URL, or why it cannot."""
    try:
        return function(url)
    except (RwhecError, OSError) as error:
        return without_secrets(str(error))


def _listed(entry: tuple[Robot, LogSource]) -> list[tuple[str, str, str, str]]:
    """Robot, log, rig file and failure of each log of an entry."""
    robot, source = entry
    if not source.is_pattern:
        return [(robot.name, source.url, source.rig, "")]
    found = _or_why(listed, source.url)
    if not found:
        found = f"no log matches {shown(source.url)} ({source.place})"
    if isinstance(found, str):
        return [(robot.name, source.url, source.rig, found)]
    return [(robot.name, url, source.rig, "") for url in found]


def _planned(robot: str, url: str, rig_url: str, failure: str, rigs: Mapping[str, RigSource | str]) -> PlannedLog:
    rig = rigs[rig_url]
    if failure or isinstance(rig, str):
        return PlannedLog(robot, url, failure=failure or str(rig))
    task = _or_why(lambda url: _task(url, rig), url)
    return PlannedLog(robot, url, failure=task) if isinstance(task, str) else PlannedLog(robot, url, task)


def _task(url: str, rig: RigSource) -> LogTask:
    path = local_path(url)  # absolute: runs and workers may start in other folders
    return LogTask(url if path is None else os.path.abspath(path), stamp_of(url), rig)


def _units(manifest: Manifest, logs: Sequence[PlannedLog], read: Mapping[str, Outcome], each: Each) -> list[UnitTask]:
    """The units to solve, from the logs with a partial result."""
    of_robot: dict[str, list[PlannedLog]] = {robot.name: [] for robot in manifest.robots}
    for log in logs:
        of_robot[log.robot].append(log)
    if each == "log":
        named: list[tuple[str, str | None, list[PlannedLog]]] = [
            (name, None, [log])
            for robot, own in of_robot.items()
            for name, log in zip(_names(robot, own), own, strict=True)
        ]
    else:
        named = [(robot.name, None, of_robot[robot.name]) for robot in manifest.robots if robot.site is None]
        named += [
            (site, site, [log for robot in robots for log in of_robot[robot.name]])
            for site, robots in manifest.sites.items()
        ]
    units = []
    for name, site, own in named:
        done = [(log.robot, log.task, read[log.task.key]) for log in own if log.task is not None]
        there = [(robot, receipt) for robot, _, receipt in done if isinstance(receipt, Receipt)]
        rigs = {(robot, task.rig.sha256): task.rig for robot, task, _ in sorted(done, key=lambda one: one[0])}
        if there:
            sources = tuple((robot, rig) for (robot, _), rig in rigs.items())
            units.append(UnitTask(name, site, tuple(sorted(there, key=lambda one: one[1].key)), sources, each))
    return units


def _names(robot: str, logs: Sequence[PlannedLog]) -> list[str]:
    """A unique name for each log: the file's name, with a number if several files share it."""
    taken: Counter[str] = Counter()
    names = []
    for log in logs:
        stem = shown(log.url).rpartition("/")[2].removesuffix(".mcap")
        name = f"{robot}@{_NOT_OF_NAMES.sub('_', stem)}"
        taken[name] += 1
        names.append(name if taken[name] == 1 else f"{name}.{taken[name]}")
    return names


def _rows(
    manifest: Manifest,
    logs: Sequence[PlannedLog],
    read: Mapping[str, Outcome],
    solved: Sequence[tuple[UnitTask, Outcome]],
    output: str,
) -> tuple[RobotRow, ...]:
    """All rows, in the manifest's order, with costs and failures."""
    failed_logs: dict[str, list[FailedLog]] = {}
    for log in logs:
        outcome = None if log.task is None else read[log.task.key]
        reason = log.failure if outcome is None else outcome.reason if isinstance(outcome, Failed) else ""
        if reason:
            failed_logs.setdefault(log.robot, []).append(FailedLog(shown(log.url), reason))
    rows: list[RobotRow] = []
    for (unit, _), found in zip(solved, _many(lambda one: _answer_rows(*one, output), solved), strict=True):
        of_robot = unit.each == "robot"
        rows += [replace(row, failed_logs=tuple(failed_logs.get(row.robot, ()))) if of_robot else row for row in found]
    answered, apart = {row.robot for row in rows}, any(unit.each != "robot" for unit, _ in solved)
    for robot in manifest.robots:
        failed = failed_logs.get(robot.name, [])
        if failed and (robot.name not in answered or apart):
            more = f" (and {len(failed) - 1} more)" if len(failed) > 1 else ""
            words = f"no calibration from {failed[0].url}{more}: {failed[0].reason}"
            rows.append(RobotRow(robot.name, robot.name, robot.site, failed_logs=tuple(failed), failure=words))
    place = {robot.name: i for i, robot in enumerate(manifest.robots)}
    return tuple(sorted(rows, key=lambda row: (row.site or "", place[row.robot], row.begin_ns or 0, row.unit)))


def _answer_rows(unit: UnitTask, outcome: Outcome, output: str) -> list[RobotRow]:
    """The rows of a unit's answer with its costs; without an answer, a row of failure for each robot with a log."""
    if isinstance(outcome, Failed):
        robots = dict.fromkeys(robot for robot, _ in unit.rigs)
        return [RobotRow(unit.name, robot, unit.site, failure=outcome.reason) for robot in robots]
    answer = Answer.read(read_bytes(below(output, outcome.file)), outcome.file)
    if outcome.was_there:
        write_results(output, answer)
    return [
        replace(row, cpu_s=row.cpu_s + outcome.cpu_s, peak_bytes=max(row.peak_bytes, outcome.peak_bytes))
        for row in answer.rows
    ]
