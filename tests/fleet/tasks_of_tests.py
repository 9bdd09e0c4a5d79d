"""Tasks of the engines' tests: functions of a module, which other processes can import."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from gtsam_rwhec.errors import LogError
from gtsam_rwhec.fleet.tasks import Engine, Failed, Receipt, Task, costs_of


def tried(folder: str, name: str) -> int:
    """How often a task has begun, this time included; one byte in a file for each time."""
    with open(Path(folder) / f"{name}.tried", "ab") as stream:
        stream.write(b".")
    return (Path(folder) / f"{name}.tried").stat().st_size


def writes(folder: str, name: str) -> Receipt:
    with costs_of(name) as receipt_of:
        tried(folder, name)
        return receipt_of(f"{name}.bin", str(os.getpid()))


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
    return Receipt(name, f"{len(bytearray(b'.') * count)}", "")


def waits_for(folder: str, name: str) -> Receipt:
    """Until the file of this name is there."""
    tried(folder, name)
    while not (Path(folder) / name).exists():
        time.sleep(0.01)
    return Receipt(name, f"{name}.bin", "")


def check_failures(engine: Engine, folder: Path) -> None:
    """What holds for every engine: each task once, what breaks off again, and failures as rows without secrets."""
    faults = {"refused": refuses, "once": breaks_off_once, "always": always_breaks_off, "fault": is_at_fault}
    functions = {**{f"w{i}": writes for i in range(4)}, **faults}
    tasks = [Task(name, function, (str(folder), name)) for name, function in functions.items()]
    outcomes = {each.key: each for each in engine.run(tasks)}
    reasons = {key: each.reason for key, each in outcomes.items() if isinstance(each, Failed)}
    assert set(outcomes) == set(functions)
    assert set(reasons) == {"refused", "always", "fault"}
    assert reasons["refused"] == "refused is not an MCAP file; give another."
    assert "is slow" in reasons["always"]
    assert "0123456789abcdef" not in reasons["always"]
    assert "topsecret" not in reasons["always"]
    assert "KeyError: 'lost' (tasks_of_tests.py, line" in reasons["fault"]
    tries = {path.stem: path.stat().st_size for path in folder.glob("*.tried")}
    assert tries == {**dict.fromkeys(functions, 1), "once": 2, "always": 3}
