"""Merging partial results: a binary tree that the order of the keys fixes, so that every run has the same sums.

The leaves are in the order of their keys. Neighbours are added, then the sums of neighbours, and so on; the last of an
odd number goes up as it is. Who adds, and when, does not change a bit. Where there are many, chunks of the tree are
tasks of their own, whose files have the sums (`merge_task`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self, TypeVar

from pydantic import ValidationError

from gtsam_rwhec.errors import FileFormatError, LogError
from gtsam_rwhec.fleet.container import packed, unpacked
from gtsam_rwhec.fleet.log_facts import LogFacts, renamed
from gtsam_rwhec.fleet.measured_task import measured_task
from gtsam_rwhec.fleet.pair_moments import PairMoments
from gtsam_rwhec.fleet.partial import checksum, read_partial
from gtsam_rwhec.fleet.receipts import below, keep_receipt, kept_receipt
from gtsam_rwhec.fleet.stores import read_bytes, write_once
from gtsam_rwhec.fleet.tasks import Failed, Receipt

#: A task merges so many files: a power of two, so that chunks of the tree are subtrees of it.
CHUNK = 16
FOLDER = "merged"


@dataclass(frozen=True)
class MergedLog:
    """A log in a sum: its robot, the key of its partial result, and its facts with the names that the sum has."""

    robot: str
    key: str
    facts: LogFacts


@dataclass(frozen=True, eq=False)
class Merged:
    """The sum of the moments of some logs."""

    logs: tuple[MergedLog, ...]
    moments: PairMoments

    def added(self, other: Merged) -> Merged:
        """The sum of both."""
        return Merged(self.logs + other.logs, self.moments.added(other.moments))

    def packed(self) -> bytes:
        """The bytes of its file."""
        logs = [[log.robot, log.key, log.facts.model_dump(mode="json")] for log in self.logs]
        return packed("merged", {"logs": logs, "moments": self.moments.facts()}, self.moments.arrays())


@dataclass(frozen=True)
class Member:
    """A log of a unit: its robot, and the key of the task that maps it."""

    robot: str
    key: str


class Addable(Protocol):
    """Moments of logs, or what has them."""

    def added(self, other: Self, /) -> Self:
        """The sum of both."""
        ...


Sum = TypeVar("Sum", bound=Addable)


def merged(leaves: Sequence[Sum]) -> Sum:
    """The sum of all, at least one, by the tree over their order."""
    level = list(leaves)
    while len(level) > 1:
        above = [first.added(second) for first, second in zip(level[::2], level[1::2], strict=False)]
        level = above + level[len(level) - len(level) % 2 :]
    return level[0]


def sensor_name(robot: str, sensor: str) -> str:
    """The name of a robot's sensor where several robots are solved together."""
    return f"{robot}/{sensor}"


def read_leaf(output: str, receipt: Receipt, robot: str, *, at_site: bool) -> Merged:
    """The partial result of a log; at a site with the names of its sensors there."""
    partial = read_partial(read_bytes(below(output, receipt.file)), receipt.file)
    facts, moments = partial.facts, partial.moments
    if at_site:
        sensors = {*facts.detection.images, *(pair.sensor for pair in moments.pairs)}
        names = {sensor: sensor_name(robot, sensor) for sensor in sensors}
        facts, moments = renamed(facts, names), moments.renamed(names)
    return Merged((MergedLog(robot, receipt.key, facts),), moments)


def read_merged(output: str, receipt: Receipt) -> Merged:
    """A sum that `merge_task` wrote; a FileFormatError where it is damaged."""
    facts, arrays = unpacked(read_bytes(below(output, receipt.file)), "merged", receipt.file)
    try:
        logs = tuple(MergedLog(robot, key, LogFacts.model_validate(of)) for robot, key, of in facts["logs"])
        return Merged(logs, PairMoments.of_arrays(facts["moments"], arrays))
    except (ValidationError, KeyError, ValueError) as error:
        raise FileFormatError(f"{receipt.file} is no sum of this version; remove it, and run again") from error


def read_sum(output: str, task: Inputs, outcomes: Sequence[Receipt | Failed]) -> Merged:
    """The sum of the outcomes of a task's inputs; a LogError where all failed."""
    robot = {member.key: member.robot for member in task.members}
    found = [
        read_leaf(output, one, robot[one.key], at_site=task.site is not None)
        if one.key in robot
        else read_merged(output, one)
        for one in in_order(task.inputs, outcomes)
    ]
    if not found:
        raise LogError("none of its logs gave a partial result")
    return merged(found)


class Inputs(Protocol):
    """What `read_sum` asks of a task."""

    @property
    def members(self) -> tuple[Member, ...]:
        """The logs among its inputs."""
        ...

    @property
    def inputs(self) -> tuple[str, ...]:
        """Keys, in the order of the tree."""
        ...

    @property
    def site(self) -> str | None:
        """The site whose robots are solved together."""
        ...


@dataclass(frozen=True)
class MergeTask:
    """What one task adds.

    Attributes
    ----------
    members : tuple of Member
        The logs among its inputs; the others are sums.
    inputs : tuple of str
        Keys of the tasks that it comes after, in the order of the tree.
    site : str or None
        The site whose robots are solved together.
    """

    members: tuple[Member, ...]
    inputs: tuple[str, ...]
    site: str | None = None

    @property
    def key(self) -> str:
        """The key of the task; its file is named by what it was made from."""
        return content_key("merge", str(self.site), *(f"{m.robot} {m.key}" for m in self.members), *self.inputs)

    def file(self, outcomes: Sequence[Receipt | Failed]) -> str:
        """The place of the sum of some outcomes."""
        parts = content_of(self.members, self.inputs, outcomes)
        return f"{FOLDER}/{content_key('merged', str(self.site is not None), *parts)}.merged"


def merge_task(
    task: MergeTask, output: str, earlier: tuple[Receipt, ...], done: tuple[Receipt | Failed, ...] = ()
) -> Receipt:
    """Add what some tasks wrote; those that failed are left out.

    Parameters
    ----------
    task : MergeTask
    output : str
        URL of the run's output.
    earlier : tuple of Receipt
        Of the inputs that an earlier run has done.
    done : tuple of Receipt or Failed
        Of the others.

    Raises
    ------
    LogError
        All of them failed.
    """
    outcomes = earlier + done
    file = task.file(outcomes)
    kept = kept_receipt(output, file)
    if kept is not None:
        return replace(kept, key=task.key)
    with measured_task(task.key) as measured:
        content = read_sum(output, task, outcomes).packed()
        write_once(below(output, file), content)
        receipt = measured.receipt(file, checksum(content))
    return keep_receipt(output, receipt)


def in_order(inputs: Sequence[str], outcomes: Sequence[Receipt | Failed]) -> list[Receipt]:
    """The receipts among some outcomes, in the order of the inputs."""
    by_key = {one.key: one for one in outcomes}
    return [one for key in inputs if isinstance(one := by_key.get(key), Receipt)]


def content_of(members: Sequence[Member], inputs: Sequence[str], outcomes: Sequence[Receipt | Failed]) -> list[str]:
    """What the sum of outcomes depends on: files, and the robots of logs."""
    robot = {member.key: member.robot for member in members}
    return [f"{robot.get(one.key, '')} {one.file}" for one in in_order(inputs, outcomes)]


def content_key(*parts: str) -> str:
    """A key of some texts, as file names have them."""
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:40]
