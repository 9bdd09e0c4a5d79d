"""Reprojection errors over a graph: derivatives, exact data, the optimum, what is refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from method_problems import four_targets, one_pair
from rwhec_factors import se3

from gtsam_rwhec.errors import CameraError, CountError, FrameError, NoiseError, TargetError
from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.methods import MethodOptions, run
from gtsam_rwhec.methods.reprojection import Observations, calibrate, linearised
from gtsam_rwhec.simulate.simulation import frame_distance
from gtsam_rwhec.vision.camera import Camera

CAMERAS = {
    "left": Camera.of(
        1280, 960, "plumb_bob", [[900, 0, 640], [0, 905, 480], [0, 0, 1]], [-0.2, 0.05, 1e-3, -1e-3], "l"
    ),
    "right": Camera.of(1280, 960, "equidistant", [[600, 0, 650], [0, 600, 470], [0, 0, 1]], [0.01, 0, 0, 0], "r"),
}
GRID = np.array([[0.05 * (i - 2.5), 0.05 * (j - 2.0), 0.0] for i in range(6) for j in range(5)])
SQUARE = np.array([[-0.06, 0.06, 0.0], [0.06, 0.06, 0.0], [0.06, -0.06, 0.0], [-0.06, -0.06, 0.0]])


def looking(eye: Array, at: Array, generator: np.random.Generator) -> Array:
    z = (at - eye) / np.linalg.norm(at - eye)
    x = np.cross(generator.standard_normal(3), z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), eye
    return T


def seen(noise_px: float, seed: int, images: int = 12) -> tuple[Observations, dict[str, Array], dict[str, Array]]:
    """Two cameras on a hand, a board and a small tag fixed to the base; A = T_hand_base."""
    generator = np.random.default_rng(seed)
    X = {"board": np.eye(4), "tag": se3.expmap(np.array([[0.1, -0.2, 0.3, 0.3, 0.1, -0.02]]))[0]}
    Y = {name: se3.expmap(np.array([[0.05, 0.03, k, 0.05 * k, 0.02, 0.08]]))[0] for k, name in enumerate(CAMERAS)}
    X["board"][:3, 3] = [0.05, -0.1, 0.01]
    views = {}
    for (target, corners), (sensor, camera) in (
        (t, c) for t in (("board", GRID), ("tag", SQUARE)) for c in CAMERAS.items()
    ):
        A, pixels = [], []
        while len(A) < images:
            direction = generator.standard_normal(3) * [0.6, 0.6, 0.1] + [0.0, 0.0, 1.0]
            eye = X[target][:3, 3] + X[target][:3, :3] @ (
                generator.uniform(0.4, 0.7) * direction / np.linalg.norm(direction)
            )
            T_base_camera = looking(eye, X[target][:3, 3], generator)
            A.append(Y[sensor] @ np.linalg.inv(T_base_camera))
            of_camera = np.linalg.inv(T_base_camera) @ X[target]
            pixels.append(camera.project(corners @ of_camera[:3, :3].T + of_camera[:3, 3]))
            if not camera.inside(pixels[-1]).all():
                A.pop()
                pixels.pop()
        noisy = np.array(pixels) + noise_px * generator.standard_normal(np.shape(pixels))
        if target == "board":
            noisy[generator.random(noisy.shape[:2]) < 0.1] = np.nan  # not every corner is seen
        views[target, sensor] = (np.array(A), noisy)
    found = Observations.of(CAMERAS, {"board": GRID, "tag": SQUARE}, views, max(noise_px, 0.01))
    return found, X, Y


def stacked(X: dict[str, Array], Y: dict[str, Array]) -> Array:
    return np.array([*X.values(), *Y.values()])


def test_gradient_and_hessian_are_the_derivatives() -> None:
    observations, X, Y = seen(0.3, 0)
    T = stacked(X, Y) @ se3.expmap(1e-2 * np.random.default_rng(1).standard_normal((4, 6)))
    here = linearised(observations, T)
    numeric = np.empty(24)
    for k in range(24):
        step = np.zeros(24)
        step[k] = 1e-6
        ahead, behind = (
            linearised(observations, T @ se3.expmap(sign * step.reshape(4, 6))).cost for sign in (1.0, -1.0)
        )
        numeric[k] = (ahead - behind) / 2e-6
    np.testing.assert_allclose(here.g, numeric, rtol=1e-5, atol=1e-4 * np.abs(numeric).max())
    # Gauss-Newton's Hessian is the whole one where the errors vanish.
    exact, X, Y = seen(0.0, 0)
    at_truth = linearised(exact, stacked(X, Y))
    direction = np.random.default_rng(2).standard_normal(24)
    size = 1e-5
    bend = (
        linearised(exact, stacked(X, Y) @ se3.expmap(size * direction.reshape(4, 6))).cost
        + linearised(exact, stacked(X, Y) @ se3.expmap(-size * direction.reshape(4, 6))).cost
        - 2.0 * at_truth.cost
    ) / size**2
    assert direction @ at_truth.H @ direction == pytest.approx(bend, rel=1e-4)


def test_exact_corners_give_the_truth() -> None:
    observations, X, Y = seen(0.0, 3)
    answer = calibrate(observations)
    assert answer.converged
    assert answer.rms_px < 1e-6
    for found, truth in ((answer.X, X), (answer.Y, Y)):
        for name, T in truth.items():
            np.testing.assert_allclose(found[name].matrix(), T, atol=1e-7)
    assert "images' poses" in answer.starts_from


def test_the_cost_is_chi_square_and_a_minimum() -> None:
    observations, _, _ = seen(0.3, 4)
    answer = calibrate(observations)
    count = 2 * sum(int(view.known.sum()) for view in observations.views.values())
    assert 2.0 * answer.cost == pytest.approx(count - 24, abs=5.0 * np.sqrt(2.0 * count))
    assert answer.rms_px == pytest.approx(0.3 * np.sqrt(2.0), rel=0.1)
    T = np.array([pose.matrix() for pose in [*answer.X.values(), *answer.Y.values()]])
    generator = np.random.default_rng(0)
    for size in (1e-2, 1e-4):
        for _ in range(5):
            assert linearised(observations, T @ se3.expmap(size * generator.standard_normal((4, 6)))).cost > answer.cost
    again = calibrate(observations, MethodOptions(start=(answer.X, answer.Y, 1.0)))
    assert again.iterations <= 3
    assert again.cost == pytest.approx(answer.cost, rel=1e-9)


def test_corners_know_more_than_the_poses_that_they_give() -> None:
    """Small, nearly frontal tags have poor poses, with two candidates; their corners weigh what they should."""
    by_corners, by_poses = [], []
    for seed in range(4):
        observations, _, Y = seen(0.5, 10 + seed)
        answer = calibrate(observations)
        poses = run("wang2022", _one_target(observations).poses())
        by_corners.append(frame_distance(answer.Y["left"].matrix(), Y["left"]).translation_m)
        by_poses.append(frame_distance(poses.Y["left"].matrix(), Y["left"]).translation_m)
    assert np.mean(by_corners) < np.mean(by_poses)


def _one_target(observations: Observations) -> Observations:
    views = {pair: view for pair, view in observations.views.items() if pair[0] == "board"}
    return dataclasses.replace(observations, views=views)


def test_a_tilted_board_frame_changes_nothing() -> None:
    """Corners need not have z = 0, only lie in a plane."""
    observations, X, _ = seen(0.0, 5)
    tilt = se3.expmap(np.array([[0.3, -0.4, 0.2, 0.1, 0.2, 0.3]]))[0]
    corners = {**observations.corners, "board": GRID @ tilt[:3, :3].T + tilt[:3, 3]}
    answer = calibrate(dataclasses.replace(observations, corners=corners))
    np.testing.assert_allclose(answer.X["board"].matrix() @ tilt, X["board"], atol=1e-7)


def test_problems_of_poses_are_refused_in_words() -> None:
    for problem in (one_pair().problem, four_targets().problem):
        with pytest.raises(FrameError, match=r"pixels|several"):
            run("evangelista2023", problem)
    with pytest.raises(FrameError, match="corners in pixels"):
        run("evangelista2023", one_pair().problem)


def test_what_cannot_be_observed_is_refused_in_words() -> None:
    A = np.tile(np.eye(4), (3, 1, 1))
    pixels = np.zeros((3, 4, 2))
    square = {"tag": SQUARE}
    with pytest.raises(NoiseError, match="corner_px"):
        Observations.of(CAMERAS, square, {("tag", "left"): (A, pixels)}, 0.0)
    with pytest.raises(FrameError, match="camera middle"):
        Observations.of(CAMERAS, square, {("tag", "middle"): (A, pixels)})
    with pytest.raises(FrameError, match="corners of board"):
        Observations.of(CAMERAS, square, {("board", "left"): (A, pixels)})
    with pytest.raises(CountError, match=r"\(3, 4, 2\)"):
        Observations.of(CAMERAS, square, {("tag", "left"): (A, pixels[:2])})
    with pytest.raises(CountError, match="no views"):
        Observations.of(CAMERAS, square, {})
    hidden = pixels.copy()
    hidden[1, 0] = np.nan
    with pytest.raises(CountError, match="3 corners"):
        Observations.of(CAMERAS, square, {("tag", "left"): (A, hidden)})
    with pytest.raises(TargetError, match="tag"):
        Observations.of(CAMERAS, {"tag": SQUARE[:3]}, {("tag", "left"): (A, pixels)})
    observations, X, Y = seen(0.0, 6, images=5)
    bent = {**observations.corners, "board": GRID + [[0.0, 0.0, 0.01 * (k % 2)] for k in range(30)]}
    with pytest.raises(TargetError, match="do not lie in one plane"):
        calibrate(dataclasses.replace(observations, corners=bent))
    turned = {name: T @ np.diag([1.0, -1.0, -1.0, 1.0]) for name, T in Y.items()}
    with pytest.raises(CameraError, match="behind"):
        calibrate(observations, MethodOptions(start=(X, turned, 1.0)))
    with pytest.raises(FrameError, match="right"):
        calibrate(observations, MethodOptions(start=(X, {"left": Y["left"]}, 1.0)))
