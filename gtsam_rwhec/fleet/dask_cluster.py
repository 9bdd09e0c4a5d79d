"""A cluster of Dask on this machine: a scheduler, and workers of one thread and bounded memory."""

from __future__ import annotations

import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from gtsam_rwhec.errors import FleetError

#: Seconds. A scheduler is ready after one, on a busy machine after ten.
START_S = 60.0
#: Seconds that processes have to end by themselves.
END_S = 3.0
#: The processes' environment: one thread of linear algebra in each, and nothing that costs without use.
_ENVIRONMENT = {
    **dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"),
    # A task is on one worker only, so one that kills its worker is the only one to blame.
    "DASK_DISTRIBUTED__SCHEDULER__WORKER_SATURATION": "1.0",
    "DASK_DISTRIBUTED__SCHEDULER__WORK_STEALING": "False",
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    # A worker that died is not waited for, as on one machine nothing is slow to answer.
    "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "3s",
    # Results are small: what takes memory is the task, and to pause or to spill would not help.
    "DASK_DISTRIBUTED__WORKER__MEMORY__TARGET": "False",
    "DASK_DISTRIBUTED__WORKER__MEMORY__SPILL": "False",
    "DASK_DISTRIBUTED__WORKER__MEMORY__PAUSE": "False",
    "DASK_DISTRIBUTED__WORKER__MEMORY__TERMINATE": "1.0",
}


class DaskCluster:
    """A scheduler and workers in processes of their own. Their words are in a file that messages quote.

    Parameters
    ----------
    workers
        How many.
    memory_bytes
        Memory of each worker; one that has more is ended and started anew.
    allowed_failures
        A task whose worker died so often is tried once more.
    dashboard
        Whether the scheduler has its page.

    Raises
    ------
    FleetError
        The processes do not start; the message has their last words.
    """

    def __init__(self, workers: int, memory_bytes: int, allowed_failures: int, dashboard: bool) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="gtsam-rwhec-fleet-"))
        self._processes: list[subprocess.Popen[bytes]] = []
        try:
            options: dict[str, Any] = {
                "host": "127.0.0.1", "port": 0, "dashboard": dashboard, "dashboard_address": "127.0.0.1:0",
                "allowed_failures": allowed_failures,
            }  # fmt: skip
            self._scheduler = self._started("scheduler", json.dumps(options))
            options = {"nthreads": 1, "memory_limit": memory_bytes, "local_directory": str(self.folder)}
            self._workers = self._started("workers", str(workers), json.dumps(options))
            told = json.loads(self._line_of(self._scheduler))
            self.address, self.dashboard = str(told["address"]), str(told["dashboard"])
            assert self._workers.stdin is not None
            with suppress(BrokenPipeError):  # they ended: whoever waits for them says so
                self._workers.stdin.write(f"{self.address}\n".encode())
                self._workers.stdin.flush()
        except BaseException:
            self.close()
            raise

    @property
    def scheduler_pid(self) -> int:
        """The scheduler's number of process."""
        return self._scheduler.pid

    @property
    def workers_pid(self) -> int:
        """The number of the process whose children the workers are."""
        return self._workers.pid

    def gone(self) -> str:
        """Which process has ended, and its last words; empty while all run."""
        for process, name in ((self._scheduler, "scheduler"), (self._workers, "process of the workers")):
            if process.poll() is not None:
                return f"the {name} ended (status {process.returncode}). {self.last_words()}"
        return ""

    def last_words(self) -> str:
        """The end of what the processes said."""
        said = (self.folder / "said").read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return f"It said: {' | '.join(said[-3:])}" if said else "It said nothing."

    def close(self) -> None:
        """End the processes and remove their folder."""
        for process in self._processes:
            if process.stdin is not None:
                with suppress(BrokenPipeError):
                    process.stdin.close()
            process.terminate()
        deadline = time.monotonic() + END_S
        for process in self._processes:
            try:
                process.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdout is not None:
                process.stdout.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _started(self, *arguments: str) -> subprocess.Popen[bytes]:
        # What this process can import the others can: functions of tasks are found by name.
        paths = [os.getcwd() if path == "" else path for path in sys.path]
        environment = {**os.environ, **_ENVIRONMENT, "PYTHONPATH": os.pathsep.join(paths)}
        process = subprocess.Popen(
            [sys.executable, "-m", "gtsam_rwhec.fleet.dask_process", *arguments],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=os.open(self.folder / "said", _APPENDING, 0o600),
            env=environment, start_new_session=True,
        )  # fmt: skip
        self._processes.append(process)
        return process

    def _line_of(self, process: subprocess.Popen[bytes]) -> bytes:
        assert process.stdout is not None
        ready, _, _ = select.select([process.stdout], [], [], START_S)
        line = process.stdout.readline() if ready else b""
        if not line:
            raise FleetError(f"Dask's scheduler does not start within {START_S:.0f} s. {self.last_words()}")
        return line


#: How the file of the processes' words is opened: its end is where all of them write.
_APPENDING = os.O_WRONLY | os.O_CREAT | os.O_APPEND
