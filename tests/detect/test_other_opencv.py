"""OpenCV 4 and 5 both work: this folder's tests once more, with the major version that is not installed here.

And those of the calls that OpenCV 5 left out, beside OpenCV 4's own.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
from places import REPOSITORY

HERE = int(cv2.__version__.partition(".")[0])
OTHER, WANTED = (4, "opencv-python-headless>=4.12,<5") if HERE >= 5 else (5, "opencv-python-headless>=5,<6")
#: What pip says when there is no index to be reached.
UNREACHED = ("Failed to establish a new connection", "Temporary failure in name resolution", "Read timed out")


@pytest.fixture(scope="module")
def other_opencv(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds the other major version and nothing else."""
    folder = tmp_path_factory.mktemp("opencv")
    command = [sys.executable, "-m", "pip", "install", "--no-deps", "--only-binary", ":all:", "--retries", "1"]
    done = subprocess.run([*command, "--target", str(folder), WANTED], capture_output=True, text=True, timeout=300)
    if done.returncode and any(words in done.stderr for words in UNREACHED):
        pytest.skip(f"pip reaches no package index, so {WANTED} is not tried: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.parametrize("share", ["a few", pytest.param("all", marks=pytest.mark.engine)])
def test_the_other_opencv(share: str, other_opencv: Path) -> None:
    folders = (REPOSITORY / "tests" / "detect", REPOSITORY / "tests" / "cameras")
    tests = sorted(path for folder in folders for path in folder.glob("test_*.py") if path != Path(__file__))
    assert len(tests) >= 8
    if share == "a few":
        tests = [path for path in tests if path.stem in ("test_tags", "test_intrinsics_files", "test_targets")]
        assert len(tests) == 3
    if OTHER == 4:
        tests += [REPOSITORY / "tests" / "methods" / "test_beside_opencv4.py"]
        tests += [REPOSITORY / "tests" / "methods" / "test_opencv4.py"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(other_opencv), os.environ.get("PYTHONPATH", "")])}
    version = subprocess.run(
        [sys.executable, "-c", "import cv2; print(cv2.__version__)"],
        capture_output=True, text=True, env=environment, check=True,
    )  # fmt: skip
    assert version.stdout.startswith(f"{OTHER}.")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:xdist", "-o", "addopts=-q", *map(str, tests)],
        capture_output=True, text=True, env=environment, cwd=REPOSITORY,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
