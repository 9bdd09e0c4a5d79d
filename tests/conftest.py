"""Fixtures that several tests share."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest
from places import REPOSITORY

from gtsam_rwhec.geometry.blas_threads import one_blas_thread

#: Beside calls that OpenCV 5 lacks; with it these run where tests/detect/test_other_opencv.py brings OpenCV 4.
BESIDE_OPENCV_4 = ["methods/test_beside_opencv4.py", "methods/test_opencv4.py"]
collect_ignore = [] if hasattr(cv2, "calibrateRobotWorldHandEye") else BESIDE_OPENCV_4

#: Packages whose functions users reach only through calls that hold the limit of one BLAS thread.
BELOW_THE_LIMIT = ("fitting", "solver")


@pytest.fixture(scope="module", autouse=True)
def one_thread_below_the_limit(request: pytest.FixtureRequest) -> Iterator[None]:
    """One BLAS thread for tests of inner functions, as their callers in the library hold it.

    Without it the threads of two workers wait for each other: minutes in place of seconds where cores are busy.
    """
    if request.path.parent.name in BELOW_THE_LIMIT:
        with one_blas_thread():
            yield
    else:
        yield


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The data sets that nobody here made; this repository does not contain them."""
    return Path(os.environ.get("GTSAM_RWHEC_DATA", REPOSITORY.parent / "shared" / "data"))


@pytest.fixture(scope="session")
def utias_folder(shared_data: Path) -> Path:
    """The RWHEC paper's real dataset."""
    folder = Path(os.environ.get("GTSAM_RWHEC_UTIAS", shared_data / "utias"))
    return _there(folder, "run `gtsam-rwhec fetch utias DEST` and set GTSAM_RWHEC_UTIAS=DEST")


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
    return _there(
        shared_data / name, f"set GTSAM_RWHEC_DATA to the folder that holds {name} (CONTRIBUTING.md says whose)"
    )


def _there(folder: Path, how: str) -> Path:
    """The folder of a data set that the repository does not hold; tests that need it skip where it is not there."""
    if not folder.is_dir():
        pytest.skip(f"{folder} does not exist: {how}")
    return folder
