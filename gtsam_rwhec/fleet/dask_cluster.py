"""A cluster of Dask on this machine: a scheduler, and workers of one thread and bounded memory.

The processes are started by ``python -m gtsam_rwhec.fleet.dask_cluster`` and not by multiprocessing. So the user's
script is not imported again, and needs no ``if __name__ == "__main__"``. Each process reads its standard input and
ends when the input ends, so no process outlives a caller that was killed.
"""

from __future__ import annotations

import asyncio
import json
import os
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
#: The scheduler writes its address to this file.
PLACE = "scheduler.json"
#: How the processes' log file is opened: all of them append to it.
_APPENDING = os.O_WRONLY | os.O_CREAT | os.O_APPEND


class DaskCluster:
    """A scheduler and workers, each in its own process. They write to a log file, which error messages quote.

    A worker that takes more than `memory_bytes` is stopped and restarted. A task whose worker died `allowed_failures`
    times is tried once more. Raises `FleetError` if the processes do not start, with the end of their output.
    """

    def __init__(self, workers: int, memory_bytes: int, allowed_failures: int, dashboard: bool) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="gtsam-rwhec-fleet-"))
        self._processes: list[subprocess.Popen[bytes]] = []
        try:
            self.scheduler = self._started(
                "scheduler",
                host="127.0.0.1",
                port=0,
                dashboard=dashboard,
                dashboard_address="127.0.0.1:0",
                allowed_failures=allowed_failures,
            )
            self.workers = self._started(
                f"{workers} workers", nthreads=1, memory_limit=memory_bytes, local_directory=str(self.folder)
            )
            self.address, port = self._place()
            self.dashboard = f"http://127.0.0.1:{port}/status" if port else ""
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
        shutil.rmtree(self.folder, ignore_errors=True)

    def _started(self, what: str, **options: Any) -> subprocess.Popen[bytes]:
        # The other processes can import what this one can: they find the tasks' functions by name.
        paths = [os.getcwd() if path == "" else path for path in sys.path]
        environment = {**os.environ, **_ENVIRONMENT, "PYTHONPATH": os.pathsep.join(paths)}
        told = json.dumps(options | {"scheduler_file": str(self.folder / PLACE)})
        said = os.open(self.folder / "said", _APPENDING, 0o600)
        process = subprocess.Popen(
            [sys.executable, "-m", "gtsam_rwhec.fleet.dask_cluster", what, told],
            stdin=subprocess.PIPE, stdout=said, stderr=said, env=environment, start_new_session=True,
        )  # fmt: skip
        os.close(said)
        self._processes.append(process)
        return process

    def _place(self) -> tuple[str, int | None]:
        """The scheduler's address, and the port of its page, from the file that it writes when it is ready."""
        deadline = time.monotonic() + START_S
        while time.monotonic() < deadline and not self.gone():
            with suppress(OSError, ValueError):  # it is not there, or not whole
                told = json.loads((self.folder / PLACE).read_bytes())
                return told["address"], told["services"].get("dashboard")
            time.sleep(0.02)
        raise FleetError(f"Dask's scheduler does not start within {START_S:.0f} s. {self.last_words()}")


async def _run(what: str, options: dict[str, Any]) -> None:
    """Run the scheduler, or workers, each with a nanny that restarts it when it dies or exceeds its memory."""
    from distributed import Nanny, Scheduler

    if what == "scheduler":
        servers = [await Scheduler(**options)]
    else:
        servers = [await Nanny(name=f"worker-{number}", **options) for number in range(int(what.split()[0]))]
    await asyncio.gather(*(server.finished() for server in servers))


def _end_with_the_caller() -> None:
    """Read the standard input until the caller closes it or ends; then end this process."""
    while os.read(0, 1024):
        pass
    os._exit(1)


def main() -> None:
    """Run ``scheduler OPTIONS`` or ``"COUNT workers" OPTIONS``; the workers wait for the scheduler's file."""
    threading.Thread(target=_end_with_the_caller, daemon=True).start()
    asyncio.run(_run(sys.argv[1], json.loads(sys.argv[2])))


if __name__ == "__main__":
    main()
