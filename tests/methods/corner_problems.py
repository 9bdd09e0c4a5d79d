"""Observations for methods on corners: two cameras on a hand see a board and a small tag."""

from __future__ import annotations

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.fitting.observations import Observations
from gtsam_rwhec.geometry.poses import Array

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
    return se3.pose(np.stack([x, np.cross(z, x), z], axis=1), eye)


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
