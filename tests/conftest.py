"""Fixtures that several tests share."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import pytest
import scipy.linalg  # noqa: F401  # its BLAS is another one than NumPy's, and both are limited
from places import REPOSITORY
from threadpoolctl import threadpool_limits

#: Beside calls that OpenCV 5 lacks; with it these run where tests/vision/test_other_opencv.py brings OpenCV 4.
BESIDE_OPENCV_4 = ["compat/test_beside_opencv4.py", "methods/test_opencv4.py"]
collect_ignore = [] if hasattr(cv2, "calibrateRobotWorldHandEye") else BESIDE_OPENCV_4


def pytest_configure() -> None:
    """Share the cores out among the workers of pytest-xdist: each one's BLAS takes all of them else, and they wait.

    In the workers only, and only in their own process: commands, examples and all that tests start as processes of
    their own run as a user runs them, and so does ``pytest -n0``.
    """
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if workers > 1:
        threadpool_limits(max(1, (os.cpu_count() or 1) // workers), user_api="blas")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The data sets that nobody here made; this repository does not contain them."""
    return Path(os.environ.get("GTSAM_RWHEC_DATA", REPOSITORY.parent / "shared" / "data"))


@pytest.fixture(scope="session")
def utias_folder(shared_data: Path) -> Path:
    """The RWHEC paper's real dataset."""
    folder = Path(os.environ.get("GTSAM_RWHEC_UTIAS", shared_data / "utias"))
    if not folder.is_dir():
        pytest.fail(f"{folder} does not exist: run `gtsam-rwhec fetch utias DEST` and set GTSAM_RWHEC_UTIAS=DEST")
    return folder


@pytest.fixture(scope="session")
def workcell_camera2(shared_data: Path) -> Path:
    """39 images of a checkerboard on an arm by a fixed camera, and the hand's poses (Apache-2.0).

    From davidea97/Multi-Camera-Hand-Eye-Calibration, ``data/medium_workcell/camera2``.
    """
    return _folder_in(shared_data, "workcell_camera2")


@pytest.fixture(scope="session")
def circle_grid_10x10(shared_data: Path) -> Path:
    """15 images of a grid of circles by a camera on an arm's wrist, and the wrist's poses (Apache-2.0).

    From ros-industrial/industrial_calibration, ``examples/data/test_set_10x10``.
    """
    return _folder_in(shared_data, "circle_grid_10x10")


def _folder_in(shared_data: Path, name: str) -> Path:
    folder = shared_data / name
    if not folder.is_dir():
        pytest.fail(f"{folder} does not exist: set GTSAM_RWHEC_DATA to the folder that holds {name}")
    return folder
