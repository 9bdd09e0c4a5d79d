"""The tasks of a fleet's run: each writes one file. How a task is run, and what it costs.

A task's function writes its file to the output under the task's key and returns a receipt. The key is a checksum of
everything that the file depends on (log, rig file, options, version). So an existing file is the one that the task
would write: no work is done twice, and two runs at the same time write the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

from gtsam_rwhec.errors import FileFormatError, RwhecError
from gtsam_rwhec.fleet.stores import counted_bytes, exists, read_bytes, without_secrets, write_once
from gtsam_rwhec.geometry.blas_threads import one_blas_thread

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

#: The most attempts of a task after errors of the system or the death of its worker.
ATTEMPTS = 3
_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass(frozen=True)
class Receipt:
    """What a task did. It is small and is sent between processes; the file is not sent."""

    key: str  #: The task's key
    file: str  #: The file's path in the output, with slashes
    sha256: str  #: Checksum of the file's bytes, in hexadecimal digits
    was_there: bool = False  #: Whether another run had written the file
    #: cpu_s, seconds: CPU time, and elapsed time
    cpu_s: float = 0.0
    seconds: float = 0.0
    bytes_read: int = 0  #: Bytes that came from the store of the logs
    peak_bytes: int = 0  #: Peak memory of the process since the task began


@dataclass(frozen=True)
class Failed:
    """A task without a file: what was wrong, where, and what to do; without credentials."""

    key: str
    reason: str


@dataclass(frozen=True)
class Task:
    """One call of ``function(*arguments)``."""

    key: str  #: Unique in a run
    #: A function of a module, which other processes can import. It returns a Receipt. It raises an OSError if a second
    #: attempt may help, else an error of the library
    function: Callable[..., Receipt]
    arguments: tuple[Any, ...] = ()  #: Small, and picklable


class Engine(Protocol):
    """The protocol of an engine, which runs tasks: on Dask, or in this process."""

    def run(self, tasks: Iterable[Task]) -> Iterator[Receipt | Failed]:
        """Yield one receipt or failure for each task in the order in which they end; repeat a dead worker's tasks."""
        ...


class InProcess:
    """The engine that runs one task after another in this process."""

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
    """The task's receipt or failure. An OSError (disk, network, store) is raised, so that the caller tries again.

    Other errors would occur again: each becomes a row of the report and the run continues. BLAS has one thread.
    """
    try:
        with one_blas_thread():
            return task.function(*task.arguments)
    except OSError as error:
        raise OSError(_words(error)) from None  # the store's own error may not be picklable, and may have credentials
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
    """The failure of a task that ended with an error."""
    return Failed(task.key, _words(error))


def _words(error: BaseException) -> str:
    return without_secrets(str(error) or type(error).__name__)


def below(output: str, file: str) -> str:
    """The URL of a file of the output."""
    return f"{output.rstrip('/')}/{file}"


def kept_receipt(output: str, key: str, file: str) -> Receipt | None:
    """The receipt of the complete file of the task `key`; None if the file must still be made."""
    url = below(output, _place(file))
    if not (exists(url) and exists(below(output, file))):
        return None
    try:
        return replace(Receipt(**json.loads(read_bytes(url))), key=key, was_there=True)
    except (ValueError, TypeError) as error:
        raise FileFormatError(f"{url} is no receipt of a fleet; remove it, and run again") from error


def filed(output: str, key: str, file: str, content: Callable[[Path], bytes]) -> Receipt:
    """The receipt of a task's file, which has the bytes that `content` makes in a temporary folder.

    Without work if another run has made it. The receipt is written last, so that a file with a receipt is complete.
    """
    kept = kept_receipt(output, key, file)
    if kept is not None:
        return kept
    with costs_of(key) as receipt_of, TemporaryDirectory(prefix="gtsam-rwhec-") as folder:
        data = content(Path(folder))
        write_once(below(output, file), data)
        receipt = receipt_of(file, hashlib.sha256(data).hexdigest())
    write_once(below(output, _place(file)), json.dumps(asdict(receipt), sort_keys=True).encode())
    return receipt


def key_of(*parts: object) -> str:
    """The key of a task whose file depends on these parts."""
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:40]


def _place(file: str) -> str:
    return f"{file}.receipt.json"


@contextmanager
def costs_of(key: str) -> Iterator[Callable[[str, str], Receipt]]:
    """Measure what a task costs in the block; yields what makes its receipt from a file and its checksum."""
    _forget_peak()
    cpu_s, began_s = _cpu_s(), time.monotonic()
    with counted_bytes() as count:
        yield lambda file, sha256: Receipt(
            key,
            file,
            sha256,
            cpu_s=_cpu_s() - cpu_s,
            seconds=time.monotonic() - began_s,
            bytes_read=count.count,
            peak_bytes=peak_bytes(),
        )


def peak_bytes() -> int:
    """Peak memory (resident) of this process, bytes.

    On Linux it is the peak since the task began, elsewhere since the process began; on Windows it is 0 (unknown).
    """
    if _STATUS.exists():
        with open(_STATUS, encoding="ascii", errors="replace") as lines:
            return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:")), 0)
    if resource is None:
        return 0
    return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1 if sys.platform == "darwin" else 1024)


def _cpu_s() -> float:
    """CPU seconds of this process and of its child processes that have ended."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


def _forget_peak() -> None:
    """Make Linux measure the peak from now on; without the right to do so, the peak is that of the process."""
    try:
        told = os.open(_CLEAR, os.O_WRONLY)
    except OSError:
        return
    try:
        os.write(told, b"5")
    finally:
        os.close(told)
