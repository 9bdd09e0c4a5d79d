"""Kalibr's camchain, read back by its own rules, and compared with the transforms that went in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from exported_rigs import ONE, camera, on_random_poses

from gtsam_rwhec.cameras.intrinsics_files import read_kalibr_camchain
from gtsam_rwhec.rig import RigFrames, camchain_yaml


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
