"""Tasks in this process: their order, what is tried again, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from engine_checks import check_order_and_failures
from tasks_of_tests import writes

from gtsam_rwhec import fleet
from gtsam_rwhec.errors import FleetError
from gtsam_rwhec.fleet.in_process import InProcess


def test_order_and_failures(tmp_path: Path) -> None:
    with InProcess(pause_s=0.001) as engine:
        check_order_and_failures(engine, tmp_path, attempts=3)


def test_a_robot_is_done_before_the_next(tmp_path: Path) -> None:
    tasks = []
    for robot in "ab":
        logs = [fleet.Task(f"{robot}{i}", writes, (str(tmp_path), f"{robot}{i}")) for i in range(2)]
        tasks += [*logs, fleet.Task(robot, lasts, (), after=tuple(each.key for each in logs))]
    assert [each.key for each in InProcess().run(tasks)] == ["a0", "a1", "a", "b0", "b1", "b"]


def lasts(done: tuple[fleet.Receipt | fleet.Failed, ...]) -> fleet.Receipt:
    return fleet.Receipt(done[0].key[0], "", "")


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ([("a", ()), ("a", ())], "two tasks have the key a"),
        ([("a", ("b",))], "a comes after b, and there is no such task"),
        ([("a", ()), ("b", ("c", "a")), ("c", ("b",))], "b, c come after themselves"),
    ],
)
def test_tasks_that_contradict(keys: list[tuple[str, tuple[str, ...]]], words: str) -> None:
    tasks = [fleet.Task(key, writes, (), after=after) for key, after in keys]
    with pytest.raises(FleetError, match=words):
        next(iter(InProcess().run(tasks)))
