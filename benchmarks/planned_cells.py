"""Simulated cells that plans are tried on: an arm's noise, cameras that project boards, and takes of them."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rwhec_factors import se3
from scipy.spatial.transform import Rotation
from simulated_arms import moved_by, white

import gtsam_rwhec as rw
from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Charuco, Checkerboard

Array = NDArray[np.float64]
KINDS = ("hand", "fixed", "two cameras", "three boards")
#: Of each sensor's guess, rad and m about and along each axis.
GUESS_RAD, GUESS_M = np.radians(5.0), 0.03
#: The limits of every pose, planned or random: tilt and turn in degrees, and half of the box about the present pose, m.
TILT_DEG, TURN_DEG, BOX_M = 60.0, 90.0, 0.4
BATCH = 1000
WANTED_AT_M = 0.8


@dataclass(frozen=True, eq=False)
class TrueCell:
    """What is true of a cell, and what its operator knows."""

    kind: str
    X: dict[str, Array]
    Y: dict[str, Array]
    cameras: dict[str, Camera]
    boards: dict[str, Array]
    noise: rw.CarrierNoise
    corner_px: float
    present: Array
    guesses: dict[str, Array]
    rng: np.random.Generator

    @property
    def options(self) -> rw.PlanOptions:
        """What the operator tells the planner."""
        return rw.PlanOptions(
            wanted=rw.Accuracy(distance_m=WANTED_AT_M), tilt_deg=TILT_DEG, turn_deg=TURN_DEG,
            box_m=tuple(tuple(self._moving(self.present)[:3, 3] + side) for side in (-BOX_M, BOX_M)),
            present=self.present, guesses=self.guesses, guess_deg=float(np.degrees(GUESS_RAD)), guess_m=GUESS_M,
            corner_px=self.corner_px, carrier_noise=self.noise,
            moves="targets" if self.kind == "fixed" else "sensors", stated="exact",
        )  # fmt: skip

    def whole(self, target: str, sensor: str, A: Array) -> tuple[Array, NDArray[np.bool_]]:
        """A board's corners in images at A (N, 4, 4), exact (N, n, 2), and where it is whole in front of the camera."""
        B = se3.inverse(self.Y[sensor]) @ A @ self.X[target]
        pixels = self.cameras[sensor].project(self.boards[target] @ B[:, :3, :3].transpose(0, 2, 1) + B[:, None, :3, 3])
        faces = np.einsum("ni,ni->n", B[:, :3, 2], B[:, :3, 3]) < 0.0
        return pixels, faces & self.cameras[sensor].inside(pixels).all(axis=1)

    def pixels(self, target: str, sensor: str, A: Array) -> Array | None:
        """A board's corners in an image, exact; None where it is not whole in front of the camera."""
        pixels, is_whole = self.whole(target, sensor, A[None])
        return pixels[0] if is_whole[0] else None

    def sees(self, A: Array, tilt_deg: float = 90.0) -> NDArray[np.bool_]:
        """Whether any camera sees any board, tilted by at most so much, at A (N, 4, 4)."""
        found = np.zeros(len(A), dtype=bool)
        for target, X in self.X.items():
            for sensor, Y in self.Y.items():
                B = se3.inverse(Y) @ A @ X
                ray = B[:, :3, 3] / np.linalg.norm(B[:, :3, 3], axis=1)[:, None]
                is_upright = -np.einsum("ni,ni->n", B[:, :3, 2], ray) >= np.cos(np.radians(tilt_deg))
                found |= is_upright & self.whole(target, sensor, A)[1]
        return found

    def take(self, problem: rw.Problem, A: Array, stamp: int) -> int:
        """Measure at a pose; how many boards were seen."""
        reported, count = self.reported(A), 0
        for target in self.X:
            for sensor in self.Y:
                pixels = self.pixels(target, sensor, A)
                if pixels is not None:
                    seen = pixels + self.rng.normal(0.0, self.corner_px, pixels.shape)
                    problem.add_corners(
                        target, sensor, reported[None], seen[None], self.boards[target], self.cameras[sensor],
                        corner_px=self.corner_px, stamps_ns=[stamp],
                    )  # fmt: skip
                    count += 1
        return count

    def reported(self, A: Array) -> Array:
        """What the arm reports of a pose."""
        xi = white(1, self.noise.rotation_rad, self.noise.translation_m, self.rng)
        if self.noise.about == "targetcarrier":
            return np.asarray(moved_by(A[None], xi)[0])
        return np.asarray(se3.inverse(moved_by(se3.inverse(A[None]), xi))[0])

    def random_poses(self, count: int, turn_deg: float) -> Array:
        """A (n, 4, 4), uniform in the box and turned by up to so much, where a camera sees a whole board."""
        found: list[Array] = []
        T_now = self._moving(self.present)
        while len(found) < count:
            turns = self.rng.standard_normal((BATCH, 3))
            turns *= (
                np.radians(turn_deg)
                * self.rng.random((BATCH, 1)) ** (1.0 / 3.0)
                / np.linalg.norm(turns, axis=1)[:, None]
            )
            place = T_now[:3, 3] + self.rng.uniform(-BOX_M, BOX_M, (BATCH, 3))
            T = se3.pose(T_now[:3, :3] @ Rotation.from_rotvec(turns).as_matrix(), place)
            found += [*(A := self._moving(T))[self.sees(A, TILT_DEG)]]
        return np.array(found[:count])

    def _moving(self, T: Array) -> Array:
        """The moving carrier's pose of A, and A of the moving carrier's pose."""
        return T if self.kind == "fixed" else np.asarray(se3.inverse(T))


def _looking(rng: np.random.Generator, camera: Camera, distance: float, tilt: float, aside: float = 1.0) -> Array:
    pixel = 0.5 * np.array([camera.width, camera.height]) * (1.0 + aside * rng.uniform(-1.0, 1.0, 2))
    ray = np.append((pixel - camera.K[:2, 2]) / camera.K[0, 0], 1.0)
    about, roll = rng.uniform(-np.pi, np.pi, 2)
    R = Rotation.from_rotvec(tilt * np.array([np.cos(about), np.sin(about), 0.0])).as_matrix() @ np.diag(
        [1.0, -1.0, -1.0]
    )
    R = R @ Rotation.from_rotvec([0.0, 0.0, roll]).as_matrix()
    return np.asarray(se3.pose(R, distance * ray / np.linalg.norm(ray)))


def cell(kind: str, seed: int) -> TrueCell:
    """Draw a cell."""
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode())])
    boards: list[Array] = []
    for _ in range(3 if kind == "three boards" else 1):
        square = rng.uniform(0.02, 0.035)
        board = Charuco("b", "aruco_4x4_100", 7, 5, square, 0.75 * square) if rng.random() < 0.5 else None
        boards.append((board or Checkerboard("b", 6, 8, square)).corners())
    cameras = {}
    for i in range(2 if kind == "two cameras" else 1):
        width = int(rng.choice([1024, 1280, 1600]))
        f = width * rng.uniform(0.8, 1.3)
        K = [[f, 0.0, width / 2 - 0.5], [0.0, f, 3 * width / 8 - 0.5], [0.0, 0.0, 1.0]]
        cameras[f"cam_{i}"] = Camera.of(width, 3 * width // 4, "pinhole", K, [], "a simulated cell")
    first = cameras["cam_0"]
    turn, place = Rotation.random(2, random_state=rng).as_matrix(), rng.uniform(-0.5, 0.5, (2, 3))
    Y = {"cam_0": se3.pose(turn[0], 0.3 * place[0])}
    if "cam_1" in cameras:  # beside the first, turned towards what it sees
        beside = moved_by(np.eye(4)[None], np.concatenate([rng.uniform(-0.2, 0.2, 3), [0.1, 0.0, 0.0]])[None])[0]
        Y["cam_1"] = Y["cam_0"] @ beside
    X = {"board_0": se3.pose(turn[1], place[1])}
    for i in range(1, len(boards)):
        aside = np.array([0.35 * np.cos(2.5 * i), 0.35 * np.sin(2.5 * i), 0.05 * i])
        X[f"board_{i}"] = (
            X["board_0"] @ moved_by(np.eye(4)[None], np.concatenate([rng.uniform(-0.4, 0.4, 3), aside])[None])[0]
        )
    B = _looking(rng, first, rng.uniform(0.5, 0.8), rng.uniform(0.0, 0.3), aside=0.1)
    present = Y["cam_0"] @ B @ se3.inverse(X["board_0"])
    about = "targetcarrier" if kind == "fixed" else "sensorcarrier"
    noise = rw.CarrierNoise(np.radians(rng.uniform(0.01, 0.03)), rng.uniform(5e-5, 2e-4), about=about)
    guesses = {name: moved_by(T[None], white(1, GUESS_RAD, GUESS_M, rng))[0] for name, T in Y.items()}
    return TrueCell(
        kind, X, Y, cameras, {f"board_{i}": one for i, one in enumerate(boards)}, noise, rng.uniform(0.1, 0.2),
        present, guesses, rng,
    )  # fmt: skip
