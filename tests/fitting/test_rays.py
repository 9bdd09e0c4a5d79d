"""Lens models that fold back nearer to the centre than a corner was seen: said with sensor, image and pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rwhec_factors import se3
from scipy.stats import chi2
from simulated_cells import CAMERA, Cell, cell

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.fitting.corner_checks import findings_of_rays, without_rays

#: It folds back where r^2 = 1 / (3 * 1.5), 440 pixels from the centre; corners are seen to 570.
FOLDED = Camera.of(1920, 1080, "radtan", CAMERA.K, (-1.5, 0.0, 0.0, 0.0), "cell")
PLACE = r"\d+ of \d+ corners of board \(the first is corner \d+ of image \d+, at \(\d+\.\d, \d+\.\d\)\)"


@pytest.fixture(scope="module")
def given() -> Cell:
    folded = cell(5, images=20, carrier=(1e-3, 5e-4))
    return replace(folded, observations=replace(folded.observations, cameras=dict.fromkeys(folded.Y, FOLDED)))


def refined(given: Cell, options: rw.CornerOptions) -> rw.CornersRefined:
    X, Y = given.near(np.random.default_rng(9))
    return rw.refine_corners(given.observations, X, Y, options)


@pytest.fixture(scope="module")
def result(given: Cell) -> rw.CornersRefined:
    return refined(given, rw.CornerOptions())


def test_where_rays_end() -> None:
    assert FOLDED.reach_px == pytest.approx(1400.0 * np.sqrt(1.0 / 4.5) * 2.0 / 3.0)
    pixels = np.array([[960.0, 540.0 + 439.0], [960.0, 540.0 + 441.0], [np.nan, np.nan]])
    assert FOLDED.has_ray(pixels).tolist() == [True, False, True]
    assert CAMERA.has_ray(np.array([[0.0, 0.0], [1919.0, 1079.0]])).all()


def test_a_nominal_lens_without_rays_is_replaced_and_named(given: Cell, result: rw.CornersRefined) -> None:
    for name, T in (given.X | given.Y).items():
        xi = se3.logmap((se3.inverse((result.X | result.Y)[name].matrix()) @ T)[None])[0]
        assert xi @ np.linalg.solve(result.covariance(name), xi) < chi2.ppf(0.999, 6)
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
        refined(given, rw.CornerOptions(stated="exact"))


def test_poses_are_made_of_corners_with_rays(given: Cell) -> None:
    """The images' poses are a start; images whose corners are all beyond the lens have none, and say so."""
    few = cell(5, images=10, cameras=1)
    calibrated = rw.calibrate_corners(replace(few.observations, cameras={"cam_0": FOLDED}))
    assert any("has no ray" in words for words in calibrated.refined.findings)
    tiny = Camera.of(1920, 1080, "radtan", CAMERA.K, (-40.0, 0.0, 0.0, 0.0), "cell")
    blind = replace(given.observations, cameras=dict.fromkeys(given.Y, tiny))
    with pytest.raises(CameraError, match=r"image \d+ of board by cam_0 has no pose: .* has no ray for \d+ of its"):
        blind.poses()
