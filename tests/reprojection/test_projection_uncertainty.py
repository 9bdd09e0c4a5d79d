"""How sure projections are over the image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rwhec_factors import se3
from simulated_cells import CAMERA, Cell, cell

import gtsam_rwhec as rw
from gtsam_rwhec.errors import FrameError, OptionError
from gtsam_rwhec.reprojection.projection_uncertainty import by_region, projection_deviations

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
    for seed in range(60):
        given = cell(0, images=15, cameras=1, corner_px=1e-9)
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
    regions = by_region(part.intrinsics["cam_0"].camera, part.covariance("cam_0", "intrinsics:cam_0"), 1.5)
    found = np.array(regions, dtype=float)  # a region without a value would be nan
    assert found.shape == (3, 3)
    assert found[2, 2] > 5.0 * found[0, 0]
    assert found[0, 0] == pytest.approx(float(np.sqrt((deviations[:4, :6] ** 2).mean())), rel=0.3)


def test_what_is_asked_is_checked() -> None:
    given = cell(0, images=5)
    refined = rw.refine_corners(given.observations, given.X, given.Y, EXACT)
    with pytest.raises(FrameError, match="'cam_7' is no sensor whose intrinsics were estimated; they are cam_0, cam_1"):
        projection_deviations(refined, "cam_7", 1.0)
    with pytest.raises(OptionError, match="above 0"):
        projection_deviations(refined, "cam_0", -1.0)
