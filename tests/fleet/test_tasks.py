"""Tasks travel between processes, are tried again where that may help, and their costs are measured."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tasks_of_tests import check_failures, writes

from gtsam_rwhec.fleet.stores import read_bytes
from gtsam_rwhec.fleet.tasks import InProcess, Task, costs_of

MIB = 1 << 20


def test_a_task_is_the_same_on_the_other_side() -> None:
    task = Task("a", writes, ("folder", "a"))
    assert pickle.loads(pickle.dumps(task)) == task


def test_failures_in_this_process(tmp_path: Path) -> None:
    check_failures(InProcess(), tmp_path)


def test_a_receipt_has_what_the_task_cost(tmp_path: Path) -> None:
    (tmp_path / "log").write_bytes(bytes(1000))
    with costs_of("a") as receipt_of:
        before = time.process_time()
        read_bytes(str(tmp_path / "log"))
        while time.process_time() < before + 0.02:
            pass
        receipt = receipt_of("partials/a", "00ff")
    assert (receipt.key, receipt.file, receipt.sha256, receipt.was_there) == ("a", "partials/a", "00ff", False)
    assert receipt.bytes_read == 1000
    assert receipt.cpu_s >= 0.02
    assert receipt.seconds >= 0.02


PEAKS = """
import numpy as np
from gtsam_rwhec.fleet.tasks import costs_of, peak_bytes
np.ones(64 << 20, np.uint8)  # of an earlier task
for name, count in (("small", 1), ("large", 32 << 20)):
    with costs_of(name):
        np.ones(count, np.uint8)
        print(peak_bytes())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the peak since a task began is Linux's")
def test_the_peak_is_that_of_the_task() -> None:
    if not os.access("/proc/self/clear_refs", os.W_OK):
        pytest.skip("this system does not let a process forget its peak")
    # In a process of its own: one that has freed much memory takes no new one.
    done = subprocess.run([sys.executable, "-c", PEAKS], capture_output=True, text=True, check=True)
    small, large = map(int, done.stdout.split())
    assert 30 * MIB < large - small < 34 * MIB
