"""Pixels as functions of a camera's parameters."""

from __future__ import annotations

import cv2
import gtsam
import numpy as np
import pytest

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.fitting.stated_intrinsics import pixels_and_derivatives

K = [[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]]
LENSES = {
    "pinhole": ("", ()),
    "radtan of four": ("radtan", (-0.2, 0.05, 1e-3, -2e-3)),
    "radtan of five": ("radtan", (-0.2, 0.05, 1e-3, -2e-3, 0.01)),
    "rational": ("radtan", (-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.02, 0.03, 0.01)),
    "thin prism": ("radtan", (-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.02, 0.03, 0.01, 1e-3, 2e-3, -1e-3, 1e-3)),
    "equidistant": ("equidistant", (-0.02, 0.006, -0.004, 0.001)),
    "unified": ("unified", (1.2, -0.2, 0.05, 1e-3, -2e-3)),
}


@pytest.fixture(params=LENSES)
def camera(request: pytest.FixtureRequest) -> Camera:
    model, D = LENSES[request.param]
    return Camera.of(640, 480, model, K, D, "test")


def test_parameters_are_those_of_the_camera(camera: Camera) -> None:
    again = camera.with_parameters(camera.parameters)
    np.testing.assert_allclose(again.K, camera.K, rtol=1e-15)
    assert np.array_equal(again.D, camera.D)
    assert again.model == camera.model


def test_pixels_are_opencvs_and_gtsams(camera: Camera) -> None:
    x = np.random.default_rng(0).uniform(-0.4, 0.4, size=(20, 2))
    points = np.column_stack([x, np.ones(len(x))])[:, None]
    zero = np.zeros(3)
    if camera.model == "equidistant":
        expected, _ = cv2.fisheye.projectPoints(points, zero, zero, camera.K, camera.D)
    elif camera.model == "unified":
        xi, *bent = camera.D
        model = gtsam.Cal3Unified(500.0, 510.0, 0.0, 320.0, 240.0, *bent, xi)
        expected = np.array([[model.uncalibrate(each)] for each in x])
    else:
        expected, _ = cv2.projectPoints(points, zero, zero, camera.K, camera.D)
    assert camera.with_parameters(camera.parameters).pixels(x) == pytest.approx(expected[:, 0], abs=1e-9)


def test_derivatives_are_right_in_the_middle_too(camera: Camera) -> None:
    x = np.vstack([np.random.default_rng(1).uniform(-0.4, 0.4, size=(9, 2)), np.zeros((1, 2))])
    p = camera.parameters
    pixels, by_x, by_p = pixels_and_derivatives(camera, p, x)
    assert pixels == pytest.approx(camera.with_parameters(p).pixels(x))
    e = 1e-6
    for i, step in enumerate(e * np.eye(len(p))):
        numeric = (camera.with_parameters(p + step).pixels(x) - camera.with_parameters(p - step).pixels(x)) / (2 * e)
        assert by_p[..., i] == pytest.approx(numeric, abs=1e-6)
    for i, step in enumerate(e * np.eye(2)):
        numeric = (camera.with_parameters(p).pixels(x + step) - camera.with_parameters(p).pixels(x - step)) / (2 * e)
        assert by_x[..., i] == pytest.approx(numeric, abs=1e-5)
