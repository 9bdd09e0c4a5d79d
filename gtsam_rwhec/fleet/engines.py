"""Which engine carries out a run: chosen by name, and started only when there is something to do."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from gtsam_rwhec.errors import OptionError
from gtsam_rwhec.files.progress import Progress, Remark, silent
from gtsam_rwhec.fleet.tasks import Engine, Failed, Receipt, Task

_SIZE = re.compile(r"([0-9]+(?:\.[0-9]+)?) *([kMGT]?)(i?)B?", re.IGNORECASE)
_POWERS = {"": 0, "k": 1, "m": 2, "g": 3, "t": 4}


@dataclass
class StartedLate:
    """An engine that is started by the first task: a run that has nothing to do starts none.

    Attributes
    ----------
    start : callable
        Makes the engine.
    tell : Progress
        Is told the address of its dashboard.
    """

    start: Callable[[], Engine]
    tell: Progress = silent
    _engine: Engine | None = field(default=None, init=False)

    def run(self, tasks: Iterable[Task]) -> Iterator[Receipt | Failed]:
        """As the engine does."""
        if self._engine is None:
            self.tell("starting workers")
            self._engine = self.start()
            dashboard = getattr(self._engine, "dashboard", "")
            if dashboard:
                self.tell(Remark(f"The engine's dashboard: {dashboard}"))
        yield from self._engine.run(tasks)

    def close(self) -> None:
        """Stop what was started."""
        if self._engine is not None:
            self._engine.close()

    def __enter__(self) -> StartedLate:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()


def engine_of(workers: int, memory_bytes: int, scheduler: str | None) -> Engine:
    """Start an engine.

    Parameters
    ----------
    workers : int
        Processes of this machine; 0: this process does everything, one task after another.
    memory_bytes : int
        Of each worker.
    scheduler : str, optional
        The address of a Dask scheduler that runs already.

    Raises
    ------
    OptionError
        Dask is not installed.
    """
    if workers == 0 and scheduler is None:
        from gtsam_rwhec.fleet.in_process import InProcess

        return InProcess()
    from gtsam_rwhec.fleet.dask_engine import DaskEngine

    return DaskEngine(workers=workers, memory_bytes=memory_bytes, scheduler=scheduler)


def bytes_of(size: str) -> int:
    """The bytes of a size in words: "2GB", "500 MB", "1.5GiB"; an OptionError for anything else."""
    found = _SIZE.fullmatch(size.strip())
    if found is None or float(found[1]) == 0.0:
        raise OptionError(f"{size!r} is no size of memory; give a number with MB or GB, such as 2GB")
    base = 1024 if found[3] else 1000
    return int(float(found[1]) * base ** _POWERS[found[2].lower()])
