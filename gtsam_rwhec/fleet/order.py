"""Tasks given out in their order, each when those it comes after have ended: the same for every engine."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from gtsam_rwhec.errors import FleetError
from gtsam_rwhec.fleet.tasks import Failed, Receipt, Task


class TaskOrder:
    """The tasks of one run.

    A task that comes after others is given out before those that still wait at the front: so a robot is done before
    the next is begun, and few results wait.

    Raises
    ------
    FleetError
        Two tasks have one key, or a task comes after one that is not there, or after itself.
    """

    def __init__(self, tasks: Iterable[Task]) -> None:
        self._tasks: dict[str, Task] = {}
        for task in tasks:
            if task.key in self._tasks:
                raise FleetError(f"two tasks have the key {task.key}; give each task a key of its own.")
            self._tasks[task.key] = task
        self._missing: dict[str, int] = {}
        self._next: dict[str, list[str]] = {}
        self._outcomes: dict[str, Receipt | Failed] = {}
        for task in self._tasks.values():
            before = set(task.after)
            for key in before:
                if key not in self._tasks:
                    raise FleetError(f"the task {task.key} comes after {key}, and there is no such task.")
                self._next.setdefault(key, []).append(task.key)
            self._missing[task.key] = len(before)
        self._ready = deque(key for key, count in self._missing.items() if not count)
        self._refuse_circles()

    def __len__(self) -> int:
        """How many tasks have not ended."""
        return len(self._tasks) - len(self._outcomes)

    def take(self) -> tuple[Task, tuple[Receipt | Failed, ...]] | None:
        """A task whose predecessors have ended, and their outcomes; None if none is ready now."""
        if not self._ready:
            return None
        task = self._tasks[self._ready.popleft()]
        return task, tuple(self._outcomes[key] for key in task.after)

    def ended(self, outcome: Receipt | Failed, key: str) -> None:
        """Note how the task of a key ended."""
        self._outcomes[key] = outcome
        for after in self._next.get(key, ()):
            self._missing[after] -= 1
            if not self._missing[after]:
                self._ready.appendleft(after)

    def _refuse_circles(self) -> None:
        missing, ready = dict(self._missing), list(self._ready)
        while ready:
            key = ready.pop()
            del missing[key]
            for after in self._next.get(key, ()):
                missing[after] -= 1
                if not missing[after]:
                    ready.append(after)
        if missing:
            raise FleetError(f"the tasks {', '.join(sorted(missing)[:5])} come after themselves, by way of others.")
