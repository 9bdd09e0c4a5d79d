"""What a task costs is measured, and what it may have is bounded."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from tasks_of_tests import floods

from gtsam_rwhec.fleet.attempts import attempted
from gtsam_rwhec.fleet.measured_task import measured_task
from gtsam_rwhec.fleet.stores import read_bytes
from gtsam_rwhec.fleet.tasks import Failed, Task

MIB = 1 << 20
linux = pytest.mark.skipif(sys.platform != "linux", reason="the peak since a task began, and bounds, are Linux's")


def test_a_receipt_has_what_the_task_cost(tmp_path: Path) -> None:
    (tmp_path / "log").write_bytes(bytes(1000))
    with measured_task("a") as measured:
        before = time.process_time()
        read_bytes(str(tmp_path / "log"))
        while time.process_time() < before + 0.02:
            pass
        receipt = measured.receipt("partials/a", "00ff", was_there=True)
    assert (receipt.key, receipt.file, receipt.sha256, receipt.was_there) == ("a", "partials/a", "00ff", True)
    assert receipt.bytes_read == 1000
    assert receipt.cpu_s >= 0.02
    assert receipt.seconds >= 0.02


PEAKS = """
import numpy as np
from gtsam_rwhec.fleet.measured_task import measured_task, peak_bytes
np.ones(64 << 20, np.uint8)  # of an earlier task
for name, count in (("small", 1), ("large", 32 << 20)):
    with measured_task(name):
        np.ones(count, np.uint8)
        print(peak_bytes())
"""


@linux
def test_the_peak_is_that_of_the_task() -> None:
    if not os.access("/proc/self/clear_refs", os.W_OK):
        pytest.skip("this system does not let a process forget its peak")
    # In a process of its own: one that has freed much memory takes no new one.
    done = subprocess.run([sys.executable, "-c", PEAKS], capture_output=True, text=True, check=True)
    small, large = map(int, done.stdout.split())
    assert 30 * MIB < large - small < 34 * MIB


@linux
def test_memory_is_bounded(tmp_path: Path) -> None:
    small, large = (
        attempted(Task(name, floods, (str(tmp_path), name, count)), memory_bytes=256 * MIB)
        for name, count in (("small", MIB), ("large", 2048 * MIB))
    )
    assert not isinstance(small, Failed)
    assert isinstance(large, Failed)
    assert large.kind == "MemoryError"
    assert large.reason == "it needs more memory than the 268435456 bytes that a worker may have; give workers more"
    assert np.empty(2048 * MIB, np.uint8).nbytes == 2048 * MIB  # the bound ended with the task
