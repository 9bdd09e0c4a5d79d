"""Intrinsics that the images do not tell are named as held by the prior, and nothing is claimed beyond it."""

from __future__ import annotations

import numpy as np
import pytest
from placements import UNDETERMINED
from rwhec_factors import se3
from simulated_cells import CAMERA, Cell, cell

import gtsam_rwhec as rw
from gtsam_rwhec.errors import UnderdeterminedError
from gtsam_rwhec.fitting.fit_options import Stated
from gtsam_rwhec.fitting.stated_intrinsics import held_by_prior


def refined(given: Cell, stated: Stated) -> rw.CornersRefined:
    X, Y = given.near(np.random.default_rng(9))
    return rw.refine_corners(given.observations, X, Y, rw.CornerOptions(stated=stated, carrier_noise="exact"))


@pytest.mark.parametrize(
    ("where", "stated", "names"),
    [
        ("nearly fronto-parallel at one depth", "calibration", ("fx", "fy", "cx", "cy")),
        ("nearly fronto-parallel at one depth", "nominal", ("fx", "fy")),
        ("in a corner of the image", "calibration", ("cx", "cy")),
    ],
)
def test_what_the_images_do_not_tell_is_named_and_no_more_is_claimed(
    where: str, stated: Stated, names: tuple[str, ...]
) -> None:
    given = cell(4, images=16, facing=UNDETERMINED[where], stated=stated)
    result = refined(given, stated)
    for camera in result.intrinsics.values():
        assert set(names) <= set(camera.held_by_prior)
        deviations = np.sqrt(np.diagonal(camera.covariance))
        assert (deviations <= camera.prior.deviation * (1.0 + 1e-9)).all()
        said = ", ".join(camera.held_by_prior)
        assert any(f"The images do not tell {said} of" in words for words in result.findings)


@pytest.mark.parametrize(("where", "stated"), [("nearly fronto-parallel at one depth", "calibration"),
    ("nearly fronto-parallel at one depth", "nominal"), ("in a corner of the image", "calibration"),
])  # fmt: skip
def test_the_truth_is_where_the_covariance_says(where: str, stated: Stated) -> None:
    """Of 24 cameras at most one is outside 99.9 %: where f and the distance go together, the answer is not linear."""
    outside = 0
    for seed in range(12):
        result = refined(cell(seed, images=16, facing=UNDETERMINED[where], stated=stated), stated)
        for sensor, camera in result.intrinsics.items():
            off = CAMERA.parameters - camera.camera.parameters
            squared = off @ np.linalg.solve(camera.covariance, off)
            outside += squared > result.squared_radius(f"intrinsics:{sensor}", 0.999)
    assert outside <= 1


def test_images_at_all_tilts_and_places_tell_all() -> None:
    assert not any(camera.held_by_prior for camera in refined(cell(4, images=16), "nominal").intrinsics.values())


def test_a_carrier_that_only_translates_determines_no_pose() -> None:
    given = cell(1, images=1, cameras=1)
    start = given.observations.views["board", "cam_0"].A[0]
    moves = se3.expmap(np.pad(np.random.default_rng(0).normal(scale=0.05, size=(12, 3)), ((0, 0), (3, 0))))
    A = moves @ start
    seen = np.linalg.inv(given.Y["cam_0"]) @ A @ given.X["board"]
    points = given.observations.corners["board"] @ seen[:, :3, :3].transpose(0, 2, 1) + seen[:, None, :3, 3]
    pixels = CAMERA.with_parameters(CAMERA.parameters).pixels(points[..., :2] / points[..., 2:])
    observations = rw.Observations.of({"cam_0": CAMERA}, {"board": given.observations.corners["board"]},
                                      {("board", "cam_0"): (A, pixels)})  # fmt: skip
    for noise in ("exact", "estimate"):
        with pytest.raises(UnderdeterminedError, match=r"turn about two axes"):
            rw.refine_corners(observations, given.X, given.Y, rw.CornerOptions(carrier_noise=noise))  # type: ignore[arg-type]


def test_a_direction_that_only_the_prior_holds_names_its_parameters() -> None:
    # the images tell that fx = fy, and not how long: each has 0.71 of its prior's deviation
    prior = np.array([3.0, 3.0, 1.0])
    posterior = np.zeros((3, 3))
    posterior[:2, :2] = 0.48 * 9.0 * np.array([[1.0, 0.999], [0.999, 1.0]])
    posterior[2, 2] = 0.01
    assert (np.sqrt(np.diagonal(posterior)) < 0.7 * prior).all()
    assert held_by_prior(np.diag(1.0 / prior), posterior).tolist() == [True, True, False]
