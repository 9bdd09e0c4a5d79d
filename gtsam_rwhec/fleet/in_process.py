"""The engine without processes: one task after another in this one. For few logs, for tests and for debuggers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from gtsam_rwhec.fleet.attempts import ATTEMPTS, PAUSE_S, attempted
from gtsam_rwhec.fleet.order import TaskOrder
from gtsam_rwhec.fleet.tasks import Failed, Receipt, Task


class InProcess:
    """Carries out tasks in this process, in their order. Memory is not bounded, since callers' data are in it too.

    Parameters
    ----------
    attempts
        How often a task is tried for errors of the system.
    pause_s
        Seconds before the second attempt.
    """

    def __init__(self, attempts: int = ATTEMPTS, pause_s: float = PAUSE_S) -> None:
        self.attempts, self.pause_s = attempts, pause_s

    def run(self, tasks: Iterable[Task]) -> Iterator[Receipt | Failed]:
        """Yield one receipt or failure for each task, as they end."""
        order = TaskOrder(tasks)
        while (given := order.take()) is not None:
            task, done = given
            outcome = attempted(task, done, attempts=self.attempts, pause_s=self.pause_s)
            order.ended(outcome, task.key)
            yield outcome

    def close(self) -> None:
        """Nothing was started."""

    def __enter__(self) -> InProcess:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()
