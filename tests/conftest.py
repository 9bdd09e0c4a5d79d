"""Fixtures that several tests share."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import pytest
from places import REPOSITORY

#: Beside calls that OpenCV 5 lacks; with it these run where tests/vision/test_other_opencv.py brings OpenCV 4.
BESIDE_OPENCV_4 = ["compat/test_beside_opencv4.py", "methods/test_opencv4.py"]
collect_ignore = [] if hasattr(cv2, "calibrateRobotWorldHandEye") else BESIDE_OPENCV_4


@pytest.fixture(scope="session")
def utias_folder() -> Path:
    """The RWHEC paper's real dataset, which this repository does not contain."""
    folder = Path(os.environ.get("GTSAM_RWHEC_UTIAS", REPOSITORY.parent / "shared" / "data" / "utias"))
    if not folder.is_dir():
        pytest.fail(f"{folder} does not exist: run `gtsam-rwhec fetch utias DEST` and set GTSAM_RWHEC_UTIAS=DEST")
    return folder
