"""The engine on Dask: order, failures, workers that die, a scheduler that dies, callers without a guard."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
import requests
from engine_checks import check_deaths, check_order_and_failures
from tasks_of_tests import dies_once, joins, writes

from gtsam_rwhec.errors import FleetError, OptionError
from gtsam_rwhec.fleet import dask_engine
from gtsam_rwhec.fleet.dask_engine import FEWEST_TASKS, DaskEngine
from gtsam_rwhec.fleet.extras import imported
from gtsam_rwhec.fleet.tasks import Receipt, Task

MEMORY = 400 << 20


def test_what_is_not_installed_is_named_with_its_command() -> None:
    words = r"robots: no_such_module is not installed: pip install 'gtsam-rwhec\[fleet\]'"
    with pytest.raises(OptionError, match=words):
        imported("no_such_module.part", "fleet", "robots")
    assert imported("os.path", "fleet", "robots").sep == "/"


def test_what_cannot_be_an_engine() -> None:
    with pytest.raises(OptionError, match="0 workers cannot work"):
        DaskEngine(0)


def test_nobody_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dask_engine, "CONNECT_S", 0.1)
    with pytest.raises(FleetError, match=r"no scheduler of Dask answers at tcp://127.0.0.1:9 .* is the address right"):
        DaskEngine(scheduler="tcp://127.0.0.1:9")


def test_failures_a_death_and_the_end_of_the_scheduler(tmp_path: Path) -> None:
    """In one test, since the processes take a second or two to start."""
    with DaskEngine(1, MEMORY, attempts=2, dashboard=False, pause_s=0.001) as engine:
        assert engine.dashboard == ""
        check_order_and_failures(engine, tmp_path, attempts=2)
        (outcome,) = engine.run([Task("dies", dies_once, (str(tmp_path), "dies"))])
        assert outcome == Receipt("dies", "dies.bin", "")
        assert (tmp_path / "dies.tried").stat().st_size == 2
        assert engine.cluster is not None
        first = Task("first", writes, (str(tmp_path), "first"))
        running = engine.run([first, Task("second", joins, (str(tmp_path), "second"), after=("first",))])
        assert next(running).key == "first"
        os.kill(engine.cluster.scheduler_pid, signal.SIGKILL)
        with pytest.raises(FleetError, match=r"scheduler is gone after 1 of 2 tasks: .* goes on from what is done"):
            next(running)
        folder = engine.cluster.folder
    assert not folder.exists()


@pytest.mark.slow
def test_deaths_on_two_workers_and_a_second_client(tmp_path: Path) -> None:
    with DaskEngine(2, MEMORY) as engine:
        check_deaths(engine, tmp_path, MEMORY, attempts=3)
        # A second client, by address, of a scheduler that goes on when its engine is closed.
        with DaskEngine(scheduler=engine.address) as other:
            done = list(other.run(Task(f"n{i}", writes, (str(tmp_path), f"n{i}")) for i in range(3 * FEWEST_TASKS)))
        assert sorted(each.key for each in done) == sorted(f"n{i}" for i in range(3 * FEWEST_TASKS))
        assert requests.get(engine.dashboard, timeout=10).ok
        (again,) = engine.run([Task("again", writes, (str(tmp_path), "again"))])
        assert again.key == "again"


SCRIPT = """
import sys
from gtsam_rwhec.fleet import dask_engine
from gtsam_rwhec.fleet.dask_engine import DaskEngine
from gtsam_rwhec.fleet.tasks import Receipt, Task
from tasks_of_tests import waits_for, writes
print("imported", flush=True)
engine = DaskEngine(1, dashboard=False)
print(engine.cluster.scheduler_pid, flush=True)
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
