"""The same input gives the same result whatever the number of threads, cores and workers.

To the last bit: with another number of threads BLAS adds the parts of its sums in another order, so the library
computes with one, whatever the environment says.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from places import DEMO, REPOSITORY

#: BLAS's threads, cores, workers that detect.
PLACES = {"one thread": (1, None, 1), "two": (2, None, 2), "four": (4, None, 3), "four on one core": (4, 1, 2)}


def answers(folder: Path, out: Path, place: str) -> dict[str, np.ndarray]:
    threads, cores, workers = PLACES[place]
    if cores is not None and not hasattr(os, "sched_setaffinity"):
        pytest.skip("this system does not let a process choose its cores")
    command = [sys.executable, str(REPOSITORY / "tests" / "answers_on_these_cores.py"), str(folder), str(out)]
    command += ["--workers", str(workers), *([] if cores is None else ["--cores", str(cores)])]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": str(threads), "OMP_NUM_THREADS": str(threads)}
    subprocess.run(command, check=True, env=environment)
    with np.load(out) as found:
        return dict(found)


@pytest.mark.parametrize(("data", "others"), [("demo", ["two", "four on one core"]), ("utias", ["four"])])
def test_threads_cores_and_workers(
    data: str, others: list[str], request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    folder = DEMO if data == "demo" else request.getfixturevalue("utias_folder")
    found = {
        place: answers(folder, tmp_path / f"{number}.npz", place)
        for number, place in enumerate(["one thread", *others])
    }
    expected = found.pop("one thread")
    assert expected["status"] == "certified"
    assert len(expected["detections: poses"]) > 20
    for place, other in found.items():
        assert other.keys() == expected.keys()
        for name, values in expected.items():
            np.testing.assert_array_equal(other[name], values, err_msg=f"{place}, {name}")
