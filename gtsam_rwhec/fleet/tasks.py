"""What a fleet's run is made of: tasks that write one file each, what each cost, and how one is carried out.

A task's function writes its file to the output under the task's key, and returns a receipt. The key is a checksum of
all that the file depends on (the log, the rig file, the options, the version), so a file that is there already is what
the task would write: nothing is done twice, and two runs at once write the same bytes.
"""

from __future__ import annotations

import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from gtsam_rwhec.errors import FileFormatError, RwhecError
from gtsam_rwhec.fleet.store_requests import without_secrets
from gtsam_rwhec.fleet.stores import ByteCount, counted_bytes, exists, read_bytes, write_once
from gtsam_rwhec.geometry.blas_threads import one_blas_thread

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

#: A task is tried so often, for errors of the system and for workers that die.
ATTEMPTS = 3
_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass(frozen=True)
class Receipt:
    """What a task did. Small: it travels between processes, the file does not."""

    key: str  #: The task's key
    file: str  #: The file's place below the output, with slashes
    sha256: str  #: Checksum of the file's bytes, in hexadecimal digits
    was_there: bool = False  #: Whether an earlier run, or another one, had written the file
    #: cpu_s, seconds: of the processor, and on the clock
    cpu_s: float = 0.0
    seconds: float = 0.0
    bytes_read: int = 0  #: Bytes that came from the store of the logs
    peak_bytes: int = 0  #: Peak memory of the process since the task began


@dataclass(frozen=True)
class Failed:
    """A task that gave no file: what was wrong, where, and what to do; without credentials."""

    key: str
    reason: str


@dataclass(frozen=True)
class Task:
    """One call of ``function(*arguments)``."""

    key: str  #: Unique in a run
    #: A function of a module, which other processes can import. It returns a Receipt, raises an OSError for what a
    #: second attempt may mend, and an error of the library for what none does
    function: Callable[..., Receipt]
    arguments: tuple[Any, ...] = ()  #: Small, and picklable


class Engine(Protocol):
    """What carries out tasks: Dask, or this process."""

    def run(self, tasks: Iterable[Task]) -> Iterator[Receipt | Failed]:
        """Yield one receipt or failure for each task, as they end; a dead worker's tasks are tried again."""
        ...


class InProcess:
    """The engine without other processes: one task after another in this one."""

    def run(self, tasks: Iterable[Task]) -> Iterator[Receipt | Failed]:
        """Yield one receipt or failure for each task, in their order."""
        for task in tasks:
            for attempt in range(1, ATTEMPTS + 1):
                try:
                    outcome = carried_out(task)
                    break
                except OSError as error:
                    outcome = failed(task, error)
                    time.sleep(0.1 * attempt)
            yield outcome


def carried_out(task: Task) -> Receipt | Failed:
    """The task's receipt, or why there is none; an OSError (a disk, a network, a store) is for whoever tries again.

    All other errors would come again: they are a row of the report, not the end of the run. BLAS has one thread.
    """
    try:
        with one_blas_thread():
            return task.function(*task.arguments)
    except OSError as error:
        raise OSError(_words(error)) from None  # the store's own error may not travel, and may repeat credentials
    except RwhecError as error:
        return failed(task, error)
    except MemoryError:
        return Failed(task.key, "it needs more memory than there is; give workers more")
    except Exception as error:  # noqa: BLE001  (one task's fault is a row of the report, not the end of the run)
        frames = traceback.extract_tb(error.__traceback__)
        place = f"{Path(frames[-1].filename).name}, line {frames[-1].lineno}"
        words = f"a fault of the program: {type(error).__name__}: {error} ({place})"
        return Failed(task.key, without_secrets(words))


def failed(task: Task, error: BaseException) -> Failed:
    """The row of a task that ended with an error."""
    return Failed(task.key, _words(error))


def _words(error: BaseException) -> str:
    return without_secrets(str(error) or type(error).__name__)


def below(output: str, file: str) -> str:
    """The URL of a file of the output."""
    return f"{output.rstrip('/')}/{file}"


def kept_receipt(output: str, key: str, file: str) -> Receipt | None:
    """The receipt of a file that is there and whole, for the task `key`; None where it is still to be made."""
    url = below(output, _place(file))
    if not (exists(url) and exists(below(output, file))):
        return None
    try:
        return replace(Receipt(**json.loads(read_bytes(url))), key=key, was_there=True)
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"{url} is no receipt of a fleet; remove it, and run again") from error


def keep_receipt(output: str, receipt: Receipt) -> Receipt:
    """Keep the receipt of a file that is written; it comes last, so that a file with a receipt is whole."""
    write_once(below(output, _place(receipt.file)), json.dumps(asdict(receipt), sort_keys=True).encode())
    return receipt


def _place(file: str) -> str:
    return f"{file}.receipt.json"


@dataclass
class Costs:
    """What a task has cost so far, and its receipt at the end."""

    key: str
    _bytes: ByteCount
    _cpu_s: float = field(default_factory=lambda: _cpu_s())
    _began_s: float = field(default_factory=time.monotonic)

    def receipt(self, file: str, sha256: str) -> Receipt:
        """The task's receipt, with its costs from the beginning until now."""
        return Receipt(
            key=self.key,
            file=file,
            sha256=sha256,
            cpu_s=_cpu_s() - self._cpu_s,
            seconds=time.monotonic() - self._began_s,
            bytes_read=self._bytes.count,
            peak_bytes=peak_bytes(),
        )


@contextmanager
def costs_of(key: str) -> Iterator[Costs]:
    """Measure what a task costs in the block."""
    _forget_peak()
    with counted_bytes() as count:
        yield Costs(key, count)


def peak_bytes() -> int:
    """Peak memory (resident) of this process, bytes.

    On Linux it is the peak since the task began, elsewhere since the process began; 0 on Windows, which does not tell.
    """
    if _STATUS.exists():
        with open(_STATUS, encoding="ascii", errors="replace") as lines:
            return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:")), 0)
    if resource is None:
        return 0
    return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1 if sys.platform == "darwin" else 1024)


def _cpu_s() -> float:
    """Seconds of the processor of this process and of those that it started and that have ended."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


def _forget_peak() -> None:
    """Let Linux measure the peak from now on; where it may not be told so, the peak is that of the process."""
    try:
        told = os.open(_CLEAR, os.O_WRONLY)
    except OSError:
        return
    try:
        os.write(told, b"5")
    finally:
        os.close(told)
