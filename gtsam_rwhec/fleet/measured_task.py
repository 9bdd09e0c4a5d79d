"""What a task costs: seconds of the processor and on the clock, bytes from the store, the peak of the memory.

with measured_task(key) as measured:
    ...
    return measured.receipt("partials/robot_1/run.npz", sha256)
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from gtsam_rwhec.fleet.byte_count import ByteCount, counted_bytes
from gtsam_rwhec.fleet.tasks import Receipt

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
#: Bytes that a task may always have beyond what its process has.
_LEAST = 64 << 20


@dataclass
class Measured:
    """What the task has cost so far, and its receipt at the end."""

    key: str
    _bytes: ByteCount
    _cpu_s: float = field(default_factory=lambda: _cpu_s())
    _began_s: float = field(default_factory=time.monotonic)

    def receipt(self, file: str, sha256: str, was_there: bool = False) -> Receipt:
        """The task's receipt, with its costs from the beginning until now."""
        return Receipt(
            key=self.key,
            file=file,
            sha256=sha256,
            was_there=was_there,
            cpu_s=_cpu_s() - self._cpu_s,
            seconds=time.monotonic() - self._began_s,
            bytes_read=self._bytes.count,
            peak_bytes=peak_bytes(),
        )


@contextmanager
def measured_task(key: str) -> Iterator[Measured]:
    """Measure what happens in the block: bytes that ``stores`` and ``log_parts`` read count without a word."""
    _forget_peak()
    with counted_bytes() as count:
        yield Measured(key, count)


def peak_bytes() -> int:
    """Peak memory (resident) of this process, bytes.

    On Linux it is the peak since the task began, elsewhere since the process began; 0 on Windows, which does not tell.
    """
    if _STATUS.exists():
        return _in_status("VmHWM")
    if resource is None:
        return 0
    return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1 if sys.platform == "darwin" else 1024)


@contextmanager
def bounded_memory(most_bytes: int | None) -> Iterator[None]:
    """Let this process have `most_bytes` of memory in the block; beyond that Python raises a MemoryError.

    The bound is one of data that is written (``RLIMIT_DATA``), so that libraries in memory do not count twice. Where
    the system has none (macOS, Windows) nothing is bounded here. For worker processes only: all threads share it.
    """
    if most_bytes is None or resource is None or not _STATUS.exists():
        yield
        return
    before = resource.getrlimit(resource.RLIMIT_DATA)
    most = _in_status("VmData") + max(_LEAST, most_bytes - _in_status("VmRSS"))
    if before[1] != resource.RLIM_INFINITY:
        most = min(most, before[1])
    resource.setrlimit(resource.RLIMIT_DATA, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _in_status(name: str) -> int:
    """A size in Linux's words of this process, bytes."""
    with open(_STATUS, encoding="ascii", errors="replace") as lines:
        return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:")), 0)


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
