"""A cluster of Dask on this machine: a scheduler, and workers of one thread and bounded memory.

Their processes are commands (``python -m gtsam_rwhec.fleet.dask_cluster``) and not made by multiprocessing: the script
that calls the library is not imported again, so it needs no ``if __name__ == "__main__"``. They read from the standard
input, and end when it ends: no process outlives a caller that was killed.
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
#: How the file of the processes' words is opened: its end is where all of them write.
_APPENDING = os.O_WRONLY | os.O_CREAT | os.O_APPEND


class DaskCluster:
    """A scheduler and workers in processes of their own. Their words are in a file that messages quote.

    Each worker has `memory_bytes`; one that has more is ended and started anew. A task whose worker died
    `allowed_failures` times is tried once more.

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
            self.scheduler = self._started("scheduler", json.dumps(options))
            options = {"nthreads": 1, "memory_limit": memory_bytes, "local_directory": str(self.folder)}
            self.workers = self._started("workers", str(workers), json.dumps(options))
            told = json.loads(self._first_line())
            self.address, self.dashboard = str(told["address"]), str(told["dashboard"])
            assert self.workers.stdin is not None
            with suppress(BrokenPipeError):  # they ended: whoever waits for them says so
                self.workers.stdin.write(f"{self.address}\n".encode())
                self.workers.stdin.flush()
        except BaseException:
            self.close()
            raise

    def gone(self) -> str:
        """Which process has ended, and its last words; empty while all run."""
        for process, name in ((self.scheduler, "scheduler"), (self.workers, "process of the workers")):
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
            [sys.executable, "-m", "gtsam_rwhec.fleet.dask_cluster", *arguments],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=os.open(self.folder / "said", _APPENDING, 0o600),
            env=environment, start_new_session=True,
        )  # fmt: skip
        self._processes.append(process)
        return process

    def _first_line(self) -> bytes:
        """What the scheduler says when it is ready."""
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
    """Workers, each with a nanny that starts it anew when it dies or takes more memory than it may."""
    from distributed import Nanny

    nannies = [await Nanny(address, name=f"worker-{number}", **options) for number in range(count)]
    await asyncio.gather(*(nanny.finished() for nanny in nannies))


def _end_with_the_caller() -> None:
    """Read until the caller closes the other end, or ends."""
    while os.read(0, 1024):
        pass
    os._exit(1)


def main() -> None:
    """Run what the arguments say: ``scheduler OPTIONS``, or ``workers COUNT OPTIONS`` with the address on a line."""
    what, *words = sys.argv[1:]
    if what == "scheduler":
        running = _scheduler(json.loads(words[0]))
    else:
        import distributed  # noqa: F401  # while the scheduler starts, which tells the address when it has

        address = ""
        while not address.endswith("\n"):
            letter = os.read(0, 1).decode()  # not more: the rest is read by the thread
            if not letter:
                return
            address += letter
        running = _workers(address.strip(), int(words[0]), json.loads(words[1]))
    threading.Thread(target=_end_with_the_caller, daemon=True).start()
    asyncio.run(running)


if __name__ == "__main__":
    main()
