"""Tasks of the engines' tests: functions of a module, which other processes can import."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.fleet.measured_task import measured_task
from gtsam_rwhec.fleet.tasks import Failed, Receipt, Task


def tried(folder: str, name: str) -> int:
    """How often a task has begun, this time included; one byte in a file for each time."""
    with open(Path(folder) / f"{name}.tried", "ab") as stream:
        stream.write(b".")
    return (Path(folder) / f"{name}.tried").stat().st_size


def writes(folder: str, name: str) -> Receipt:
    with measured_task(name) as measured:
        tried(folder, name)
        return measured.receipt(f"{name}.bin", str(os.getpid()))


def joins(folder: str, name: str, done: tuple[Receipt | Failed, ...]) -> Receipt:
    """A checksum of the words of what it comes after."""
    tried(folder, name)
    said = (each.file if isinstance(each, Receipt) else f"no {each.key}: {each.kind}" for each in done)
    return Receipt(name, f"{name}.bin", " + ".join(said))


def refuses(folder: str, name: str) -> Receipt:
    tried(folder, name)
    raise LogError(f"{name} is not an MCAP file; give another.")


def breaks_off_once(folder: str, name: str) -> Receipt:
    if tried(folder, name) < 2:
        raise ConnectionResetError("the store went away")
    return Receipt(name, f"{name}.bin", "")


def always_breaks_off(folder: str, name: str) -> Receipt:
    tried(folder, name)
    raise TimeoutError("s3://bucket/a?X-Amz-Signature=0123456789abcdef is slow; secret_key=topsecret")


def is_at_fault(folder: str, name: str) -> Receipt:
    tried(folder, name)
    raise KeyError("lost")


def dies_once(folder: str, name: str) -> Receipt:
    if tried(folder, name) == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return Receipt(name, f"{name}.bin", "")


def dies_always(folder: str, name: str) -> Receipt:
    tried(folder, name)
    time.sleep(0.02)  # the byte of the file is there before
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError("not reached")


def floods(folder: str, name: str, count: int) -> Receipt:
    tried(folder, name)
    return Receipt(name, f"{len(bytearray(count))}", "")


def mixed(folder: str) -> list[Task]:
    """Tasks of all ends but a dead worker, with a tree over them, in an order in which they cannot be done."""
    leaves = [Task(f"w{i}", writes, (folder, f"w{i}")) for i in range(4)]
    faults = [
        Task(name, function, (folder, name))
        for name, function in (
            ("refused", refuses), ("once", breaks_off_once), ("always", always_breaks_off), ("fault", is_at_fault)
        )
    ]  # fmt: skip
    low = Task("low", joins, (folder, "low"), after=("w1", "w0"))
    high = Task("high", joins, (folder, "high"), after=("low", "refused", "w3"))
    return [high, low, *leaves, *faults]


def waits_for(folder: str, name: str) -> Receipt:
    """Until the file of this name is there."""
    tried(folder, name)
    while not (Path(folder) / name).exists():
        time.sleep(0.01)
    return Receipt(name, f"{name}.bin", "")
