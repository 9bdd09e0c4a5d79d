"""A board that a 3D camera's own image shows: corners in pixels become a pose with a covariance."""

from __future__ import annotations

import numpy as np
import pytest
from rwhec_factors.se3 import expmap, inverse, logmap, pose
from scipy.spatial.transform import Rotation

import gtsam_rwhec as rw
from gtsam_rwhec.errors import CloudError, CountError
from gtsam_rwhec.geometry.poses import Array

FOCAL_PX, SHAPE = 500.0, (360, 480)
CORNERS = np.stack([*np.meshgrid(np.arange(8) * 0.02, np.arange(5) * 0.02), np.zeros((5, 8))], axis=-1).reshape(-1, 3)


def seen(T: Array, rng: np.random.Generator, noise_m: float, corner_px: float) -> tuple[rw.clouds.Cloud, Array]:
    """The organised cloud of a board before a wall, and its corners in pixels."""
    v, u = np.meshgrid(np.arange(SHAPE[0]), np.arange(SHAPE[1]), indexing="ij")
    rays = np.stack([(u - 240.0) / FOCAL_PX, (v - 180.0) / FOCAL_PX, np.ones(SHAPE)], axis=-1)
    depth = (T[:3, 3] @ T[:3, 2]) / (rays @ T[:3, 2])
    at = (rays * depth[..., None] - T[:3, 3]) @ T[:3, :3]
    on = (at[..., 0] > -0.03) & (at[..., 0] < 0.17) & (at[..., 1] > -0.03) & (at[..., 1] < 0.11)
    depth = np.where(on, depth, 1.0) + rng.normal(0.0, noise_m, SHAPE)
    black = on & ((np.floor(at[..., 0] / 0.02) + np.floor(at[..., 1] / 0.02)) % 2 == 0)
    depth[black & (rng.uniform(size=SHAPE) < 0.3)] = np.nan
    points = CORNERS @ T[:3, :3].T + T[:3, 3]
    pixels = FOCAL_PX * points[:, :2] / points[:, 2:] + (240.0, 180.0)
    return rw.clouds.Cloud.of(rays * depth[..., None]), pixels + rng.normal(0.0, corner_px, pixels.shape)


def test_pose_is_as_near_to_the_truth_as_its_covariance_says() -> None:
    squares = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        facing = Rotation.from_rotvec(rng.normal(0.0, 0.3, 3)).as_matrix()
        T = pose(facing, np.array([-0.07, -0.04, 0.5]) + rng.normal(0.0, 0.02, 3))
        cloud, pixels = seen(T, rng, 3e-4, 0.1)
        found = rw.clouds.board_in_depth(cloud, pixels, CORNERS)
        error = logmap(inverse(found.T_sensor_board[None]) @ T)[0]
        squares.append(error @ np.linalg.solve(found.covariance, error))
        assert np.linalg.norm(error[3:]) < 5e-4
    assert 4.0 < np.mean(squares) < 8.0  # chi2 with 6 degrees of freedom


def test_corners_without_depth_or_with_that_of_something_else_are_left_out() -> None:
    rng = np.random.default_rng(0)
    T = pose(np.eye(3), np.array([-0.07, -0.04, 0.5]))
    cloud, pixels = seen(T, rng, 2e-4, 0.05)
    far = np.zeros(len(cloud), dtype=bool)
    place = np.round(pixels[0]).astype(int)
    rows, columns = np.divmod(cloud.at, SHAPE[1])
    far |= np.hypot(columns - place[0], rows - place[1]) < 6.0
    moved = rw.clouds.Cloud.of(np.where(far[:, None], 1.05 * cloud.points, cloud.points))
    whole = np.full((*SHAPE, 3), np.nan)
    whole.reshape(-1, 3)[cloud.at] = moved.points
    whole[rows.max() // 2 :, : int(pixels[8, 0]) - 20] = np.nan
    found = rw.clouds.board_in_depth(rw.clouds.Cloud.of(whole), pixels, CORNERS)
    assert not found.used[0]
    assert found.used.sum() >= 20
    assert np.linalg.norm(logmap(inverse(found.T_sensor_board[None]) @ T)[0, 3:]) < 5e-4


def test_its_poses_calibrate_a_camera_on_a_hand() -> None:
    rng = np.random.default_rng(1)
    Y = pose(Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([0.02, 0.05, 0.08]))
    X = pose(np.eye(3), np.array([0.5, 0.1, 0.0]))
    B, covariances, A = [], [], []
    for _ in range(12):
        facing = Rotation.from_rotvec(rng.normal(0.0, 0.3, 3)).as_matrix()
        T = pose(facing, np.array([-0.07, -0.04, 0.5]) + rng.normal(0.0, 0.03, 3))
        found = rw.clouds.board_in_depth(*seen(T, rng, 2e-4, 0.1), CORNERS)
        B.append(found.T_sensor_board)
        covariances.append(found.covariance)
        A.append(Y @ T @ inverse(X[None])[0] @ expmap(rng.normal(0.0, 1e-5, (1, 6)))[0])
    problem = rw.Problem()
    problem.add("board", "camera", np.array(A), np.array(B), covariances=np.array(covariances))
    result = rw.calibrate(problem)
    assert result.solution.certificate.status is rw.Status.CERTIFIED
    assert np.linalg.norm(result.Y["camera"].translation() - Y[:3, 3]) < 5e-4


def test_what_cannot_be_used_is_said() -> None:
    cloud, pixels = seen(pose(np.eye(3), np.array([-0.07, -0.04, 0.5])), np.random.default_rng(0), 1e-4, 0.05)
    with pytest.raises(CloudError, match="no image of points"):
        rw.clouds.board_in_depth(rw.clouds.Cloud.of(cloud.points), pixels, CORNERS)
    with pytest.raises(CountError, match="40 corners in pixels and 39"):
        rw.clouds.board_in_depth(cloud, pixels, CORNERS[1:])
    with pytest.raises(CloudError, match="only 0 have points"):
        rw.clouds.board_in_depth(cloud, pixels + 2000.0, CORNERS)
