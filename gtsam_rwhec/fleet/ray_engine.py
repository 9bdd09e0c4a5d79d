"""The engine on Ray: processes of this machine, or a cluster by address. The same tasks, order and outcomes as Dask's.

Ray has at most a few tasks for each processor at a time. A worker that dies is replaced, and its task is tried again.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterable, Iterator
from typing import Any

from gtsam_rwhec.errors import FleetError, OptionError
from gtsam_rwhec.fleet.attempts import ATTEMPTS, PAUSE_S, attempted
from gtsam_rwhec.fleet.extras import imported
from gtsam_rwhec.fleet.order import TaskOrder
from gtsam_rwhec.fleet.tasks import Failed, Receipt, Task
from gtsam_rwhec.fleet.without_secrets import without_secrets

#: Ray has so many tasks for each processor at a time, and at least this many.
TASKS_OF_A_PROCESSOR, FEWEST_TASKS = 4, 16
#: Bytes of memory that a worker may have, if not said.
MEMORY_BYTES = 2 << 30
#: Bytes of shared memory for results, which are small.
_STORE_BYTES = 80 << 20
_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class RayEngine:
    """Carries out tasks on Ray's workers. It is a context manager that stops what it started.

    Parameters
    ----------
    workers
        How many processes of this machine.
    memory_bytes
        Memory of each worker; a task that needs more is a Failed of kind ``MemoryError``.
    scheduler
        The address of a cluster that runs already (``"ray://10.0.0.1:10001"``, ``"auto"``); `workers` is not used then.
    attempts
        How often a task is tried for errors of the system, and for workers that die.
    pause_s
        Seconds before the second attempt.

    Attributes
    ----------
    dashboard : str
        The address of Ray's own page; empty where there is none.

    Raises
    ------
    OptionError
        Ray is not installed, there are no workers, or this process uses Ray already.
    FleetError
        Ray does not start, or nobody answers at the address.
    """

    def __init__(
        self,
        workers: int = 2,
        memory_bytes: int = MEMORY_BYTES,
        scheduler: str | None = None,
        *,
        attempts: int = ATTEMPTS,
        pause_s: float = PAUSE_S,
    ) -> None:
        if scheduler is None and workers < 1:
            raise OptionError(f"{workers} workers cannot work; give 1 or more")
        self._ray = imported("ray", "ray", "the engine Ray")
        if self._ray.is_initialized():
            raise OptionError("this process uses Ray already: call ray.shutdown() first, or give Ray's address")
        options: dict[str, Any] = {"address": scheduler}
        environment = dict(_ONE_THREAD)
        if scheduler is None:
            # What this process can import the others can: functions of tasks are found by name.
            environment["PYTHONPATH"] = os.pathsep.join(os.getcwd() if path == "" else path for path in sys.path)
            options = {
                "num_cpus": workers, "include_dashboard": False, "object_store_memory": _STORE_BYTES,
                "_node_ip_address": "127.0.0.1",
            }  # fmt: skip
        try:
            context = self._ray.init(
                **options, log_to_driver=False, logging_level=logging.ERROR, runtime_env={"env_vars": environment}
            )
        except (OSError, RuntimeError, ValueError) as error:
            said = without_secrets(str(error), scheduler or "")
            raise FleetError(f"Ray does not start, or nobody answers at its address: {said}") from None
        self.dashboard = f"http://{context.dashboard_url}" if context.dashboard_url else ""
        # Ray tries again what dies, and `attempted` what raises.
        self._remote = self._ray.remote(num_cpus=1, max_retries=attempts - 1, retry_exceptions=False)(_carried_out)
        self._options = {"attempts": attempts, "memory_bytes": memory_bytes, "pause_s": pause_s}

    def run(self, tasks: Iterable[Task]) -> Iterator[Receipt | Failed]:
        """Yield one receipt or failure for each task, as they end.

        Raises
        ------
        FleetError
            The tasks contradict one another, or Ray is gone. What is done is on disk: the same run goes on from there.
        """
        order = TaskOrder(tasks)
        total = len(order)
        most = max(FEWEST_TASKS, TASKS_OF_A_PROCESSOR * int(self._ray.cluster_resources().get("CPU", 1)))
        running: dict[Any, Task] = {}
        try:
            while len(order):
                while len(running) < most and (given := order.take()) is not None:
                    running[self._remote.remote(*given, self._options)] = given[0]
                ended, _ = self._ray.wait(list(running), num_returns=1)
                for reference in ended:
                    task = running.pop(reference)
                    outcome = self._outcome(task, reference)
                    order.ended(outcome, task.key)
                    yield outcome
        except (ConnectionError, self._ray.exceptions.RaySystemError) as error:
            raise FleetError(
                f"Ray is gone after {total - len(order)} of {total} tasks: {without_secrets(str(error))} Run it again: "
                "it goes on from what is done."
            ) from None
        finally:
            for reference in running:
                self._ray.cancel(reference, force=True)

    def close(self) -> None:
        """Stop what was started; a cluster by address goes on."""
        self._ray.shutdown()

    def __enter__(self) -> RayEngine:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def _outcome(self, task: Task, reference: Any) -> Receipt | Failed:
        faults = self._ray.exceptions
        try:
            outcome: Receipt | Failed = self._ray.get(reference)
        except (faults.WorkerCrashedError, faults.OutOfMemoryError, faults.NodeDiedError) as error:
            attempts = int(self._options["attempts"] or 1)
            words = (
                f"the worker that did it died, {attempts} times. It needs more memory than there is, or a library that "
                "it calls crashes: do this log alone to see which."
            )
            return Failed(task.key, words, type(error).__name__, attempts)
        except faults.RayTaskError as error:
            words = f"a worker cannot do it: {error.cause!r}. Has it this library, of this version?"
            return Failed(task.key, without_secrets(words), type(error.cause).__name__)
        return outcome


def _carried_out(task: Task, done: tuple[Receipt | Failed, ...], options: dict[str, Any]) -> Receipt | Failed:
    return attempted(task, done, **options)
