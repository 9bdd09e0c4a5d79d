"""A cluster of Dask on this machine: a scheduler, and workers of one thread and bounded memory.

The processes are started by ``python -m gtsam_rwhec.fleet.dask_cluster`` and not by multiprocessing. So the user's
script is not imported again, and needs no ``if __name__ == "__main__"``. Each process reads its standard input and
ends when the input ends, so no process outlives a caller that was killed.
"""

from __future__ import annotations

import asyncio
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from gtsam_rwhec.errors import FleetError

#: Seconds to wait for the scheduler. It needs one second, on a busy machine ten.
START_S = 60.0
#: Seconds in which processes must end by themselves.
END_S = 3.0
#: Environment variables of the processes: one thread of linear algebra in each.
_ENVIRONMENT = {
    **dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"),
    # A worker holds one task at a time: when a worker dies, its task is the cause.
    "DASK_DISTRIBUTED__SCHEDULER__WORKER_SATURATION": "1.0",
    "DASK_DISTRIBUTED__SCHEDULER__WORK_STEALING": "False",
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    # Do not wait for a dead worker to come back: on one machine answers are never slow.
    "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "3s",
    # Results are small and the task itself takes the memory: pausing or spilling would not help.
    "DASK_DISTRIBUTED__WORKER__MEMORY__TARGET": "False",
    "DASK_DISTRIBUTED__WORKER__MEMORY__SPILL": "False",
    "DASK_DISTRIBUTED__WORKER__MEMORY__PAUSE": "False",
    "DASK_DISTRIBUTED__WORKER__MEMORY__TERMINATE": "1.0",
}
#: How the processes' log file is opened: all of them append to it.
_APPENDING = os.O_WRONLY | os.O_CREAT | os.O_APPEND


class DaskCluster:
    """A scheduler and workers, each in its own process. They write to a log file, which error messages quote.

    A worker that takes more than `memory_bytes` is stopped and restarted. A task whose worker died
    `allowed_failures` times is tried once more.

    Raises
    ------
    FleetError
        The processes do not start; the message has the end of their output.
    """

    def __init__(self, workers: int, memory_bytes: int, allowed_failures: int, dashboard: bool) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="gtsam-rwhec-fleet-"))
        self._processes: list[subprocess.Popen[bytes]] = []
        try:
            options: dict[str, Any] = {
                "host": "127.0.0.1", "port": 0, "dashboard": dashboard, "dashboard_address": "127.0.0.1:0",
                "allowed_failures": allowed_failures,
            }  # fmt: skip
            self.scheduler = self._started("scheduler", json.dumps(options))
            options = {"nthreads": 1, "memory_limit": memory_bytes, "local_directory": str(self.folder)}
            self.workers = self._started("workers", str(workers), json.dumps(options))
            told = json.loads(self._first_line())
            self.address, self.dashboard = str(told["address"]), str(told["dashboard"])
            assert self.workers.stdin is not None
            with suppress(BrokenPipeError):  # the process has ended: the caller that waits for it reports this
                self.workers.stdin.write(f"{self.address}\n".encode())
                self.workers.stdin.flush()
        except BaseException:
            self.close()
            raise

    def gone(self) -> str:
        """Which process has ended, and the end of its output; empty while all run."""
        for process, name in ((self.scheduler, "scheduler"), (self.workers, "process of the workers")):
            if process.poll() is not None:
                return f"the {name} ended (status {process.returncode}). {self.last_words()}"
        return ""

    def last_words(self) -> str:
        """The end of the processes' output."""
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
        # The other processes can import what this one can: they find the tasks' functions by name.
        paths = [os.getcwd() if path == "" else path for path in sys.path]
        environment = {**os.environ, **_ENVIRONMENT, "PYTHONPATH": os.pathsep.join(paths)}
        process = subprocess.Popen(
            [sys.executable, "-m", "gtsam_rwhec.fleet.dask_cluster", *arguments],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=os.open(self.folder / "said", _APPENDING, 0o600),
            env=environment, start_new_session=True,
        )  # fmt: skip
        self._processes.append(process)
        return process

    def _first_line(self) -> bytes:
        """The first line of the scheduler's output: it is ready."""
        assert self.scheduler.stdout is not None
        ready, _, _ = select.select([self.scheduler.stdout], [], [], START_S)
        line = self.scheduler.stdout.readline() if ready else b""
        if not line:
            raise FleetError(f"Dask's scheduler does not start within {START_S:.0f} s. {self.last_words()}")
        return line


async def _scheduler(options: dict[str, Any]) -> None:
    from distributed import Scheduler

    async with Scheduler(**options) as scheduler:
        port = scheduler.services["dashboard"].port if "dashboard" in scheduler.services else None
        page = f"http://{scheduler.ip}:{port}/status" if port else ""
        print(json.dumps({"address": scheduler.address, "dashboard": page}), flush=True)
        await scheduler.finished()


async def _workers(address: str, count: int, options: dict[str, Any]) -> None:
    """Workers, each with a nanny that restarts it when it dies or exceeds its memory."""
    from distributed import Nanny

    nannies = [await Nanny(address, name=f"worker-{number}", **options) for number in range(count)]
    await asyncio.gather(*(nanny.finished() for nanny in nannies))


def _end_with_the_caller() -> None:
    """Read the standard input until the caller closes it or ends; then end this process."""
    while os.read(0, 1024):
        pass
    os._exit(1)


def main() -> None:
    """Run ``scheduler OPTIONS``, or ``workers COUNT OPTIONS``, which reads the scheduler's address from a line."""
    what, *words = sys.argv[1:]
    if what == "scheduler":
        running = _scheduler(json.loads(words[0]))
    else:
        import distributed  # noqa: F401  # imported while the scheduler starts

        address = ""
        while not address.endswith("\n"):
            letter = os.read(0, 1).decode()  # one byte only: the thread reads the rest
            if not letter:
                return
            address += letter
        running = _workers(address.strip(), int(words[0]), json.loads(words[1]))
    threading.Thread(target=_end_with_the_caller, daemon=True).start()
    asyncio.run(running)


if __name__ == "__main__":
    main()
