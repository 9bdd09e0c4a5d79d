"""Unified (omnidirectional) cameras in files of Kalibr, OpenCV's omnidir, ROS and plain numbers."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from intrinsics_samples import CAMCHAIN, ROS

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.intrinsics_files import read_calibration_yaml, read_cameras, read_kalibr_camchain
from gtsam_rwhec.errors import CameraError, FileFormatError

OMNI = CAMCHAIN.replace("pinhole", "omni", 1).replace("[458.6,", "[1.3, 458.6,")
K = [[458.6, 0.0, 367.2], [0.0, 457.3, 248.4], [0.0, 0.0, 1.0]]
D = [-0.28, 0.07, 0.0002, 1.8e-05]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "camera.yaml"


def assert_is_sample(camera: Camera) -> None:
    assert (camera.model, camera.width, camera.height) == ("unified", 752, 480)
    assert camera.K.tolist() == K
    assert camera.D.tolist() == [1.3, *D]


def test_kalibrs_omni_has_xi_first(path: Path) -> None:
    path.write_text(OMNI)
    assert_is_sample(read_kalibr_camchain(path)["cam0"])
    path.write_text(OMNI.replace("radtan", "none").replace("  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]\n", ""))
    assert read_kalibr_camchain(path)["cam0"].D.tolist() == [1.3, 0.0, 0.0, 0.0, 0.0]
    path.write_text(OMNI.replace("radtan", "equidistant"))
    with pytest.raises(FileFormatError, match="'equidistant' is not supported; supported are none, radtan"):
        read_kalibr_camchain(path)


@pytest.mark.parametrize("suffix", ["xml", "yml"])
@pytest.mark.parametrize("is_matrix", [True, False])
def test_opencvs_omnidir_has_xi_beside_the_matrix(tmp_path: Path, suffix: str, is_matrix: bool) -> None:
    path = tmp_path / f"omni.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.array(K))
    storage.write("distortion_coefficients", np.array([D]))
    storage.write("xi", np.array([[1.3]]) if is_matrix else 1.3)
    storage.release()
    assert_is_sample(read_cameras(path, (752, 480))[""])


def test_ros_and_plain_numbers(path: Path) -> None:
    text = ROS.replace("plumb_bob", "unified").replace("640", "752")
    path.write_text(text.replace("[-0.34, 0.18, 1e-3, -2.e-4, 0]", "[1.3, -0.34, 0.18, 1e-3, -2e-4]"))
    assert read_calibration_yaml(path).D.tolist() == [1.3, -0.34, 0.18, 1e-3, -2e-4]
    plain = "width: 752\nheight: 480\nfx: 458.6\nfy: 457.3\ncx: 367.2\ncy: 248.4\nxi: 1.3\n"
    path.write_text(plain + "k1: -0.28\nk2: 0.07\np1: 0.0002\np2: 1.8e-05\n")
    assert_is_sample(read_calibration_yaml(path))
    path.write_text(plain + "k3: 0.1\n")
    with pytest.raises(CameraError, match="too many for the model unified"):
        read_calibration_yaml(path)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("xi: wide", r"xi\[0\]: 'wide'; a finite number was expected"),
        ("xi: [1, 2]", r"xi: \[1, 2\]; a list of 1 numbers was expected"),
        ("xi: 1.0\ndistortion_model: fisheye", "distortion_model: 'fisheye', and xi, which only the unified model has"),
    ],
)
def test_faults_have_their_line(path: Path, line: str, words: str) -> None:
    path.write_text(ROS.replace("distortion_model: plumb_bob\n", "") + f"{line}\n")
    with pytest.raises(FileFormatError, match=rf"line \d+: {words}"):
        read_calibration_yaml(path)
