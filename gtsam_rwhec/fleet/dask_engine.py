"""The engine that runs tasks on Dask: on processes of this machine, or on a running scheduler by its address.

Dask repeats tasks that fail (``retries``) or kill their worker (``allowed-failures``), and limits the workers' memory.
The scheduler holds only a few tasks for each thread at a time, so 100,000 tasks take no more of its memory than 100.
"""

from __future__ import annotations

import asyncio
import logging
import queue
import re
import time
import uuid
from collections.abc import Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import AbstractContextManager, suppress
from importlib.util import find_spec
from itertools import count, islice
from typing import Any

from gtsam_rwhec.errors import FleetError, OptionError
from gtsam_rwhec.files.optional_packages import extra_named
from gtsam_rwhec.files.progress import Progress, Remark, silent
from gtsam_rwhec.fleet.dask_cluster import START_S, DaskCluster
from gtsam_rwhec.fleet.stores import without_secrets
from gtsam_rwhec.fleet.tasks import ATTEMPTS, Failed, Receipt, Task, carried_out, failed

#: Errors of a client whose scheduler is lost.
_LOST = (OSError, asyncio.CancelledError, CancelledError)
_CLIENT_LOG = logging.getLogger("distributed.client")
#: Tasks at the scheduler at a time: for each thread, and at least.
TASKS_OF_A_THREAD, FEWEST_TASKS = 4, 16
#: Seconds between two checks of the number of threads and of the processes.
LOOK_S = 2.0
#: Seconds in which a scheduler must answer; and one on this machine.
CONNECT_S, LOCAL_S = 15.0, 3.0
#: Default memory of a worker, bytes: detection in a log of 1 GB takes less than half of it.
MEMORY_BYTES = 2 << 30
_SIZE = re.compile(r"([0-9]+(?:\.[0-9]+)?) *([kMGT]?)(i?)B?", re.IGNORECASE)


def bytes_of(size: str) -> int:
    """The bytes of a size such as "2GB", "500 MB" or "1.5GiB"; an OptionError for any other text."""
    found = _SIZE.fullmatch(size.strip())
    if found is None or float(found[1]) == 0.0:
        raise OptionError(f"{size!r} is no size of memory; give a number with MB or GB, such as 2GB")
    return int(float(found[1]) * (1024 if found[3] else 1000) ** " kmgt".index(found[2].lower() or " "))


class DaskEngine(AbstractContextManager["DaskEngine"]):
    """Runs tasks on Dask's workers, which start with the first task. As a context manager it stops what it started.

    Parameters
    ----------
    workers
        How many processes of this machine, each with one thread and one thread of BLAS.
    memory_bytes
        Memory of each worker. A task that needs more ends as a Failed.
    scheduler
        The address of a running scheduler (``"tcp://10.0.0.1:8786"``). Its workers must have the same version of this
        library. Their memory, and how many workers a task may kill (``allowed-failures``), were set when they were
        started; `workers` is not used.
    dashboard
        Whether a scheduler of this machine shows Dask's web page.
    progress
        Called when workers start, and with the address of Dask's page.

    Raises
    ------
    OptionError
        There are no workers.
    """

    def __init__(
        self,
        workers: int = 2,
        memory_bytes: int = MEMORY_BYTES,
        scheduler: str | None = None,
        *,
        dashboard: bool = True,
        progress: Progress = silent,
    ) -> None:
        if scheduler is None and workers < 1:
            raise OptionError(f"{workers} workers cannot work; give 1 or more")
        self.workers, self.memory_bytes, self.dashboard = workers, memory_bytes, dashboard
        self.address, self.tell = scheduler or "", progress
        self.cluster: DaskCluster | None = None
        self._client: Any = None
        self._distributed: Any = None
        self._is_gone, self._numbers, self._level = False, count(), _CLIENT_LOG.level

    def start(self) -> None:
        """Start the processes, or connect to the scheduler, unless this is already done.

        Raises
        ------
        MissingPackageError
            Dask is not installed.
        FleetError
            The processes do not start, or nobody answers at the address.
        """
        if self._client is not None:
            return
        with extra_named():
            import distributed
            from dask._task_spec import Task as Spec
        self._distributed, self._spec = distributed, Spec
        self.tell("starting workers")
        if not self.address:
            self.cluster = DaskCluster(self.workers, self.memory_bytes, ATTEMPTS - 1, self.dashboard)
            self.address = self.cluster.address
        # Dask logs a lost scheduler with tracebacks; this engine raises an error with a clear message instead.
        _CLIENT_LOG.setLevel(logging.CRITICAL)
        try:
            self._client = self._connected()
        except BaseException:
            self.close()
            raise
        page = self.cluster.dashboard if self.cluster else str(self._client.dashboard_link)
        if self.dashboard and page and find_spec("bokeh") is not None:
            self.tell(Remark(f"Dask's dashboard: {page}"))

    def run(self, tasks: Iterable[Task]) -> Iterator[Receipt | Failed]:
        """Yield one receipt or failure for each task, in the order in which they end.

        Raises
        ------
        FleetError
            The scheduler cannot start, or the scheduler or all workers are lost. Finished tasks stay: the same run
            continues from there.
        """
        self.start()
        tasks = list(tasks)
        waiting, left = iter(tasks), len(tasks)
        running: dict[str, tuple[Task, Any]] = {}
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        most, looked_s = 0, -LOOK_S
        try:
            while left:
                of_all = f"after {len(tasks) - left} of {len(tasks)} tasks"
                if time.monotonic() > looked_s + LOOK_S:
                    most, looked_s = self._most_tasks(of_all), time.monotonic()
                batch = list(islice(waiting, most - len(running)))
                for task, future in zip(batch, self._submitted(batch), strict=True):
                    running[future.key] = task, future
                    future.add_done_callback(ended.put)
                try:
                    futures = [ended.get(timeout=LOOK_S)]
                except queue.Empty:
                    continue
                while not ended.empty():
                    futures.append(ended.get())
                for future, outcome in self._outcomes(futures, running, of_all):
                    del running[future.key]
                    future.release()
                    left -= 1
                    yield outcome
        finally:
            if running and not self._is_gone:
                with suppress(*_LOST):
                    self._client.cancel([future for _, future in running.values()], force=True)

    def close(self) -> None:
        """Stop the processes that this engine started; a scheduler given by its address keeps running."""
        if self._client is not None:
            with suppress(*_LOST):
                self._client.close(timeout=2)
            self._client = None
        _CLIENT_LOG.setLevel(self._level)
        if self.cluster is not None:
            self.cluster.close()

    def __exit__(self, *raised: object) -> None:
        self.close()

    def _connected(self) -> Any:
        try:
            limit_s = LOCAL_S if self.cluster is not None else CONNECT_S
            client = self._distributed.Client(self.address, set_as_default=False, timeout=limit_s)
        except (OSError, ValueError) as error:
            raise FleetError(
                f"no scheduler of Dask answers at {without_secrets(self.address, self.address)} "
                f"({without_secrets(str(error), self.address)}). Is it running, and is the address right?"
            ) from None
        if self.cluster is None:
            return client
        try:
            client.wait_for_workers(1, timeout=START_S)
        except TimeoutError:
            client.close(timeout=2)
            raise FleetError(f"no worker of Dask starts within {START_S:.0f} s. {self.cluster.last_words()}") from None
        return client

    def _submitted(self, batch: list[Task]) -> list[Any]:
        graph = {}
        for task in batch:
            # Dask groups tasks by the part of the key before the hyphen, and learns how long each group takes.
            # Of tasks that are sent together, Dask runs those with the first keys first.
            key = f"{task.function.__name__}-{next(self._numbers):08x}{uuid.uuid4().hex[8:]}"
            # Tasks that read data wait at the scheduler, not at a worker. So a task that kills its worker is alone
            # on this worker.
            graph[key] = self._spec(key, carried_out, task, _data_producer=True)
        return list(self._client.get(graph, list(graph), sync=False, retries=ATTEMPTS - 1)) if graph else []

    def _most_tasks(self, of_all: str) -> int:
        """How many tasks the scheduler should have now. A FleetError if the scheduler is lost."""
        self._check(of_all)
        try:
            threads: int = sum(self._client.nthreads().values())
        except OSError as error:
            raise self._gone(of_all, f"{error}.") from None
        return max(FEWEST_TASKS, TASKS_OF_A_THREAD * threads)

    def _outcomes(
        self, futures: list[Any], running: dict[str, tuple[Task, Any]], of_all: str
    ) -> list[tuple[Any, Receipt | Failed]]:
        """Each future with its outcome. A FleetError if the scheduler is lost."""
        self._check(of_all)
        finished = [future for future in futures if future.status == "finished"]
        try:
            outcomes = list(zip(finished, self._client.gather(finished), strict=True))
        except _LOST as error:
            raise self._gone(of_all, f"{error or type(error).__name__}.") from None
        for future in futures:
            task = running[future.key][0]
            if future.status == "error":
                outcomes.append((future, self._failed(task, future.exception())))
            elif future.status != "finished":
                raise self._gone(of_all, f"it lost the task {task.key}.")
        return outcomes

    def _failed(self, task: Task, error: BaseException) -> Failed:
        if isinstance(error, self._distributed.KilledWorker):
            memory = f", {self.memory_bytes} bytes here," if self.cluster is not None else ""
            words = (
                f"the worker that did it died, {error.allowed_failures + 1} times, on the last of them at "
                f"{error.last_worker.address}. It needs more memory than a worker may have{memory} or a library that "
                "it calls crashes: do this log alone to see which."
            )
            return Failed(task.key, words)
        if isinstance(error, OSError):
            return failed(task, error)
        words = f"a worker cannot do it: {type(error).__name__}: {error}. Has it this library, of this version?"
        return Failed(task.key, without_secrets(words))

    def _check(self, of_all: str) -> None:
        """Raise a FleetError if the scheduler or all workers are lost."""
        gone = self.cluster.gone() if self.cluster is not None else ""
        if gone or self._client.status != "running":
            raise self._gone(of_all, gone or f"nobody answers at {self.address}.")

    def _gone(self, of_all: str, why: str) -> FleetError:
        self._is_gone = True
        if self.cluster is not None:
            why = self.cluster.gone() or why
        return FleetError(
            f"Dask's scheduler is gone {of_all}: {without_secrets(why, self.address)} Run it again: it goes on from "
            "what is done."
        )
