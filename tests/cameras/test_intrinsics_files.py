"""Intrinsics from files of Kalibr, ROS and OpenCV; every fault has its line."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from intrinsics_samples import CAMCHAIN, ROS

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.intrinsics_files import (
    is_colmap,
    read_calibration_yaml,
    read_cameras,
    read_colmap_cameras,
    read_kalibr_camchain,
)
from gtsam_rwhec.errors import CameraError, FileFormatError, RwhecError


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "camera.yaml"


def test_camchain(path: Path) -> None:
    path.write_text(CAMCHAIN)
    cameras = read_kalibr_camchain(path)
    assert list(cameras) == ["cam0", "cam1"]
    first, second = cameras.values()
    assert (first.width, first.height, first.model) == (752, 480, "radtan")
    assert first.K.tolist() == [[458.6, 0, 367.2], [0, 457.3, 248.4], [0, 0, 1]]
    assert first.D.tolist() == [-0.28, 0.07, 0.0002, 1.8e-05]
    assert (second.width, second.height, second.model) == (640, 480, "equidistant")
    assert second.D.tolist() == [0.01, -0.02, 0.003, -0.0004]


def test_camchain_without_distortion(path: Path) -> None:
    text = CAMCHAIN.replace("distortion_model: radtan", "distortion_model: none")
    path.write_text(text.replace("  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]\n", ""))
    assert read_kalibr_camchain(path)["cam0"].model == "pinhole"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("camera_model: pinhole", "camera_model: omni", "line 6: cam0.intrinsics: [458.6, 457.3, 367.2, 248.4]; a"),
        ("camera_model: pinhole", "camera_model: ds", "line 3: cam0.camera_model: 'ds' is not supported, only"),
        ("distortion_model: radtan", "distortion_model: fov", "line 5: cam0.distortion_model: 'fov' is not supported"),
        ("  distortion_model: radtan\n", "", "line 1: cam0.distortion_model: is missing"),
        ("  intrinsics: [458.6, 457.3, 367.2, 248.4]\n", "", "line 1: cam0.intrinsics: is missing"),
        ("  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]\n", "", "line 1: cam0.distortion_coeffs: is missing"),
        ("distortion_coeffs: [-0.28,", "distortion_coeffs: [", "line 4: cam0.distortion_coeffs: [0.07, 0.0002, 1."),
        ("[458.6,", "[1, 458.6,", "line 6: cam0.intrinsics: [1, 458.6, 457.3, 367.2, 248.4]; a list of 4 numbers was"),
        ("[458.6,", "[a,", "line 6: cam0.intrinsics[0]: 'a'; a finite number was expected"),
        ("[458.6,", "[true,", "line 6: cam0.intrinsics[0]: true; a finite number was expected"),
        ("resolution: [752, 480]", "resolution: [752.5, 480]", "line 7: cam0.resolution: 752.5; a whole number"),
        ("resolution: [752, 480]", "resolution: 752", "line 7: cam0.resolution: 752; a list of 2 numbers was expected"),
        ("resolution: [752, 480]", "resolution:", "line 7: cam0.resolution: is empty"),
        ("cam1:\n", "cam1: 3\nother:\n", "line 9: cam1: 3; a camera's section was expected"),
    ],
)  # fmt: skip
def test_camchain_faults(path: Path, old: str, new: str, words: str) -> None:
    path.write_text(CAMCHAIN.replace(old, new, 1))
    with pytest.raises(FileFormatError) as caught:
        read_kalibr_camchain(path)
    assert str(caught.value).startswith(str(path))
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[458.6,", "[0,", "line 1: cam0: fx = 0 pixels"),
        ("[300, 301,", "[300, -301,", "line 9: cam1: fy = -301 pixels"),
        ("[640, 480]", "[0, 0]", "line 9: cam1: the image size is 0 x 0 pixels"),
    ],
)
def test_camchain_of_no_camera(path: Path, old: str, new: str, words: str) -> None:
    path.write_text(CAMCHAIN.replace(old, new, 1))
    with pytest.raises(CameraError) as caught:
        read_kalibr_camchain(path)
    assert words in str(caught.value)


def test_ros(path: Path) -> None:
    path.write_text(ROS)
    camera = read_calibration_yaml(path)
    assert (camera.width, camera.height, camera.model) == (640, 480, "radtan")
    assert camera.K.tolist() == [[430.2, 0, 306.7], [0, 430.5, 227.2], [0, 0, 1]]
    assert camera.D.tolist() == [-0.34, 0.18, 1e-3, -2e-4]


def test_ros_fisheye_and_messages_as_printed(path: Path) -> None:
    path.write_text(
        "height: 480\nwidth: 640\ndistortion_model: equidistant\nd: [0.1, 0.2, 0.3, 0.4]\n"
        "k:\n- 300.0\n- 0.0\n- 320.0\n- 0.0\n- 301.0\n- 240.0\n- 0.0\n- 0.0\n- 1.0\n"
    )
    camera = read_calibration_yaml(path)
    assert (camera.model, camera.K[1, 1], camera.D.tolist()) == ("equidistant", 301.0, [0.1, 0.2, 0.3, 0.4])


@pytest.mark.parametrize("old_header", [False, True])
@pytest.mark.parametrize("fisheye", [None, 0, 1])
def test_opencv(path: Path, fisheye: int | None, old_header: bool) -> None:
    K = np.array([[500.125, 0, 320.5], [0, 501.25, 240], [0, 0, 1]])
    D = np.array([0.1, -0.2, 1e-5, 3e-4] + ([0.05] if not fisheye else []))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Thu 04 Nov: 10:00")
    storage.writeComment("flags: +fix_aspectRatio")
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    if fisheye is not None:
        storage.write("fisheye_model", fisheye)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", D.reshape(-1, 1))
    storage.write("avg_reprojection_error", 0.25)
    storage.release()
    text = path.read_text()
    assert "!!opencv-matrix" in text
    if old_header:
        path.write_text("%YAML:1.0\n" + text.split("\n", 1)[1])
    camera = read_calibration_yaml(path)
    assert (camera.width, camera.height, camera.model) == (640, 480, "equidistant" if fisheye else "radtan")
    assert camera.K.tolist() == K.tolist()
    assert camera.D.tolist() == D.tolist()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("image_width: 640\n", "", "line 1: no image_width; give a calibration with image_width, image_height"),
        ("image_width: 640", "image_width: wide", "line 1: image_width: 'wide'; a whole number of pixels was expected"),
        ("camera_matrix:", "camera_matrices:", "line 1: no camera_matrix"),
        ("distortion_coefficients:", "coefficients:", "line 1: no distortion_coefficients"),
        ("  rows: 3\n", "", "line 4: camera_matrix.rows: is missing; a matrix has rows, cols and data"),
        ("rows: 1", "rows: 2", "line 12: distortion_coefficients.data: 5 numbers for 2 rows and 5 columns"),
        ("[430.2, 0,", "[430.2,", "line 7: camera_matrix.data: [430.2, 306.7, 0, 430.5, 227.2, 0, 0, 1]; a list of 9 "),
        ("[430.2, 0,", "[430.2, o,", "line 7: camera_matrix.data[1]: 'o'; a finite number was expected"),
        ("[-0.34,", "[.inf,", "line 12: distortion_coefficients.data[0]: inf; a finite number was expected"),
        ("  data: [-0.34,", "  data: 3 # [", "line 12: distortion_coefficients.data: 3; a list of numbers"),
        ("plumb_bob", "omni", "line 8: distortion_model: 'omni' is not supported; supported are none, pinhole"),
        ("image_width: 640", "cam0: {}", "line 1: a Kalibr camchain; give it in the rig file as {kalibr: FILE"),
        ("image_width: 640\n", "fisheye_model: 2\nimage_width: 640\n", ""),
    ],
)  # fmt: skip
def test_calibration_faults(path: Path, old: str, new: str, words: str) -> None:
    text = ROS.replace(old, new, 1)
    if not words:
        text, words = text.replace("distortion_model: plumb_bob\n", ""), "line 1: fisheye_model: 2; give 0 or 1"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        read_calibration_yaml(path)
    assert str(caught.value).startswith(f"{path}, {words}")


def test_four_coefficients_need_a_model(path: Path) -> None:
    text = ROS.replace("distortion_model: plumb_bob\n", "").replace("cols: 5", "cols: 4")
    text = text.replace(", 0]\nrect", "]\nrect")
    path.write_text(text)
    with pytest.raises(FileFormatError, match=r"line 8: distortion_coefficients: four coefficients.*add a line"):
        read_calibration_yaml(path)
    path.write_text(text + "distortion_model: fisheye\n")
    assert read_calibration_yaml(path).model == "equidistant"


def test_a_camera_that_was_not_calibrated(path: Path) -> None:
    path.write_text(ROS.replace("[430.2, 0, 306.7, 0, 430.5, 227.2, 0, 0, 1]", "[0, 0, 0, 0, 0, 0, 0, 0, 0]"))
    with pytest.raises(CameraError, match=r"camera\.yaml, line 4: camera_matrix: K is all zeros"):
        read_calibration_yaml(path)


def test_a_camchain_and_a_calibration_are_not_exchanged(path: Path) -> None:
    path.write_text(ROS)
    with pytest.raises(FileFormatError, match=r"no cameras cam0, cam1, \.\.\. \(it has a camera matrix"):
        read_kalibr_camchain(path)
    path.write_text("- 1\n- 2\n")
    with pytest.raises(FileFormatError, match="no cameras cam0"):
        read_kalibr_camchain(path)
    with pytest.raises(FileFormatError, match="no image_width"):
        read_calibration_yaml(path)
    with pytest.raises(FileFormatError, match="cannot be read"):
        read_calibration_yaml(path.with_name("none.yaml"))


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_mutated_files(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    kalibr = data.draw(st.booleans())
    text = CAMCHAIN if kalibr else ROS
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(text) - 1))
        end = start + data.draw(st.integers(0, 8))
        word = data.draw(st.sampled_from(["", "0", "9", ".nan", "[", "]", ":", "\n", "-", "a"]))
        text = text[:start] + word + text[end:]
    path = tmp_path_factory.getbasetemp() / "mutated.yaml"
    path.write_text(text)
    read = read_kalibr_camchain if kalibr else read_calibration_yaml
    try:
        read(path)
    except RwhecError as error:
        assert "mutated.yaml" in str(error)  # noqa: PT017


PLAIN = "fx: 500\nfy: 501\ncx: 320.5\ncy: 240.5\nwidth: 640\nheight: 480\n"


@pytest.mark.parametrize(
    ("more", "model", "D"),
    [
        ("", "pinhole", []),
        ("k1: 0.1\nk2: 0.02\np1: 0.003\np2: 0.004\nk3: 0.5\n", "radtan", [0.1, 0.02, 0.003, 0.004, 0.5]),
        ("dist_k0: 0.1\ndist_k1: 0.02\ndist_px: 3\ndist_py: 4\ndist_k2: 5\n", "radtan", [0.1, 0.02, 3.0, 4.0, 5.0]),
        ("has_dist_coeff: 0\ndist_k0: 0.1\n", "pinhole", []),
    ],
)  # fmt: skip
def test_plain_numbers(path: Path, more: str, model: str, D: list[float]) -> None:
    path.write_text(PLAIN + more)
    camera = read_calibration_yaml(path)
    assert (camera.width, camera.height, camera.model) == (640, 480, model)
    assert camera.K.tolist() == [[500.0, 0.0, 320.5], [0.0, 501.0, 240.5], [0.0, 0.0, 1.0]]
    assert camera.D.tolist() == D


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("cy: 240.5\n", "", "no cy; plain intrinsics have fx, fy, cx and cy"),
        ("fy: 501", "fy: wide", "fy.*'wide'; a finite number was expected"),
        ("width: 640\n", "", "no image_width"),
        ("fx: 500", "fx: 5", "fx = 5 pixels for an image of 640 x 480"),
    ],
)
def test_plain_numbers_that_are_no_camera(path: Path, old: str, new: str, words: str) -> None:
    path.write_text(PLAIN.replace(old, new))
    with pytest.raises(RwhecError, match=words):
        read_calibration_yaml(path)


@pytest.mark.parametrize("ending", ["yaml", "xml", "json"])
def test_opencv_in_any_form(tmp_path: Path, ending: str) -> None:
    """As tutorials write it: mtx and dist, without the size of the images."""
    path = tmp_path / f"calibration.{ending}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("mtx", np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]]))
    storage.write("dist", np.array([[0.1, -0.2, 1e-3, 2e-3, 0.05]]))
    storage.release()
    with pytest.raises(FileFormatError, match=r"no image_width.*intrinsics: {file: FILE, size: \[width, height\]}"):
        read_cameras(path)
    camera = read_cameras(path, (640, 480))[""]
    assert (camera.width, camera.height, camera.model, camera.K[1, 1]) == (640, 480, "radtan", 501.0)
    assert camera.D.tolist() == [0.1, -0.2, 1e-3, 2e-3, 0.05]


def test_vectors_of_opencv_5(path: Path) -> None:
    """It writes a vector as an nd-matrix with sizes, and OpenCV 4 as a matrix of one column."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.array([[500.0, 0, 320], [0, 501, 240], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([0.1, -0.2, 1e-3, 2e-3, 0.05]))
    storage.release()
    assert read_cameras(path, (640, 480))[""].D.tolist() == [0.1, -0.2, 1e-3, 2e-3, 0.05]


def test_stereo_calibration(path: Path) -> None:
    """OpenCV's sample stereo_calib writes M1, D1, M2, D2."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for number in (1, 2):
        storage.write(f"M{number}", np.array([[500.0 * number, 0, 320], [0, 501, 240], [0, 0, 1]]))
        storage.write(f"D{number}", np.array([[0.1, -0.2, 1e-3, 2e-3, 0.05 * number]]))
    storage.release()
    first, second = read_cameras(path, (640, 480)).values()
    assert (first.K[0, 0], second.K[0, 0], second.D[4]) == (500.0, 1000.0, 0.1)


@pytest.mark.parametrize(
    "text",
    [
        "imageWidth: 640\nimageHeight: 480\nK: [[500, 0, 320], [0, 501, 240], [0, 0, 1]]\nD: []\n",
        "w: 640\nh: 480\nfl_x: 500\nfl_y: 501\ncx: 320\ncy: 240\n",
        "width: 640\nheight: 480\nfx: 500\nfy: 501\nppx: 320\nppy: 240\n",
        "image_size: [640, 480]\nK: [500, 501, 320, 240]\ndist_coeffs: []\n",
    ],
)
def test_names_of_other_programs(path: Path, text: str) -> None:
    path.write_text(text)
    camera = read_cameras(path)[""]
    assert (camera.width, camera.height, camera.model) == (640, 480, "pinhole")
    assert camera.K.tolist() == [[500.0, 0.0, 320.0], [0.0, 501.0, 240.0], [0.0, 0.0, 1.0]]
    with pytest.raises(FileFormatError, match=r"640 x 480 pixels, and size: \[64, 48\] was stated"):
        read_cameras(path, (64, 48))


def test_whichever_file_it_is(tmp_path: Path) -> None:
    for name, text in {"chain.yaml": CAMCHAIN, "ost.yaml": ROS, "cameras.txt": "1 PINHOLE 64 48 50 50 32 24\n"}.items():
        (tmp_path / name).write_text(text)
    assert list(read_cameras(tmp_path / "chain.yaml")) == ["cam0", "cam1"]
    assert list(read_cameras(tmp_path / "ost.yaml")) == [""]
    assert list(read_cameras(tmp_path / "cameras.txt")) == ["1"]


OMNI = CAMCHAIN.replace("pinhole", "omni", 1).replace("[458.6,", "[1.3, 458.6,")
K = [[458.6, 0.0, 367.2], [0.0, 457.3, 248.4], [0.0, 0.0, 1.0]]
D = [-0.28, 0.07, 0.0002, 1.8e-05]


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


HEAD = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
LINES = {
    "SIMPLE_PINHOLE 640 480 500 320 240": ("pinhole", 500.0, []),
    "PINHOLE 640 480 500 501 320 240": ("pinhole", 501.0, []),
    "SIMPLE_RADIAL 640 480 500 320 240 0.1": ("radtan", 500.0, [0.1, 0.0, 0.0, 0.0]),
    "RADIAL 640 480 500 320 240 0.1 0.02": ("radtan", 500.0, [0.1, 0.02, 0.0, 0.0]),
    "OPENCV 640 480 500 501 320 240 0.1 0.02 3e-3 4e-3": ("radtan", 501.0, [0.1, 0.02, 3e-3, 4e-3]),
    "FULL_OPENCV 640 480 500 501 320 240 .1 .02 .003 .004 .05 .06 .07 .08": (
        "radtan", 501.0, [0.1, 0.02, 0.003, 0.004, 0.05, 0.06, 0.07, 0.08],
    ),
    "OPENCV_FISHEYE 640 480 500 501 320 240 0.1 0.02 0.3 0.4": ("equidistant", 501.0, [0.1, 0.02, 0.3, 0.4]),
}  # fmt: skip


@pytest.mark.parametrize("line", sorted(LINES))
def test_each_model(tmp_path: Path, line: str) -> None:
    text = f"{HEAD}7 {line}\n"
    (tmp_path / "cameras.txt").write_text(text)
    assert is_colmap(text)
    (camera,) = read_colmap_cameras(tmp_path / "cameras.txt").values()
    model, fy, D = LINES[line]
    assert (camera.width, camera.height, camera.model) == (640, 480, model)
    # The middle of COLMAP's first pixel is at 0.5, and here at 0.
    assert camera.K.tolist() == [[500.0, 0.0, 319.5], [0.0, fy, 239.5], [0.0, 0.0, 1.0]]
    assert camera.D.tolist() == D


def test_cameras_have_colmaps_numbers(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text(f"{HEAD}2 PINHOLE 64 48 50 50 32 24\n1 PINHOLE 64 48 60 60 32 24\n")
    assert [c.K[0, 0] for c in read_colmap_cameras(tmp_path / "cameras.txt").values()] == [50.0, 60.0]
    assert list(read_colmap_cameras(tmp_path / "cameras.txt")) == ["2", "1"]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("1 FOV 64 48 50 50 32 24 0.9", "line 3: the model 'FOV' is not supported; supported are SIMPLE_PINHOLE, "),
        ("1 OPENCV 64 48 50 50 32 24", "line 3: OPENCV has the parameters fx fy cx cy k1 k2 p1 p2, and here are 4"),
        ("1 PINHOLE 64 48 50 50 32 x", "line 3: a parameter is no number"),
        ("1 PINHOLE 64 48 50 50 32 inf", "line 3: PINHOLE has the parameters"),
        ("1 PINHOLE wide 48 50 50 32 24", "line 3: '1 PINHOLE wide 48 50 50 32 24' is no camera of COLMAP"),
        ("1 PINHOLE 64 48 50 50 32 24\n1 PINHOLE 64 48 50 50 32 24", "line 4: camera 1 is there twice"),
        ("", "has no cameras"),
    ],
)  # fmt: skip
def test_what_is_no_camera(tmp_path: Path, line: str, words: str) -> None:
    (tmp_path / "cameras.txt").write_text(f"{HEAD}{line}\n")
    with pytest.raises(FileFormatError) as caught:
        read_colmap_cameras(tmp_path / "cameras.txt")
    assert words in str(caught.value)
