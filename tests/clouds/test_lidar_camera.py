"""A board in the clouds of a LiDAR of few beams, and a camera that sees it: poses, covariances, and what is said."""

from __future__ import annotations

from pathlib import Path

import board_places
import numpy as np
import pytest
from rwhec_factors.se3 import inverse, logmap, pose

import gtsam_rwhec as rw
from gtsam_rwhec.clouds.lidar_boards import turned_like
from gtsam_rwhec.errors import CloudError, CountError, NoiseError, OptionError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.simulate import LidarPlaces, SimulatedLidar, frame_distance, lidar_cloud, lidar_places


@pytest.fixture(scope="module")
def places() -> LidarPlaces:
    return lidar_places(12, 100)


@pytest.fixture(scope="module")
def seen(places: LidarPlaces) -> rw.clouds.SeenBoards:
    return rw.clouds.seen_boards(places.clouds, places.size_m)


def squared(T: Array, covariance: Array, truth: Array, size_m: tuple[float, float]) -> float:
    """The squared error of a pose over its covariance, after the turn that makes it most like the truth."""
    T, covariance = turned_like(T, covariance, truth[:3, :3], size_m)
    error = logmap(inverse(T[None]) @ truth)[0]
    return float(error @ np.linalg.solve(covariance, error))


def test_boards_are_found_without_a_start_and_as_near_as_their_covariances_say(
    places: LidarPlaces, seen: rw.clouds.SeenBoards
) -> None:
    assert seen.used.all()
    squares = [
        squared(T, C, truth, places.size_m)
        for T, C, truth in zip(seen.T_sensor_board, seen.covariances, places.T_lidar_board, strict=True)
    ]
    assert 1.5 < np.mean(squares) < 9.0  # chi2 with 6 degrees of freedom; the edges are known better than is said
    assert "between the board and what is behind it" in str(seen)


def test_a_horizontal_edge_between_two_beams_is_known_to_their_gap(places: LidarPlaces) -> None:
    upright = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # x to the right, z to the LiDAR
    rng = np.random.default_rng(0)
    across = []
    for height in np.linspace(-0.03, 0.03, 5):
        T = pose(upright, np.array([2.0, 0.0, height]))
        board = rw.clouds.find_board(lidar_cloud(SimulatedLidar(), T, places.size_m, rng), places.size_m)
        assert squared(board.T_sensor_board, board.covariance, T, places.size_m) < 22.5  # 99.9 % of chi2(6)
        across.append(np.sqrt(np.diagonal(board.covariance)[3:5]))
    assert np.median(across, axis=0)[1] > 3.0 * np.median(across, axis=0)[0]


def test_beams_that_measure_too_far_are_named(places: LidarPlaces) -> None:
    biases = np.zeros(16)
    biases[[5, 9]] = 0.03, -0.02
    rng = np.random.default_rng(0)
    clouds = [lidar_cloud(SimulatedLidar(), T, places.size_m, rng, biases_m=biases) for T in places.T_lidar_board[:8]]
    seen = rw.clouds.seen_boards(clouds, places.size_m)
    off = dict(zip(seen.biases.rings.tolist(), seen.biases.bias_m, strict=True))
    assert off[5] > 0.015
    assert off[9] < -0.008
    assert "5: +" in str(seen)


def test_what_all_beams_share_is_in_the_covariance() -> None:
    """Biases of 5 mm a beam: 2.2 mm along the line of sight where 0.5 mm were claimed."""
    places = lidar_places(10, 700, lidar=SimulatedLidar(bias_m=0.005))
    seen = rw.clouds.seen_boards(places.clouds, places.size_m)
    held = []
    for common_m in (0.0, seen.common_m):
        problem = rw.clouds.lidar_and_camera(
            places.T_camera_board, seen.T_sensor_board, places.size_m, seen.covariances,
            camera_covariances=places.covariances, common_m=common_m,
        )  # fmt: skip
        found = rw.calibrate(problem, rw.CalibrateOptions(noise="given", sizes="known"))
        held.append(found.contains("lidar", places.T_camera_lidar, 0.95))
    assert held == [False, True]


def test_a_cloud_without_beam_numbers_has_the_same_board(places: LidarPlaces) -> None:
    cloud = places.clouds[0]
    with_rings, without = (
        rw.clouds.find_board(each, places.size_m) for each in (cloud, rw.clouds.Cloud.of(cloud.points))
    )
    assert np.allclose(with_rings.T_sensor_board, without.T_sensor_board, atol=2e-4)


def test_a_motion_during_the_turn_is_taken_off(places: LidarPlaces) -> None:
    truth, twist = places.T_lidar_board[1], np.array([0.0, 0.05, 0.2, 0.6, 0.1, 0.0])
    cloud = lidar_cloud(SimulatedLidar(), truth, places.size_m, np.random.default_rng(0), twist=twist)
    off = {}
    for name, each in (("as it is", cloud), ("deskewed", rw.clouds.deskewed(cloud, twist))):
        board = rw.clouds.find_board(each, places.size_m)
        off[name] = float(np.linalg.norm(board.T_sensor_board[:3, 3] - truth[:3, 3]))
    assert off["as it is"] > 0.02
    assert off["deskewed"] < 0.006
    with pytest.raises(CloudError, match="no times"):
        rw.clouds.deskewed(rw.clouds.Cloud.of(cloud.points), twist)
    with pytest.raises(OptionError, match="six finite numbers"):
        rw.clouds.deskewed(cloud, [0.0, 1.0])


@pytest.mark.parametrize("count", [3, 10])
def test_camera_and_lidar_are_calibrated(places: LidarPlaces, seen: rw.clouds.SeenBoards, count: int) -> None:
    which = slice(0, count)
    problem = rw.clouds.lidar_and_camera(
        places.T_camera_board[which], seen.T_sensor_board[which], places.size_m, seen.covariances[which],
        camera_covariances=places.covariances[which],
    )  # fmt: skip
    found = rw.calibrate(problem, rw.CalibrateOptions(noise="given"))
    assert found.solution.certificate.status is rw.Status.CERTIFIED
    away = frame_distance(found.Y["lidar"].matrix(), places.T_camera_lidar)
    assert away.translation_mm < (3.0 if count == 10 else 12.0)
    assert away.rotation_deg < (0.1 if count == 10 else 0.35)
    assert found.contains("lidar", places.T_camera_lidar, 0.999)


def test_half_turns_and_bad_places_do_not_matter(places: LidarPlaces, seen: rw.clouds.SeenBoards) -> None:
    half = pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    B = seen.T_sensor_board.copy()
    B[::2] = B[::2] @ half
    B[3, :3, 3] += 0.3  # another thing of that size
    problem = rw.clouds.lidar_and_camera(
        places.T_camera_board, B, places.size_m, seen.covariances, camera_covariances=places.covariances
    )
    found = rw.calibrate(problem)
    assert frame_distance(found.Y["lidar"].matrix(), places.T_camera_lidar).translation_mm < 3.0
    kept = next(iter(found.refined.inliers.values()))
    assert not kept[3]
    assert kept.sum() >= 10


def test_a_target_aside_of_the_boards_middle_gives_the_same(places: LidarPlaces, seen: rw.clouds.SeenBoards) -> None:
    aside = pose(np.diag([-1.0, -1.0, 1.0]), np.array([0.02, -0.05, 0.0]))  # T_board_target
    answers = []
    for T_board_target in (np.eye(4), aside):
        problem = rw.clouds.lidar_and_camera(
            places.T_camera_board @ T_board_target, seen.T_sensor_board, places.size_m, seen.covariances,
            T_board_target=T_board_target,
        )  # fmt: skip
        answers.append(rw.solve(problem).Y["lidar"].matrix())
    assert np.allclose(*answers, atol=1e-6)


def test_what_cannot_be_used_is_said(places: LidarPlaces, seen: rw.clouds.SeenBoards) -> None:
    cloud, size = places.clouds[0], places.size_m
    with pytest.raises(CloudError, match=r"no board of 2 x 1.5 m"):
        rw.clouds.find_board(cloud, (2.0, 1.5))
    with pytest.raises(CloudError, match=r"within 0.3 m"):
        rw.clouds.find_board(cloud, size, near=pose(np.eye(3), np.array([-2.0, 0.0, 0.0])), within_m=0.3)
    with pytest.raises(OptionError, match="size_m"):
        rw.clouds.find_board(cloud, (0.0, 1.0))
    with pytest.raises(CloudError, match="no beam numbers"):
        rw.clouds.find_board(rw.clouds.Cloud.of(np.random.default_rng(0).normal(size=(500, 3))), size)
    with pytest.raises(CloudError, match="no cloud of 1 has the board"):
        rw.clouds.seen_boards([cloud], (2.0, 1.5))
    with pytest.raises(CountError, match="12 poses of the camera, 11 of the LiDAR"):
        rw.clouds.lidar_and_camera(places.T_camera_board, seen.T_sensor_board[1:], size, seen.covariances)
    few = np.where(np.arange(12)[:, None, None] < 1, seen.T_sensor_board, np.nan)
    with pytest.raises(CountError, match="1 of 12 places"):
        rw.clouds.lidar_and_camera(places.T_camera_board, few, size, seen.covariances)
    with pytest.raises(NoiseError, match="rotation first"):
        rw.clouds.lidar_and_camera(places.T_camera_board, seen.T_sensor_board, size, np.ones((12, 3, 3)))
    with pytest.raises(NoiseError, match=r"covariances have shapes \(\) and \(\)"):
        rw.clouds.lidar_and_camera(places.T_camera_board, seen.T_sensor_board, size, 3.0)
    with pytest.raises(CloudError, match="clouds are 'folder'; give a list of Cloud"):
        rw.clouds.seen_boards("folder", size)  # type: ignore[arg-type]


def test_real_places_give_one_answer(shared_data: Path) -> None:
    path = shared_data / "lidar_board" / "poses.csv"
    if not path.is_file():
        pytest.skip(f"{path} is not here: set GTSAM_RWHEC_DATA to the folder of other people's data")
    A, B = board_places.places_of(path)
    order = np.random.default_rng(0).permutation(len(A))
    halves = [board_places.halves_of(A, B, np.sort(part)) for part in (order[:20], order[20:])]
    for half, other in zip(halves, halves[::-1], strict=True):
        assert half.solution.certificate.status is rw.Status.CERTIFIED
        assert half.contains("lidar", other.Y["lidar"], 0.95)
    t = 1e3 * inverse(board_places.halves_of(A, B, np.arange(len(A))).Y["lidar"].matrix()[None])[0, :3, 3]
    assert np.linalg.norm(t - (63.0, 11.0, -168.0)) < 20.0  # an independent robust fit of normals and middles
