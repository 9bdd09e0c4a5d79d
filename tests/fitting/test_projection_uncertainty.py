"""How sure projections are over the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rwhec_factors import se3
from simulated_cells import CAMERA, Cell, cell

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import FrameError, OptionError
from gtsam_rwhec.fitting.projection_uncertainty import (
    by_region,
    lens_deviations_over,
    projection_deviations,
    uneven_words,
)

EXACT = rw.CornerOptions(carrier_noise="exact")


def in_one_corner(given: Cell) -> Cell:
    """Only the corners in the upper left third of the image were seen."""
    views = {}
    for pair, view in given.observations.views.items():
        outside = (view.pixels > [CAMERA.width / 2.5, CAMERA.height / 2.0]).any(axis=2)
        pixels = np.where(outside[..., None], np.nan, view.pixels)
        kept = (~outside).sum(axis=1) >= 6
        views[pair] = replace(view, A=view.A[kept], pixels=pixels[kept])
    return replace(given, observations=replace(given.observations, views=views))


def test_deviations_are_those_of_many_runs() -> None:
    projected = []
    P = np.array([0.2, -0.1, 1.5])
    given = cell(0, images=15, cameras=1, corner_px=1e-9)
    for seed in range(60):
        rng = np.random.default_rng(seed)
        views = {
            pair: replace(view, pixels=view.pixels + rng.normal(scale=0.1, size=view.pixels.shape))
            for pair, view in given.observations.views.items()
        }
        refined = rw.refine_corners(replace(given.observations, views=views), given.X, given.Y, EXACT)
        at = se3.inverse(refined.Y["cam_0"].matrix()) @ given.Y["cam_0"]
        projected.append(refined.intrinsics["cam_0"].camera.project(at[:3, :3] @ P + at[:3, 3]))
    measured = np.sqrt(np.linalg.eigvalsh(np.cov(np.transpose(projected)))[-1])
    pixels, deviations = projection_deviations(refined, "cam_0", 1.5)
    nearest = np.linalg.norm(pixels - CAMERA.project(P), axis=-1).argmin()
    assert deviations.ravel()[nearest] == pytest.approx(measured, rel=0.35)


def test_a_camera_that_was_calibrated_from_a_corner_of_its_image_says_so() -> None:
    given = cell(5, images=60, cameras=1)
    whole = rw.refine_corners(given.observations, given.X, given.Y, EXACT)
    part = rw.refine_corners(in_one_corner(given).observations, given.X, given.Y, EXACT)
    _, everywhere = projection_deviations(whole, "cam_0", 1.5)
    pixels, deviations = projection_deviations(part, "cam_0", 1.5)
    assert pixels.shape == (11, 20, 2)
    seen = (pixels < [CAMERA.width / 3.0, CAMERA.height / 2.5]).all(axis=-1)
    far = (pixels > [CAMERA.width * 0.8, CAMERA.height * 0.8]).all(axis=-1)
    assert deviations[far].min() > 5.0 * np.median(deviations[seen])
    assert everywhere.max() < deviations[far].min()
    lens = part.intrinsics["cam_0"]
    (view,) = in_one_corner(given).observations.views.values()
    corners = view.pixels[np.isfinite(view.pixels).all(axis=2)]
    points = 1.5 * np.concatenate([lens.camera.undistort(corners), np.ones((len(corners), 1))], axis=1)
    regions = np.array(by_region(lens.camera, lens.covariance, points, 1.5), dtype=float)  # nan: no value
    assert regions.shape == (3, 3)
    assert regions[2, 2] > 4.0 * regions[0, 0]
    said = uneven_words(by_region(lens.camera, lens.covariance, points, 1.5))
    assert said.startswith(f"projections are uncertain by up to {regions.max():.1f} px in 3 of 9 parts of the image")
    (view,) = given.observations.views.values()
    of_whole = whole.intrinsics["cam_0"]
    x = of_whole.camera.undistort(view.pixels.reshape(-1, 2))
    every = 1.5 * np.concatenate([x, np.ones((len(x), 1))], axis=1)
    assert uneven_words(by_region(of_whole.camera, of_whole.covariance, every, 1.5)) == ""
    _, alone = lens_deviations_over(lens.camera, lens.covariance, points, 1.5)
    assert regions[0, 0] == pytest.approx(float(np.sqrt((alone[:4, :6] ** 2).mean())), rel=0.3)
    # the lens alone is as sure as the lens on its carrier, where the carriers' poses count as exact and views are many
    assert np.median(alone[far] / deviations[far]) == pytest.approx(1.0, abs=0.3)


def test_what_all_poses_share_is_no_error_of_the_lens() -> None:
    """A shift of the centre that a turn of the camera hides moves no pixel; one that nothing hides moves all."""
    camera = Camera.of(1920, 1080, "pinhole", CAMERA.K, (), "test")
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.7, -0.4, 1.0], [0.7, 0.4, 1.6], size=(300, 3))
    centre = np.diag([0.0, 0.0, 4.0, 4.0])
    _, hidden = lens_deviations_over(camera, centre, points, 1.3)
    assert np.median(hidden) < 0.4  # of 2 pixels
    assert hidden.max() < 1.0
    focal = np.diag([100.0, 0.0, 0.0, 0.0])  # fx alone: no pose stretches an image along one axis
    pixels, seen = lens_deviations_over(camera, focal, points, 1.3)
    assert seen.max() > 0.25 * 10.0 * np.abs(pixels[..., 0] - 960.0).max() / 1400.0


def test_what_is_asked_is_checked() -> None:
    given = cell(0, images=5)
    refined = rw.refine_corners(given.observations, given.X, given.Y, EXACT)
    with pytest.raises(FrameError, match="'cam_7' is no sensor whose intrinsics were estimated; they are cam_0, cam_1"):
        projection_deviations(refined, "cam_7", 1.0)
    with pytest.raises(OptionError, match="above 0"):
        projection_deviations(refined, "cam_0", -1.0)
