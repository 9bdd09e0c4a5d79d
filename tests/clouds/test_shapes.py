"""Spheres and planes in clouds: found beside other things, with covariances that hold the truth."""

from __future__ import annotations

import numpy as np
import pytest

import gtsam_rwhec as rw
from gtsam_rwhec.clouds.shapes import surface_noise
from gtsam_rwhec.errors import CloudError, OptionError
from gtsam_rwhec.geometry.poses import Array

RADIUS_M, NOISE_M, WALL_M = 0.03, 2e-4, 0.8


def scene(rng: np.random.Generator, noise_m: float = NOISE_M) -> tuple[rw.clouds.Cloud, Array]:
    """The near half of a ball before a wall, and the ball's centre."""
    centre = rng.normal((0.0, 0.0, 0.6), 0.1)
    normals = rng.normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ball = centre + RADIUS_M * normals
    ball = ball[(normals * ball).sum(axis=1) < 0.0]
    wall = np.column_stack([rng.uniform(-0.3, 0.3, (3000, 2)), np.full(3000, WALL_M)])
    points = np.concatenate([ball, wall])
    points += rng.normal(0.0, noise_m, (len(points), 1)) * points / np.linalg.norm(points, axis=1, keepdims=True)
    return rw.clouds.Cloud.of(points), centre


@pytest.mark.parametrize("noise_m", [NOISE_M, 0.003])
def test_spheres_and_planes_are_as_near_to_the_truth_as_their_covariances_say(noise_m: float) -> None:
    """By distances from the shape in place of errors along the beams, much noise moved and turned both."""
    free, known, plane = [], [], []
    for seed in range(15):
        cloud, centre = scene(np.random.default_rng(seed), noise_m)
        for squares, radius in ((free, None), (known, RADIUS_M)):
            ball = rw.clouds.find_sphere(cloud, radius, noise_m=noise_m)
            error = ball.centre - centre
            squares.append(error @ np.linalg.solve(ball.covariance, error))
        assert abs(ball.radius_m - RADIUS_M) < 1e-12
        corner = cloud.points[:, :2].min(axis=1) > 0.2
        wall = rw.clouds.find_plane(cloud.selected(corner), noise_m=noise_m)
        assert wall.offset_m < 0.0
        z = wall.T_sensor_plane[:3, :3].T @ (0.0, 0.0, -1.0)
        twist = np.array([-z[1], z[0], (WALL_M - wall.point[2]) * wall.normal[2]])
        plane.append(twist @ np.linalg.solve(wall.covariance, twist))
    for squares in (free, known, plane):
        assert 1.5 < np.mean(squares) < 4.5  # chi2 with 3 degrees of freedom
        assert np.mean(np.array(squares) < 7.81) >= 0.8


def test_smooth_errors_of_a_surface_make_its_covariance_larger() -> None:
    rng = np.random.default_rng(0)
    cloud, _ = scene(rng)
    wall = cloud.selected(cloud.points[:, 2] > 0.7)
    bent = wall.points + np.column_stack([0 * wall.points[:, :2], 2e-3 * np.sin(8.0 * wall.points[:, 0])])
    straight, smooth = (rw.clouds.find_plane(rw.clouds.Cloud.of(p)) for p in (wall.points, bent))
    assert smooth.covariance[2, 2] > 20.0 * straight.covariance[2, 2]


def test_noise_of_a_cloud_is_that_of_its_surfaces() -> None:
    cloud, _ = scene(np.random.default_rng(3))
    assert 0.5 * NOISE_M < surface_noise(cloud.points) < 3.0 * NOISE_M


def test_a_ball_alone_is_no_plane_and_a_board_that_is_a_little_bent_is() -> None:
    cloud, _ = scene(np.random.default_rng(0))
    ball = cloud.selected(cloud.points[:, 2] < WALL_M - 0.05)
    with pytest.raises(CloudError, match="is bent by"):
        rw.clouds.find_plane(ball)
    x, y = np.random.default_rng(0).uniform(-0.15, 0.15, (2, 4000))
    board = np.column_stack([x, y, 0.8 + 0.1 * x**2])
    assert rw.clouds.find_plane(rw.clouds.Cloud.of(board)).points > 1000


def test_what_is_not_there_is_said() -> None:
    cloud, _ = scene(np.random.default_rng(0))
    with pytest.raises(CloudError, match="no such sphere"):
        rw.clouds.find_sphere(cloud, 0.5)
    wall = cloud.selected(cloud.points[:, 2] > 0.7)  # least squares ran off to 800 m
    with pytest.raises(CloudError, match=r"no such sphere.*give its radius_m, or a cloud without walls"):
        rw.clouds.find_sphere(wall)
    with pytest.raises(CloudError, match="at least 30 are needed"):
        rw.clouds.find_plane(cloud.selected(np.arange(5)), noise_m=NOISE_M)
    with pytest.raises(OptionError, match="radius_m=-1"):
        rw.clouds.find_sphere(cloud, -1.0)
    rng = np.random.default_rng(0)
    grazed = np.column_stack([rng.uniform(0.5, 3.0, 500), np.full(500, 0.05), rng.uniform(-0.1, 0.1, 500)])
    with pytest.raises(CloudError, match="graze"):
        rw.clouds.find_plane(rw.clouds.Cloud.of(grazed), noise_m=NOISE_M)
