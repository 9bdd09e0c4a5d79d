"""From corners alone: intrinsics nobody stated, certified poses, refinement."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rwhec_factors import se3
from simulated_cells import CAMERA, Cell, cell

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.errors import CameraError
from gtsam_rwhec.fitting.observations import Views

UNKNOWN = rw.CornerOptions(stated="unknown")
FISHEYE = Camera.of(
    1920,
    1080,
    "equidistant",
    [[700.0, 0.0, 950.0], [0.0, 700.0, 545.0], [0.0, 0.0, 1.0]],
    (-0.02, 6e-3, -4e-3, 8e-4),
    "cell",
)


def with_nothing_stated(given: Cell) -> Cell:
    """Only the size of images and the model of the lens are right."""
    K = [[1000.0, 0.0, 100.0], [0.0, 1000.0, 100.0], [0.0, 0.0, 1.0]]
    cameras = {
        name: Camera(camera.width, camera.height, camera.model, np.array(K), np.zeros(4))
        for name, camera in given.observations.cameras.items()
    }
    return replace(given, observations=replace(given.observations, cameras=cameras))


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["radtan", "fisheye"])
def test_corners_and_arm_alone_give_everything(camera: Camera) -> None:
    given = with_nothing_stated(cell(2, images=40, camera=camera, carrier=(5e-4, 3e-4)))
    found = rw.calibrate_corners(given.observations, UNKNOWN)
    assert found.solution.certificate.is_optimal
    assert str(found).startswith(str(found.refined))
    assert len(repr(found)) < 2000
    for name, T in (*given.X.items(), *given.Y.items()):
        pose = (found.refined.X | found.refined.Y)[name].matrix()
        xi = se3.logmap((se3.inverse(pose) @ T)[None])[0]
        assert xi @ np.linalg.solve(found.refined.covariance(name), xi) < 30.0
        assert np.degrees(np.linalg.norm(xi[:3])) < 0.5
    assert pytest.approx(camera.K, abs=6.0) == found.refined.intrinsics["cam_0"].camera.K
    assert not {"fx", "fy", "cx", "cy", "k1"} & set(found.refined.intrinsics["cam_0"].held_by_prior)


def test_images_that_disagree_are_left_out() -> None:
    given = cell(3, images=30, stated="nominal")
    view = given.observations.views["board", "cam_0"]
    pixels = view.pixels.copy()
    pixels[2] = pixels[2][::-1]  # the board turned by half a turn
    views = given.observations.views | {("board", "cam_0"): Views(view.A, pixels)}
    found = rw.calibrate_corners(replace(given.observations, views=views))
    assert not found.inliers[rw.Pair("board", "cam_0")][2]
    assert sum((~mask).sum() for mask in found.inliers.values()) <= 2
    xi = se3.logmap((se3.inverse(found.refined.Y["cam_0"].matrix()) @ given.Y["cam_0"])[None])[0]
    assert xi @ np.linalg.solve(found.refined.covariance("cam_0"), xi) < 30.0


def test_two_views_give_no_intrinsics() -> None:
    given = cell(4, images=2, cameras=1)
    with pytest.raises(CameraError, match="the intrinsics of cam_0 cannot be estimated from 2 views"):
        rw.calibrate_corners(given.observations, UNKNOWN)
