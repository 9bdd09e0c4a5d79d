"""Pixels as functions of a camera's parameters, xi of unified lenses too; and models that fold back before a corner."""

from __future__ import annotations

from dataclasses import replace

import cv2
import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2
from simulated_cells import CAMERA, Cell, cell

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.fitting.corner_checks import findings_of_rays, without_rays
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


#: 166 degrees from corner to corner.
LENS = Camera.of(
    1920,
    1080,
    "unified",
    [[1300.0, 0.0, 955.0], [0.0, 1305.0, 545.0], [0.0, 0.0, 1.0]],
    (0.95, -0.1, 0.02, 1e-3, -5e-4),
    "cell",
)


def off(camera: Camera, pixels: NDArray[np.float64]) -> float:
    """How far a camera's pixels of the true rays are off, pixels."""
    return float(np.sqrt(((camera.pixels(LENS.undistort(pixels)) - pixels) ** 2).mean()))


def test_xi_is_refined_with_everything_else() -> None:
    given = cell(21, images=20, camera=LENS, stated="calibration", carrier=(1e-3, 5e-4))
    result = given.refined(rw.CornerOptions(stated="calibration"))
    intrinsics = result.intrinsics["cam_0"]
    assert intrinsics.names == ("fx/(1+xi)", "fy/(1+xi)", "cx", "cy", "xi", "k1", "k2", "p1", "p2")
    errors, names = [], []
    for name in given.X | given.Y:
        errors.append(given.error(result, name))
        names.append(name)
    for name in given.Y:
        errors.append(LENS.parameters - result.intrinsics[name].camera.parameters)
        names.append(f"intrinsics:{name}")
    error = np.concatenate(errors)
    assert error @ np.linalg.solve(result.covariance(*names), error) < chi2.ppf(0.999, len(error))
    pixels = given.observations.views["board", "cam_0"].pixels.reshape(-1, 2)
    before, after = (off(camera, pixels) for camera in (given.observations.cameras["cam_0"], intrinsics.camera))
    assert after < 0.7 * before


def test_an_unknown_unified_lens_is_found_from_corners() -> None:
    given = cell(2, images=20, cameras=1, camera=LENS)
    K = np.array([[1000.0, 0.0, 100.0], [0.0, 1000.0, 100.0], [0.0, 0.0, 1.0]])
    nothing = {"cam_0": Camera(1920, 1080, "unified", K, np.array([0.3, 0.0, 0.0, 0.0, 0.0]))}
    options = rw.CornerOptions(stated="unknown", carrier_noise="exact")
    found = rw.calibrate_corners(replace(given.observations, cameras=nothing), options).refined
    pixels = given.observations.views["board", "cam_0"].pixels.reshape(-1, 2)
    assert off(found.intrinsics["cam_0"].camera, pixels) < 1.0
    assert all(given.squared_error(found, name) < chi2.ppf(0.999, 6) for name in given.X | given.Y)


#: It folds back where r^2 = 1 / (3 * 1.5), 440 pixels from the centre; corners are seen to 570.
FOLDED = Camera.of(1920, 1080, "radtan", CAMERA.K, (-1.5, 0.0, 0.0, 0.0), "cell")
PLACE = r"\d+ of \d+ corners of board \(the first is corner \d+ of image \d+, at \(\d+\.\d, \d+\.\d\)\)"


@pytest.fixture(scope="module")
def given() -> Cell:
    folded = cell(5, images=20, carrier=(1e-3, 5e-4))
    return replace(folded, observations=replace(folded.observations, cameras=dict.fromkeys(folded.Y, FOLDED)))


@pytest.fixture(scope="module")
def result(given: Cell) -> rw.CornersRefined:
    return given.refined(rw.CornerOptions())


def test_where_rays_end() -> None:
    assert FOLDED.reach_px == pytest.approx(1400.0 * np.sqrt(1.0 / 4.5) * 2.0 / 3.0)
    pixels = np.array([[960.0, 540.0 + 439.0], [960.0, 540.0 + 441.0], [np.nan, np.nan]])
    assert FOLDED.has_ray(pixels).tolist() == [True, False, True]
    assert CAMERA.has_ray(np.array([[0.0, 0.0], [1919.0, 1079.0]])).all()


def test_a_nominal_lens_without_rays_is_replaced_and_named(given: Cell, result: rw.CornersRefined) -> None:
    assert all(given.squared_error(result, name) < chi2.ppf(0.999, 6) for name in given.X | given.Y)
    stack = result.graph.model.stacks[0]
    seen = np.linalg.norm(result.intrinsics["cam_0"].camera.undistort(stack.pixels), axis=2)[stack.known]
    assert result.graph.model.seen(stack, result.point).radius[stack.known] == pytest.approx(seen, abs=3e-3)
    (words,) = (words for words in result.findings if "has no ray" in words and "cam_0" in words)
    assert words.startswith("As stated, the lens model of cam_0 (radtan) has no ray for ")
    assert "folds back 440 pixels from the centre. The estimated one has rays there: check D, its order" in words


def test_an_estimate_without_rays_is_doubted(result: rw.CornersRefined) -> None:
    folded = {name: replace(found, camera=FOLDED) for name, found in result.intrinsics.items()}
    first, second = findings_of_rays(replace(result, intrinsics=folded))
    assert first.startswith("As estimated, the lens model of cam_0 (radtan) has no ray for ")
    assert "doubt this answer" in first
    assert "cam_1" in second


def test_corners_beyond_the_fold_whose_pixels_lead_back_are_seen_too() -> None:
    """A radius of 1.2 times the ring and one of 0.79 times have the same pixel."""
    pixels = FOLDED.pixels(np.array([[[1.2 * FOLDED.ring, 0.0]]]))
    assert FOLDED.has_ray(pixels).all()
    everyone = np.ones((1, 1), dtype=bool)
    assert without_rays(FOLDED, ("board", "cam_0", pixels), everyone) == ""
    assert "has no ray for 1 of 1 corners" in without_rays(FOLDED, ("board", "cam_0", pixels), everyone, everyone)


def test_exact_intrinsics_without_rays_are_refused(given: Cell) -> None:
    with pytest.raises(CameraError, match=rf"^the intrinsics of cam_0 are held .*exact\), but .*ray for {PLACE}: its"):
        given.refined(rw.CornerOptions(stated="exact"))


def test_poses_are_made_of_corners_with_rays(given: Cell) -> None:
    """The images' poses are a start; images whose corners are all beyond the lens have none, and say so."""
    few = cell(5, images=10, cameras=1)
    calibrated = rw.calibrate_corners(replace(few.observations, cameras={"cam_0": FOLDED}))
    assert any("has no ray" in words for words in calibrated.refined.findings)
    tiny = Camera.of(1920, 1080, "radtan", CAMERA.K, (-40.0, 0.0, 0.0, 0.0), "cell")
    blind = replace(given.observations, cameras=dict.fromkeys(given.Y, tiny))
    with pytest.raises(CameraError, match=r"image \d+ of board by cam_0 has no pose: .* has no ray for \d+ of its"):
        blind.poses()
