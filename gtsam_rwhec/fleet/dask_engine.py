"""The engine on Dask: processes of this machine, or any scheduler by address.

The scheduler has at most a few tasks for each thread at a time, so a run of 100,000 tasks costs it no more memory than
one of 100. A task's outcome is a receipt or a Failed, never an error: what a worker raises does not travel.
"""

from __future__ import annotations

import asyncio
import logging
import queue
import time
import uuid
from collections.abc import Iterable, Iterator
from contextlib import suppress
from importlib.util import find_spec
from itertools import count, islice
from typing import Any

from gtsam_rwhec.errors import FleetError, OptionError
from gtsam_rwhec.fleet.attempts import ATTEMPTS, PAUSE_S, attempted
from gtsam_rwhec.fleet.dask_cluster import START_S, DaskCluster
from gtsam_rwhec.fleet.extras import imported
from gtsam_rwhec.fleet.order import TaskOrder
from gtsam_rwhec.fleet.tasks import Failed, Receipt, Task
from gtsam_rwhec.fleet.without_secrets import without_secrets

_CLIENT_LOG = logging.getLogger("distributed.client")
#: The scheduler has so many tasks for each thread at a time, and at least this many.
TASKS_OF_A_THREAD, FEWEST_TASKS = 4, 16
#: Seconds between two looks at how many threads there are, and whether the processes live.
LOOK_S = 2.0
#: Seconds that a scheduler has to answer.
CONNECT_S = 15.0
#: The same on this machine.
LOCAL_S = 3.0
#: Bytes of memory that a worker may have, if not said: a log of 1 GB in detection takes less than half of it.
MEMORY_BYTES = 2 << 30
#: A worker may have this share of its memory for data before Python says that there is no more; Dask ends it at 1.
_DATA_SHARE = 0.9


class DaskEngine:
    """Carries out tasks on Dask's workers. It is a context manager that stops what it started.

    Parameters
    ----------
    workers
        How many processes of this machine, each with one thread and one thread of BLAS.
    memory_bytes
        Memory of each worker. A task that needs more is a Failed of kind ``MemoryError`` or, where a library took it
        before Python could say so, of kind ``KilledWorker``.
    scheduler
        The address of a scheduler that runs already (``"tcp://10.0.0.1:8786"``). Its workers need this library of this
        version, have the memory that whoever started them said, and count how often a task kills them by the
        scheduler's own ``allowed-failures``; `workers` is not used.
    attempts
        How often a task is tried for errors of the system, and for workers that die.
    dashboard
        Whether a scheduler of this machine has Dask's page.
    pause_s
        Seconds before the second attempt.

    Attributes
    ----------
    dashboard : str
        The address of Dask's own page; empty where there is none.

    Raises
    ------
    OptionError
        Dask is not installed, or there are no workers.
    FleetError
        The processes do not start, or nobody answers at the address.
    """

    def __init__(
        self,
        workers: int = 2,
        memory_bytes: int = MEMORY_BYTES,
        scheduler: str | None = None,
        *,
        attempts: int = ATTEMPTS,
        dashboard: bool = True,
        pause_s: float = PAUSE_S,
    ) -> None:
        if scheduler is None and workers < 1:
            raise OptionError(f"{workers} workers cannot work; give 1 or more")
        self._distributed = imported("distributed", "fleet", "the engine Dask")
        self._spec = imported("dask._task_spec", "fleet", "the engine Dask").Task
        self.attempts, self.pause_s, self.memory_bytes = attempts, pause_s, memory_bytes
        self.cluster = None if scheduler else DaskCluster(workers, memory_bytes, attempts - 1, dashboard)
        self.address = scheduler or (self.cluster.address if self.cluster else "")
        # What it says of a scheduler that is gone, with tracebacks, an error of this engine says in words.
        self._is_gone, self._numbers = False, count()
        self._level = _CLIENT_LOG.level
        _CLIENT_LOG.setLevel(logging.CRITICAL)
        try:
            self._client = self._connected()
        except BaseException:
            _CLIENT_LOG.setLevel(self._level)
            if self.cluster is not None:
                self.cluster.close()
            raise
        self.dashboard = ""
        if self.cluster is None or (dashboard and find_spec("bokeh") is not None):
            self.dashboard = self.cluster.dashboard if self.cluster else str(self._client.dashboard_link)

    def run(self, tasks: Iterable[Task]) -> Iterator[Receipt | Failed]:
        """Yield one receipt or failure for each task, as they end.

        Raises
        ------
        FleetError
            The tasks contradict one another; or the scheduler is gone, or all workers are. What is done is on disk: the
            same run goes on from there.
        """
        order = TaskOrder(tasks)
        total = len(order)
        running: dict[str, tuple[Task, Any]] = {}
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        most, looked_s = 0, -LOOK_S
        try:
            while len(order):
                if time.monotonic() > looked_s + LOOK_S:
                    most, looked_s = self._most_tasks(total - len(order), total), time.monotonic()
                batch = list(islice(iter(order.take, None), most - len(running)))
                for (task, _), future in zip(batch, self._submitted(batch), strict=True):
                    running[future.key] = task, future
                    future.add_done_callback(ended.put)
                try:
                    futures = [ended.get(timeout=LOOK_S)]
                except queue.Empty:
                    continue
                while not ended.empty():
                    futures.append(ended.get())
                for future, outcome in self._outcomes(futures, running, total - len(order), total):
                    task, _ = running.pop(future.key)
                    future.release()
                    order.ended(outcome, task.key)
                    yield outcome
        finally:
            if running and not self._is_gone:
                with suppress(OSError, asyncio.CancelledError):
                    self._client.cancel([future for _, future in running.values()], force=True)

    def close(self) -> None:
        """Stop what was started; a scheduler by address goes on."""
        with suppress(OSError, asyncio.CancelledError):
            self._client.close(timeout=2)
        _CLIENT_LOG.setLevel(self._level)
        if self.cluster is not None:
            self.cluster.close()

    def __enter__(self) -> DaskEngine:
        return self

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

    def _submitted(self, batch: list[tuple[Task, tuple[Receipt | Failed, ...]]]) -> list[Any]:
        bound = int(_DATA_SHARE * self.memory_bytes) if self.cluster is not None else None
        options = {"attempts": self.attempts, "memory_bytes": bound, "pause_s": self.pause_s}
        graph = {}
        for task, done in batch:
            # Dask groups tasks, and learns how long they take, by the words before the hyphen.
            # Of tasks that are sent together, those whose keys come first are done first.
            key = f"{task.function.__name__}-{next(self._numbers):08x}{uuid.uuid4().hex[8:]}"
            # Tasks that read data wait at the scheduler, not at a worker: so a task that kills its worker is alone
            # there, and no other is blamed.
            graph[key] = self._spec(key, attempted, task, done, _data_producer=True, **options)
        return list(self._client.get(graph, list(graph), sync=False)) if graph else []

    def _most_tasks(self, done: int, total: int) -> int:
        """How many tasks the scheduler should have now. A FleetError if it is gone."""
        self._check(done, total)
        try:
            threads: int = sum(self._client.nthreads().values())
        except OSError as error:
            self._check(done, total)
            raise self._gone(done, total, f"{error}.") from None
        return max(FEWEST_TASKS, TASKS_OF_A_THREAD * threads)

    def _outcomes(
        self, futures: list[Any], running: dict[str, tuple[Task, Any]], done: int, total: int
    ) -> list[tuple[Any, Receipt | Failed]]:
        """Each future with its outcome. A FleetError if the scheduler is gone."""
        self._check(done, total)
        finished = [future for future in futures if future.status == "finished"]
        try:
            outcomes = list(zip(finished, self._client.gather(finished), strict=True))
        except (OSError, asyncio.CancelledError) as error:
            self._check(done, total)
            raise self._gone(done, total, f"{error or type(error).__name__}.") from None
        for future in futures:
            if future.status == "error":
                outcomes.append((future, self._failed(running[future.key][0], future.exception())))
            elif future.status != "finished":
                raise self._gone(done, total, f"it lost the task {running[future.key][0].key}.")
        return outcomes

    def _failed(self, task: Task, error: BaseException) -> Failed:
        if isinstance(error, self._distributed.KilledWorker):
            deaths = error.allowed_failures + 1
            memory = f", {self.memory_bytes} bytes here," if self.cluster is not None else ""
            words = (
                f"the worker that did it died, {deaths} times, on the last of them at {error.last_worker.address}. It "
                f"needs more memory than a worker may have{memory} or a library that it calls crashes: do this log "
                "alone to see which."
            )
            return Failed(task.key, words, "KilledWorker", deaths)
        words = f"a worker cannot do it: {type(error).__name__}: {error}. Has it this library, of this version?"
        return Failed(task.key, without_secrets(words), type(error).__name__)

    def _check(self, done: int, total: int) -> None:
        """Raise a FleetError if the scheduler or all workers are gone."""
        gone = self.cluster.gone() if self.cluster is not None else ""
        if gone or self._client.status != "running":
            raise self._gone(done, total, gone or f"nobody answers at {self.address}.")

    def _gone(self, done: int, total: int, why: str) -> FleetError:
        self._is_gone = True
        return FleetError(
            f"Dask's scheduler is gone after {done} of {total} tasks: {without_secrets(why, self.address)} Run it "
            "again: it goes on from what is done."
        )
