"""The reduction: one robot, or the robots of a site, solved from the moments of their logs, or from measurements."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.fleet.consistency import check_rigs
from gtsam_rwhec.fleet.container import packed, unpacked
from gtsam_rwhec.fleet.measured_problem import measured_problem
from gtsam_rwhec.fleet.measured_task import measured_task
from gtsam_rwhec.fleet.merging import Member, Merged, content_key, content_of, in_order, merged, read_leaf, read_sum
from gtsam_rwhec.fleet.partial import checksum
from gtsam_rwhec.fleet.receipts import below, keep_receipt, kept_receipt
from gtsam_rwhec.fleet.rig_source import RigSource
from gtsam_rwhec.fleet.rows import RobotRow, read_rows, rows_json
from gtsam_rwhec.fleet.stores import write_once
from gtsam_rwhec.fleet.tasks import Failed, Receipt
from gtsam_rwhec.fleet.unit_calibration import calibrated, joined_rig
from gtsam_rwhec.fleet.unit_rows import result_file, rows_of
from gtsam_rwhec.rig import Rig

FOLDER = "answers"
#: What is solved together: all logs of a robot (or of a site), those of a day (UTC), or each log alone.
Each = Literal["robot", "day", "log"]


@dataclass(frozen=True)
class UnitTask:
    """What one task solves.

    Attributes
    ----------
    name : str
        The robot, the site, or the log's name.
    site : str or None
        Whether it is a site, and which.
    members : tuple of Member
        The logs among its inputs; the others are sums.
    inputs : tuple of str
        Keys of the tasks that it comes after, in the order of the tree.
    rigs : tuple of (robot, RigSource)
        Each rig file of each robot once.
    each : "robot", "day" or "log"
    refine : bool
        From the measurements.
    """

    name: str
    site: str | None
    members: tuple[Member, ...]
    inputs: tuple[str, ...]
    rigs: tuple[tuple[str, RigSource], ...]
    each: Each = "robot"
    refine: bool = False

    @property
    def key(self) -> str:
        """The key of the task; its file is named by what it was made from."""
        logs = (f"{member.robot} {member.key}" for member in self.members)
        return content_key("unit", self.name, self.each, str(self.refine), *logs, *self.inputs)

    def file(self, outcomes: Sequence[Receipt | Failed]) -> str:
        """The place of the answer from some outcomes below the output."""
        rigs = [f"{robot} {source.sha256}" for robot, source in self.rigs]
        parts = content_of(self.members, self.inputs, outcomes)
        key = content_key(version("gtsam-rwhec"), self.name, str(self.site), self.each, str(self.refine), *rigs, *parts)
        return f"{FOLDER}/{key}.answer"


@dataclass(frozen=True)
class Answer:
    """What a task's file holds: rows, and the content of a result file for each unit."""

    rows: tuple[RobotRow, ...]
    results: dict[str, str]


def read_answer(content: bytes, where: str) -> Answer:
    """An answer from the bytes of its file; a FileFormatError where it is damaged."""
    facts, _ = unpacked(content, "answer", where)
    try:
        return Answer(read_rows(facts["rows"].encode("utf-8", "surrogateescape"), where), facts["results"])
    except KeyError as error:
        raise FileFormatError(f"{where} is no answer of this version; remove it, and run again") from error


def solve_unit(
    task: UnitTask, output: str, earlier: tuple[Receipt, ...], done: tuple[Receipt | Failed, ...] = ()
) -> Receipt:
    """Solve a unit from what the tasks before it wrote; write its result files.

    Parameters
    ----------
    task : UnitTask
    output : str
        URL of the run's output.
    earlier : tuple of Receipt
        Of the inputs that an earlier run has done.
    done : tuple of Receipt or Failed
        Of the others.

    Raises
    ------
    LogError
        No log gave a partial result.
    RigError
        Rig files or logs contradict each other.
    RwhecError
        As ``calibrate`` does.
    """
    outcomes = earlier + done
    file = task.file(outcomes)
    kept = kept_receipt(output, file)
    if kept is not None:
        return replace(kept, key=task.key)
    with measured_task(task.key) as measured, TemporaryDirectory(prefix="gtsam-rwhec-") as temporary:
        answer = _answer(task, output, outcomes, Path(temporary))
        facts = {"rows": rows_json(answer.rows).decode("utf-8", "surrogateescape"), "results": answer.results}
        content = packed("answer", facts, {})
        write_results(output, answer)
        write_once(below(output, file), content)
        receipt = measured.receipt(file, checksum(content))
    return keep_receipt(output, receipt)


def write_results(output: str, answer: Answer) -> None:
    """Write the result files of an answer where they are not there, or are those of another run."""
    for unit, text in answer.results.items():
        write_once(below(output, result_file(unit)), text.encode("utf-8", "surrogateescape"))


def _answer(task: UnitTask, output: str, outcomes: tuple[Receipt | Failed, ...], folder: Path) -> Answer:
    sources: dict[str, list[tuple[str, Rig]]] = {}
    for number, (robot, source) in enumerate(task.rigs):
        place = folder / str(number)
        place.mkdir()
        sources.setdefault(robot, []).append((source.url, source.rig(place)))
    check_rigs(sources)
    rigs = {robot: joined_rig([rig for _, rig in several]) for robot, several in sources.items()}
    units = _by_day(task, output, outcomes) if task.each == "day" else {task.name: read_sum(output, task, outcomes)}
    rows: list[RobotRow] = []
    results: dict[str, str] = {}
    at_site = task.site is not None
    for unit, one in units.items():
        measured = measured_problem(one, rigs, output, at_site=at_site)
        found = calibrated(one, rigs, measured, refine=task.refine, at_site=at_site)
        results[unit] = found.result.decode("utf-8", "surrogateescape")
        rows += rows_of(unit, task.site, one, found)
    return Answer(tuple(rows), results)


def _by_day(task: UnitTask, output: str, outcomes: tuple[Receipt | Failed, ...]) -> dict[str, Merged]:
    """The sum of each day's logs, by the UTC date of their first measurements."""
    robot = {member.key: member.robot for member in task.members}
    days: dict[str, list[Merged]] = {}
    for one in in_order(task.inputs, outcomes):
        leaf = read_leaf(output, one, robot[one.key], at_site=task.site is not None)
        days.setdefault(_day(leaf.logs[0].facts.begin_ns), []).append(leaf)
    return {f"{task.name}@{day}": merged(found) for day, found in sorted(days.items())}


def _day(stamp_ns: int) -> str:
    return datetime.datetime.fromtimestamp(stamp_ns // 10**9, datetime.UTC).date().isoformat()
