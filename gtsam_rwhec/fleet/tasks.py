"""What a fleet's run is made of: tasks that write one file each, in an order, and what carries them out.

A task's function writes its file to the output under the task's key, and returns a receipt. The key is a checksum of
all that the file depends on (the log, the rig file, the options, the version), so a file that is there already is what
the task would write: nothing is done twice, and two runs at once write the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol


@dataclass(frozen=True)
class Receipt:
    """What a task did. Small: it travels between processes, the file does not.

    Attributes
    ----------
    key : str
        The task's key.
    file : str
        The file's place below the output, with slashes.
    sha256 : str
        Checksum of the file's bytes, in hexadecimal digits.
    was_there : bool
        Whether an earlier run, or another one, had written the file.
    cpu_s : float
        Seconds of the processor.
    seconds : float
        Seconds on the clock.
    bytes_read : int
        Bytes that came from the store of the logs.
    peak_bytes : int
        Peak memory of the process since the task began, bytes.
    """

    key: str
    file: str
    sha256: str
    was_there: bool = False
    cpu_s: float = 0.0
    seconds: float = 0.0
    bytes_read: int = 0
    peak_bytes: int = 0


@dataclass(frozen=True)
class Failed:
    """A task that gave no file: a row of the report.

    Attributes
    ----------
    key : str
        The task's key.
    reason : str
        What was wrong, where, and what to do; without credentials.
    kind : str
        The name of the error's class.
    attempts : int
        How often it was tried.
    """

    key: str
    reason: str
    kind: str
    attempts: int = 1


@dataclass(frozen=True)
class Task:
    """One call of ``function(*arguments)``, or of ``function(*arguments, done)`` where it comes after others.

    Attributes
    ----------
    key : str
        Unique in a run.
    function : callable
        A function of a module, which other processes can import. It returns a Receipt, raises an OSError for what a
        second attempt may mend, and an error of the library for what none does.
    arguments : tuple
        Small, and picklable.
    after : tuple of str
        Keys of the tasks whose receipts it gets, in this order, as its last argument ``done`` (a tuple), which is not
        there where this is empty. A failure of one of them does not stop it: it gets the Failed.
    """

    key: str
    function: Callable[..., Receipt]
    arguments: tuple[Any, ...] = ()
    after: tuple[str, ...] = field(default=())


class Engine(Protocol):
    """What carries out tasks: Dask, or this process."""

    def run(self, tasks: Iterable[Task]) -> Iterator[Receipt | Failed]:
        """Yield one receipt or failure for each task, as they end; a dead worker's tasks are tried again."""
        ...

    def close(self) -> None:
        """Stop what was started for the run."""
        ...
