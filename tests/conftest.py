"""Fixtures that several tests share."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest
from limited_process import Reader
from places import REPOSITORY

from gtsam_rwhec.geometry.blas_threads import one_blas_thread
from gtsam_rwhec.report.figures import SvgFigure

#: Beside calls that OpenCV 5 lacks; with it these run where tests/detect/test_other_opencv.py brings OpenCV 4.
BESIDE_OPENCV_4 = ["methods/test_beside_opencv4.py", "methods/test_opencv4.py"]
collect_ignore = [] if hasattr(cv2, "calibrateRobotWorldHandEye") else BESIDE_OPENCV_4

#: The tests of the limit itself, which begin with several threads.
OF_THE_LIMIT = "test_blas_threads.py"


def pytest_collection_finish() -> None:
    """What was collected lives to the end: no search for garbage need look at it again."""
    gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def one_thread_of_blas(request: pytest.FixtureRequest) -> Iterator[None]:
    """One BLAS thread, as every public call holds it, for what tests compute around those calls too.

    Without it the threads of BLAS wait in busy loops after each small matrix: twice the processor's time, and
    minutes in place of seconds where cores are busy.
    """
    if request.path.name == OF_THE_LIMIT:
        yield
    else:
        with one_blas_thread():
            yield


@pytest.fixture
def without_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports whose figures are empty, for tests that read other words: to draw ten takes as long as to calibrate.

    Figures of whole runs are drawn in tests/runs/test_whole_runs.py, test_hostile_names.py and test_bad_logs.py.
    """
    monkeypatch.setattr(SvgFigure, "in_page", "<svg></svg>")


@pytest.fixture(scope="module")
def reader() -> Iterator[Reader]:
    """A process that reads hostile files within its limits."""
    with Reader() as process:
        yield process


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
