"""Cameras in files of Kalibr, ROS, OpenCV and COLMAP, read back by what reads such files, and by their own rules."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from exported_rigs import ONE, POSES, camera, on_random_poses
from hypothesis import given, settings

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.intrinsics_files import (
    read_calibration_yaml,
    read_cameras,
    read_colmap_cameras,
    read_kalibr_camchain,
)
from gtsam_rwhec.errors import FileFormatError
from gtsam_rwhec.rig import (
    RigFrames,
    camchain_yaml,
    camera_info_yaml,
    colmap_cameras_txt,
    export_all,
    opencv_yaml,
    static_tf_launch,
    tf_yaml,
)

#: Every lens model, with as many coefficients as it may have; numbers with all their digits.
LENSES = {
    "pinhole": camera("pinhole", ()),
    "four": camera("radtan", (-0.28 / 3.0, 0.07 / 3.0, 1e-5 / 3.0, -2e-4 / 3.0)),
    "five": camera("radtan", (-0.28, 0.07, 1e-5, -2e-4, 0.1 / 3.0)),
    "eight": camera("radtan", (-0.28, 0.07, 1e-5, -2e-4, 0.01, 0.02, -0.03, 0.1 / 3.0)),
    "prism": camera("radtan", (-0.28, 0.07, 1e-5, -2e-4, 0.01, 0.02, -0.03, 0.04, 1e-3, 2e-3, 3e-3, 0.1 / 3.0)),
    "fisheye": camera("equidistant", (0.01, -2e-3, 3e-4, 1e-5 / 3.0)),
    "mirror": camera("unified", (4.0 / 3.0, -0.28, 0.07, 1e-5, -2e-4)),
}
#: What each format has of them.
IN_ROS = ("pinhole", "four", "five", "eight", "fisheye")
IN_COLMAP = {
    "pinhole": "PINHOLE", "four": "OPENCV", "five": "FULL_OPENCV", "eight": "FULL_OPENCV", "fisheye": "OPENCV_FISHEYE",
}  # fmt: skip
RIG = RigFrames("hand", "base", dict.fromkeys([*LENSES, "lidar"], np.eye(4)), {}, cameras=LENSES)


def assert_same(read: Camera, written: Camera, off_px: float = 0.0) -> None:
    assert (read.model, read.width, read.height) == (written.model, written.width, written.height)
    np.testing.assert_allclose(read.K, written.K, rtol=0.0, atol=off_px)
    np.testing.assert_array_equal(read.D, written.D)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("exported")
    export_all(RIG, path)
    return path


def test_camera_info_has_every_lens_that_ros_has(folder: Path) -> None:
    files = {path.stem: path for path in (folder / "camera_info").iterdir()}
    assert set(files) == set(IN_ROS)
    for name, path in files.items():
        assert_same(read_calibration_yaml(path), LENSES[name])
        fields = yaml.safe_load(path.read_text(encoding="utf-8"))
        # What camera_calibration_parsers asks for, in both versions of ROS.
        assert list(fields) == [
            "image_width", "image_height", "camera_name", "camera_matrix", "distortion_model",
            "distortion_coefficients", "rectification_matrix", "projection_matrix",
        ]  # fmt: skip
        assert fields["camera_name"] == name
        P = np.array(fields["projection_matrix"]["data"]).reshape(3, 4)
        np.testing.assert_array_equal(P, np.column_stack([LENSES[name].K, np.zeros(3)]))
        assert fields["rectification_matrix"]["data"] == np.eye(3).ravel().tolist()
        model, count = {"fisheye": ("equidistant", 4), "eight": ("rational_polynomial", 8)}.get(name, ("plumb_bob", 5))
        assert (fields["distortion_model"], len(fields["distortion_coefficients"]["data"])) == (model, count)


def test_opencv_has_every_lens_with_its_pose(folder: Path) -> None:
    path = folder / "cameras.opencv.yaml"
    read = read_cameras(path)
    assert list(read) == list(LENSES)
    for name, lens in LENSES.items():
        assert_same(read[name], lens)
    text = path.read_text(encoding="utf-8")
    assert "# Left out: lidar, whose intrinsics are not known." in text
    lacking = "whose lens model (radtan, 12 coefficients) ROS (plumb_bob, rational_polynomial, equidistant) lacks."
    assert text.count(f"without a file in camera_info: a camera {lacking}") == 1
    assert text.count("without a file in camera_info: ") == len(LENSES) - len(IN_ROS) == 2


@settings(max_examples=30, deadline=None)
@given(POSES)
def test_opencv_itself_reads_the_same(frames: RigFrames) -> None:
    storage = cv2.FileStorage(opencv_yaml(frames), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    assert storage.getNode("carrier").string() == "arm/hand"
    for key, name in (("cam_left", "cam_left"), ("rig_cam_right", "rig/cam_right")):
        node = storage.getNode("cameras").getNode(key)
        assert node.getNode("name").string() == name
        lens = frames.cameras[name]
        size = node.getNode("image_width").real(), node.getNode("image_height").real()
        assert size == (lens.width, lens.height)
        np.testing.assert_array_equal(node.getNode("camera_matrix").mat(), lens.K)
        np.testing.assert_array_equal(node.getNode("distortion_coefficients").mat().ravel(), lens.D)
        np.testing.assert_allclose(
            node.getNode("T_carrier_camera").mat(), frames.sensors[name], rtol=1e-15, atol=1e-300
        )
        assert node.getNode("fisheye_model").real() == (lens.model == "equidistant")


def test_colmap_has_its_own_models(folder: Path) -> None:
    path = folder / "cameras.txt"
    read, text = read_colmap_cameras(path), path.read_text(encoding="utf-8")
    assert list(read) == [str(number) for number in range(1, len(IN_COLMAP) + 1)]
    for number, (name, model) in enumerate(IN_COLMAP.items(), start=1):
        assert (
            f"\n# {number}: {name}, intrinsics as stated\n{number} {model} 640 480 421.5 420.75 318.75 241.625" in text
        )
        assert_same(read[str(number)], LENSES[name], 1e-13)  # half a pixel is added, and taken away
    assert "# Number of cameras: 5\n" in text
    assert "# Left out: prism, whose lens model (radtan, 12 coefficients) COLMAP (PINHOLE, " in text
    assert "# Left out: lidar, whose intrinsics are not known." in text


def test_a_model_that_nobody_knows_is_left_out_and_said() -> None:
    strange: Any = "of tomorrow"
    frames = replace(RIG, cameras={"four": replace(LENSES["four"], model=strange), "five": LENSES["five"]})
    assert list(camera_info_yaml(frames)) == ["five.yaml"]
    for text in (opencv_yaml(frames), colmap_cameras_txt(frames), camchain_yaml(frames)):
        assert "# Left out: four, whose lens model (of tomorrow, 4 coefficients) " in text


def test_where_intrinsics_are_from_is_said_on_one_line(tmp_path: Path) -> None:
    words = "estimated from the corners, standard deviations fx 1, fy 1 px\nimport os"
    frames = replace(ONE, camera_origins={"cam_left": words})
    texts = [path.read_text(encoding="utf-8") for path in export_all(frames, tmp_path) if "cam" in path.name]
    assert len(texts) == 5
    for text in texts[:-1]:
        assert (
            sum(line.lstrip().startswith("#") and "estimated from the corners, " in line for line in text.split("\n"))
            == 1
        )
        assert "\nimport os" not in text
    for text in (*texts[:-2], texts[-1]):  # the other camera's
        assert "intrinsics as stated" in text
    assert set(read_cameras(tmp_path / "cameras.opencv.yaml")) == {"cam_left", "rig/cam_right"}


def test_names_that_become_one_are_told_apart() -> None:
    sensors = dict.fromkeys(["a/b", "a_b", "A_b"], np.eye(4))
    frames = RigFrames("hand", "base", sensors, {}, cameras=dict.fromkeys(sensors, camera()))
    assert list(camera_info_yaml(frames)) == ["a_b.yaml", "a_b_2.yaml", "A_b_3.yaml"]
    storage = cv2.FileStorage(opencv_yaml(frames), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    nodes = [storage.getNode("cameras").getNode(key) for key in ("a_b", "a_b_2", "A_b_3")]
    assert [node.getNode("name").string() for node in nodes] == list(sensors)


def test_files_without_cameras_and_targets_are_files(tmp_path: Path) -> None:
    export_all(RigFrames("hand", "base", {"lidar": np.eye(4)}, {}), tmp_path)
    assert yaml.safe_load((tmp_path / "camchain.yaml").read_text()) == {}
    empty = RigFrames("hand", "base", {}, {})
    assert yaml.safe_load(tf_yaml(empty)) == {"transforms": []}
    compile(static_tf_launch(empty), "static_tf.launch.py", "exec")
    assert not (tmp_path / "camera_info").exists()
    storage = cv2.FileStorage(str(tmp_path / "cameras.opencv.yaml"), cv2.FILE_STORAGE_READ)
    assert storage.getNode("carrier").string() == "hand"
    with pytest.raises(FileFormatError, match="has no cameras"):
        read_colmap_cameras(tmp_path / "cameras.txt")
    with pytest.raises(FileFormatError, match=r"line 8: cameras: no camera is in it"):
        read_cameras(tmp_path / "cameras.opencv.yaml")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("image_width: 640", "image_width: wide", r"line 11: image_width: 'wide'; a whole number of pixels"),
        ("rows: 3", "rows: 4", r"line 18: camera_matrix\.data: 9 numbers for 4 rows and 3 columns"),
        (
            '"rig/cam_right"',
            '"cam_left"',
            r"line \d+: cameras\.rig_cam_right: the name 'cam_left' is there twice; keep one",
        ),
        ("cameras:\n", "cameras:\n   other: 3\n", r"line 8: cameras\.other: 3; a camera's section was expected"),
    ],
)
def test_faults_in_one_of_several_cameras_have_their_line(old: str, new: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "cameras.opencv.yaml"
    path.write_text(opencv_yaml(ONE).replace(old, new, 1), encoding="utf-8")
    with pytest.raises(FileFormatError, match=words):
        read_cameras(path)


@on_random_poses
def test_the_camchain_has_every_camera(frames: RigFrames) -> None:
    chain = yaml.safe_load(camchain_yaml(frames))
    left, right = frames.sensors["cam_left"], frames.sensors["rig/cam_right"]
    assert list(chain) == ["cam0", "cam1"]
    for name, T in (("cam0", left), ("cam1", right)):
        # T_cam_imu brings a point of the carrier into the camera.
        np.testing.assert_allclose(np.linalg.inv(chain[name]["T_cam_imu"]), T, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(right @ np.array(chain["cam1"]["T_cn_cnm1"]), left, rtol=0.0, atol=1e-12)
    assert "T_cn_cnm1" not in chain["cam0"]
    # Kalibr's condition: the two ways to cam1 agree.
    np.testing.assert_allclose(
        np.array(chain["cam1"]["T_cn_cnm1"]) @ chain["cam0"]["T_cam_imu"],
        chain["cam1"]["T_cam_imu"],
        rtol=0.0,
        atol=1e-12,
    )


def test_the_camchain_has_kalibrs_fields(tmp_path: Path) -> None:
    text = camchain_yaml(ONE)
    chain = yaml.safe_load(text)
    assert chain["cam0"] | {"T_cam_imu": None} == {
        "camera_model": "pinhole",
        "intrinsics": [421.5, 420.75, 318.25, 241.125],
        "distortion_model": "radtan",
        "distortion_coeffs": [-0.28, 0.07, 1e-5, -2e-4],
        "resolution": [640, 480],
        "rostopic": "/cam_left/image",
        "T_cam_imu": None,
        "timeshift_cam_imu": 0.0,
        "cam_overlaps": [1],
    }
    assert chain["cam1"]["distortion_model"] == "equidistant"
    assert chain["cam1"]["distortion_coeffs"] == [0.01, -2e-3, 3e-4, 1e-5]
    assert chain["cam1"]["timeshift_cam_imu"] == 0.035
    assert chain["cam1"]["rostopic"] == "it's: a #topic"
    # And as this library reads a camchain.
    (tmp_path / "camchain.yaml").write_text(text)
    for read, given_camera in zip(
        read_kalibr_camchain(tmp_path / "camchain.yaml").values(), ONE.cameras.values(), strict=True
    ):
        np.testing.assert_array_equal(read.K, given_camera.K)
        np.testing.assert_array_equal(read.D, given_camera.D)
        assert (read.model, read.width, read.height) == (given_camera.model, given_camera.width, given_camera.height)


def test_a_unified_camera_is_kalibrs_omni(tmp_path: Path) -> None:
    given = camera("unified", (1.3, -0.28, 0.07, 1e-5, -2e-4))
    path = tmp_path / "camchain.yaml"
    path.write_text(camchain_yaml(RigFrames("hand", "base", {"cam": np.eye(4)}, {}, cameras={"cam": given})))
    assert yaml.safe_load(path.read_text())["cam0"]["intrinsics"] == [1.3, 421.5, 420.75, 318.25, 241.125]
    read = read_kalibr_camchain(path)["cam0"]
    assert read.model == "unified"
    np.testing.assert_array_equal(np.append(read.K, read.D), np.append(given.K, given.D))


def test_a_pinhole_is_radtan_with_zeros() -> None:
    frames = RigFrames("hand", "base", {"cam": np.eye(4)}, {}, cameras={"cam": camera("pinhole", ())})
    cam0 = yaml.safe_load(camchain_yaml(frames))["cam0"]
    assert (cam0["distortion_model"], cam0["distortion_coeffs"]) == ("radtan", [0.0] * 4)
    assert "rostopic" not in cam0


@pytest.mark.parametrize(
    ("model", "D", "is_written"),
    [
        ("radtan", (-0.3, 0.1, 0.001, 0.0, 0.0), True),
        ("radtan", (-0.3, 0.1, 0.001, 0.0, -0.02), False),
        ("rational_polynomial", (-0.3, 0.1, 0.001, 0.0, 0.0, 0.1, 0.0, 0.0), False),
        ("rational_polynomial", (-0.3, 0.1, 0.001, 0.0, 0.0, 0.0, 0.0, 0.0), True),
    ],
)
def test_distortion_that_kalibr_lacks_is_left_out_and_said(model: str, D: tuple[float, ...], is_written: bool) -> None:
    sensors = {name: np.eye(4) for name in ("first", "lidar", "last")}
    sensors["last"] = np.diag([-1.0, -1.0, 1.0, 1.0])
    frames = RigFrames("hand", "base", sensors, {}, cameras={"first": camera(model, D), "last": camera()})
    text = camchain_yaml(frames)
    chain = yaml.safe_load(text)
    assert list(chain) == (["cam0", "cam1"] if is_written else ["cam0"])
    assert "# Left out: lidar, whose intrinsics are not known." in text
    assert ("# Left out: first, whose distortion" in text) is not is_written
    # A chain holds together across the sensor that is left out.
    np.testing.assert_array_equal(chain[list(chain)[-1]]["T_cam_imu"], sensors["last"])
    assert "T_cn_cnm1" not in chain["cam0"]


def test_overlaps_are_of_cameras_that_can_see_the_same() -> None:
    """Three in a ring: the first two look the same way, the third backwards."""
    backwards = np.diag([-1.0, 1.0, -1.0, 1.0])
    aside = np.eye(4)
    aside[0, 3] = 0.3
    sensors = {"a": np.eye(4), "b": aside, "c": backwards}
    frames = RigFrames("rig", "world", sensors, {}, cameras={name: camera() for name in sensors})
    chain = yaml.safe_load(camchain_yaml(frames))
    assert [chain[f"cam{n}"]["cam_overlaps"] for n in range(3)] == [[1], [0], []]
