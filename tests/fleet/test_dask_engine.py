"""The engine on Dask: failures, workers that die, a scheduler that dies, callers without a guard."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
import requests
from tasks_of_tests import check_failures, dies_always, dies_once, floods, writes

from gtsam_rwhec.errors import FleetError, OptionError
from gtsam_rwhec.files.progress import Remark
from gtsam_rwhec.fleet import dask_engine
from gtsam_rwhec.fleet.dask_engine import FEWEST_TASKS, DaskEngine, bytes_of
from gtsam_rwhec.fleet.tasks import Failed, Receipt, Task

MEMORY = 400 << 20


def task(function: object, folder: Path, name: str, *more: object) -> Task:
    return Task(name, function, (str(folder), name, *more))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("size", "count"), [("2GB", 2 * 10**9), ("500 MB", 5 * 10**8), ("1.5GiB", 3 << 29), ("64k", 64000)]
)
def test_sizes_of_memory(size: str, count: int) -> None:
    assert bytes_of(size) == count


def test_what_cannot_be_an_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OptionError, match="0 workers"):
        DaskEngine(0)
    monkeypatch.setattr(dask_engine, "CONNECT_S", 0.1)
    with pytest.raises(FleetError, match=r"no scheduler of Dask answers at tcp://127.0.0.1:9 "):
        DaskEngine(scheduler="tcp://127.0.0.1:9").start()


def test_failures_a_death_and_the_end_of_the_scheduler(tmp_path: Path) -> None:
    """In one test, since the processes take a second or two to start."""
    with DaskEngine(1, MEMORY, dashboard=False) as engine:
        assert engine.cluster is None, "nothing is started before there is a task"
        check_failures(engine, tmp_path)
        (outcome,) = engine.run([task(dies_once, tmp_path, "dies")])
        assert outcome == Receipt("dies", "dies.bin", "")
        assert (tmp_path / "dies.tried").stat().st_size == 2
        assert engine.cluster is not None
        running = engine.run([task(writes, tmp_path, f"n{i}") for i in range(2 * FEWEST_TASKS)])
        next(running)
        engine.cluster.scheduler.kill()
        with pytest.raises(FleetError, match=r"scheduler is gone after \d+ of 32 tasks: .* goes on from what is done"):
            list(running)
        folder = engine.cluster.folder
    assert not folder.exists()


@pytest.mark.slow
def test_deaths_on_two_workers_and_a_second_client(tmp_path: Path) -> None:
    said: list[object] = []
    with DaskEngine(2, MEMORY, progress=said.append) as engine:
        names = {"innocent1": writes, "once": dies_once, "killer": dies_always, "innocent2": writes}
        tasks = [task(function, tmp_path, name) for name, function in names.items()]
        by_key = {each.key: each for each in engine.run([*tasks, task(floods, tmp_path, "flood", 8 * MEMORY)])}
        reasons = {key: each.reason for key, each in by_key.items() if isinstance(each, Failed)}
        assert set(by_key) == {*names, "flood"}
        assert set(reasons) == {"killer", "flood"}
        for words in reasons.values():
            assert "died, 3 times" in words
            assert f"{MEMORY} bytes" in words
        assert (tmp_path / "killer.tried").stat().st_size == 3
        # A second client, by address, of a scheduler that goes on when its engine is closed.
        with DaskEngine(scheduler=engine.address) as other:
            done = list(other.run(task(writes, tmp_path, f"n{i}") for i in range(3 * FEWEST_TASKS)))
        assert sorted(each.key for each in done) == sorted(f"n{i}" for i in range(3 * FEWEST_TASKS))
        (page,) = [str(one).rpartition(" ")[2] for one in said if isinstance(one, Remark)]
        assert requests.get(page, timeout=10).ok
        (again,) = engine.run([task(writes, tmp_path, "again")])
        assert again.key == "again"


SCRIPT = """
import sys
from gtsam_rwhec.fleet.dask_engine import DaskEngine
from gtsam_rwhec.fleet.tasks import Task
from tasks_of_tests import waits_for, writes
print("imported", flush=True)
engine = DaskEngine(1, dashboard=False)
engine.start()
print(engine.cluster.scheduler.pid, flush=True)
for each in engine.run([Task("a", writes, (sys.argv[1], "a")), Task("b", waits_for, (sys.argv[1], "b"))]):
    print(each.key, flush=True)
"""


@pytest.mark.slow
def test_a_script_without_a_guard_that_is_killed_leaves_no_processes(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])}
    script = subprocess.Popen(
        [sys.executable, str(tmp_path / "script.py"), str(tmp_path)], stdout=subprocess.PIPE, env=environment, text=True
    )
    assert script.stdout is not None
    assert script.stdout.readline() == "imported\n"  # once: the next line is another
    scheduler = int(script.stdout.readline())
    assert script.stdout.readline() == "a\n"
    processes = psutil.Process(script.pid).children(recursive=True)
    assert scheduler in [each.pid for each in processes]
    assert len(processes) >= 3
    script.kill()
    script.communicate()
    _, alive = psutil.wait_procs(processes, timeout=30)
    assert alive == []
