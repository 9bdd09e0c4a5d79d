"""Cells with fixed cameras and a board on the hand, whose truth is known: corners are drawn with their noise.

Then boards in other places, boards that were misprinted, carriers that move while images are taken, a model of the
corners with a point near the truth, and what its graph and its sums are compared with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.cameras.targets import Checkerboard
from gtsam_rwhec.fitting.corner_model import Model, Point
from gtsam_rwhec.fitting.corner_noise import Reduced
from gtsam_rwhec.fitting.corner_refinement import refine_corners
from gtsam_rwhec.fitting.corner_residuals import shaped, stacks_of
from gtsam_rwhec.fitting.corners_refined import CornersRefined
from gtsam_rwhec.fitting.fit_options import CornerOptions, Stated
from gtsam_rwhec.fitting.observations import Observations
from gtsam_rwhec.fitting.stated_intrinsics import prior_of

Array = NDArray[np.float64]
BOARD = Checkerboard("board", 7, 5, 0.04)
CAMERA = Camera.of(
    1920,
    1080,
    "radtan",
    [[1400.0, 0.0, 960.0], [0.0, 1400.0, 540.0], [0.0, 0.0, 1.0]],
    (-0.1, 0.05, 1e-3, -5e-4),
    "cell",
)
#: The middle of the board's poses in the base.
MIDDLE = np.array([0.0, 0.0, 0.3])


@dataclass(frozen=True, eq=False)
class Cell:
    """What was observed, with intrinsics as stated; and the truth."""

    observations: Observations
    X: dict[str, Array]
    Y: dict[str, Array]
    cameras: dict[str, Camera]
    shape: Array

    def near(self, rng: np.random.Generator, off: float = 3e-3) -> tuple[dict[str, Array], dict[str, Array]]:
        """A start near the truth."""

        def moved(poses: dict[str, Array]) -> dict[str, Array]:
            return {name: T @ se3.expmap(rng.normal(scale=off, size=(1, 6)))[0] for name, T in poses.items()}

        return moved(self.X), moved({name: self.Y[name] for name in self.observations.sensors})

    def refined(self, options: CornerOptions | None = None, seed: int = 9) -> CornersRefined:
        """The refinement from a start near the truth."""
        return refine_corners(self.observations, *self.near(np.random.default_rng(seed)), options)

    def error(self, found: CornersRefined, frame: str) -> Array:
        """xi (6,) with the found pose Expmap(xi) the frame's true one."""
        pose, truth = ((of.X | of.Y)[frame] for of in (found, self))
        error: Array = se3.logmap((se3.inverse(pose.matrix()) @ truth)[None])[0]
        return error

    def squared_error(self, found: CornersRefined, frame: str) -> float:
        """The squared error of a frame's pose over its covariance."""
        error = self.error(found, frame)
        return float(error @ np.linalg.solve(found.covariance(frame), error))


def cell(
    seed: int,
    *,
    cameras: int = 2,
    images: int = 30,
    board: Checkerboard = BOARD,
    camera: Camera = CAMERA,
    stated: Stated | None = None,
    stated_off: Array | None = None,
    carrier: tuple[float, float] = (0.0, 0.0),
    corner_px: float = 0.1,
    shape: tuple[float, float, float] = (0.0, 0.0, 0.0),
    facing: Callable[[Array, np.random.Generator], Array] | None = None,
    distance: float = 1.5,
    tilt: float = 0.35,
) -> Cell:
    """A cell of fixed cameras in a ring about the arm; the board turns to one of them at each instant.

    `facing` draws T_base_board for a camera's T_base_camera; left out, the board is near the middle, tilted, and turned
    about its normal (`Placement` has others).

    Stated intrinsics are off by a draw of the prior of `stated`, or by `stated_off` (m,). `carrier` and `shape` are
    standard deviations: of A (rad, m), and of the board's size and warp. `distance` is the ring's radius, metres, and
    `tilt` how far the board's normal is off the camera's direction, a share of it about each axis.
    """
    rng = np.random.default_rng(seed)
    X = se3.expmap(np.array([[0.1, 0.2, -0.3, 0.05, 0.02, 0.1]]))[0]
    Y = {}
    for k in range(cameras):
        angle = 2.0 * np.pi * k / cameras
        at = distance / 1.5 * np.array([1.5 * np.cos(angle), 1.5 * np.sin(angle), 0.8]) + rng.normal(scale=0.1, size=3)
        Y[f"cam_{k}"] = _looking(MIDDLE, at) @ se3.expmap(rng.normal(scale=0.05, size=(1, 6)))[0]
    true_shape = np.append(rng.normal(size=3) * shape, 0.0)
    points, _ = shaped(board.corners(), true_shape)
    seen: dict[str, tuple[list[Array], list[Array]]] = {name: ([], []) for name in Y}
    done = 0
    while done < images:
        towards = Y[f"cam_{rng.integers(cameras)}"]
        A = (_facing(towards, rng, tilt) if facing is None else facing(towards, rng)) @ se3.inverse(X)
        measured = A @ se3.expmap(rng.normal(size=(1, 6)) * np.repeat(carrier, 3))[0]
        any_seen = False
        for name, T_base_cam in Y.items():
            pixels = _pixels(se3.inverse(T_base_cam) @ A @ X, points, camera)
            if pixels is not None:
                seen[name][0].append(measured)
                seen[name][1].append(pixels + rng.normal(scale=corner_px, size=pixels.shape))
                any_seen = True
        done += any_seen
    truth = camera.parameters
    as_stated = {}
    for name in Y:
        off = np.zeros(len(truth)) if stated_off is None else stated_off
        if stated is not None:
            root = np.linalg.cholesky(prior_of(camera, stated).precision)
            off = off + np.linalg.solve(root.T, rng.normal(size=len(truth)))
        as_stated[name] = camera.with_parameters(truth + off)
    observations = Observations.of(
        as_stated,
        {"board": board.corners()},
        {("board", name): (np.array(A), np.array(pixels)) for name, (A, pixels) in seen.items() if A},
    )
    return Cell(observations, {"board": X}, Y, dict.fromkeys(Y, camera), true_shape)


def _looking(at: Array, place: Array) -> Array:
    """T_base_camera of a camera at a place that looks at a point, upright."""
    z = (at - place) / np.linalg.norm(at - place)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return se3.pose(np.stack([x, np.cross(z, x), z], axis=1), place)


def _facing(T_base_camera: Array, rng: np.random.Generator, tilt: float) -> Array:
    """T_base_board of a board near the middle that faces a camera more or less, turned about its normal."""
    place = MIDDLE + rng.normal(scale=0.15, size=3)
    z = T_base_camera[:3, 3] - place
    z = z / np.linalg.norm(z) + rng.normal(scale=tilt, size=3)
    z /= np.linalg.norm(z)
    x = np.cross(rng.normal(size=3), z)
    x /= np.linalg.norm(x)
    return se3.pose(np.stack([x, np.cross(z, x), z], axis=1), place)


def _pixels(T_camera_board: Array, points: Array, camera: Camera) -> Array | None:
    """All corners in the image, or None."""
    seen = points @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
    t = T_camera_board[:3, 3]
    if seen[:, 2].min() < 0.2 or -(T_camera_board[:3, 2] @ t) / np.linalg.norm(t) < 0.35:
        return None
    pixels = camera.with_parameters(camera.parameters).pixels(seen[:, :2] / seen[:, 2:])
    return pixels if camera.inside(pixels).all() else None


@dataclass(frozen=True)
class Placement:
    """How boards are drawn in front of a camera."""

    depth_m: tuple[float, float] = (1.5, 0.15)  #: Mean and standard deviation of the depth of the board's middle
    #: Standard deviation of the board's tilt about each of its axes, radians; 0: it is fronto-parallel.
    tilt: float = 0.35
    #: aim, spread: Where the board's middle is: normalised coordinates, mean and standard deviation.
    aim: tuple[float, float] = (0.0, 0.0)
    spread: tuple[float, float] = (0.1, 0.1)

    def __call__(self, T_base_camera: Array, rng: np.random.Generator) -> Array:
        """Draw T_base_board: the board's z axis to the camera, tilted, and turned about it by any angle."""
        x = np.array(self.aim) + rng.normal(size=2) * self.spread
        depth = self.depth_m[0] + self.depth_m[1] * rng.normal()
        tilt = np.array([*rng.normal(scale=self.tilt, size=2), 0.0]) if self.tilt else np.zeros(3)
        turn = np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)])
        R = np.diag([1.0, -1.0, -1.0]) @ se3.expmap(np.array([[*tilt, 0, 0, 0], [*turn, 0, 0, 0]]))[:, :3, :3]
        R = R[0] @ np.diag([1.0, -1.0, -1.0]) @ R[1]
        T: Array = T_base_camera @ se3.pose(R, depth * np.array([*x, 1.0]))
        return T


#: Small tilts, at one place in the middle of the image: intrinsics are hardly told.
WEAK = Placement(depth_m=(2.0, 0.1), tilt=0.1, spread=(0.05, 0.05))
#: What determines no intrinsics, or only some. Boards that are fronto-parallel to the last milliradian determine no
#: poses either.
UNDETERMINED = {
    "nearly fronto-parallel": Placement(tilt=0.005),
    "nearly fronto-parallel at one depth": Placement(depth_m=(1.5, 0.0), tilt=0.005),
    "at one depth": Placement(depth_m=(1.5, 0.0)),
    "in a corner of the image": Placement(depth_m=(2.5, 0.2), aim=(0.5, 0.28), spread=(0.02, 0.015)),
}


@dataclass(frozen=True)
class Misprinted(Checkerboard):
    """A checkerboard with corners that are off their places by a normal draw along each axis, metres."""

    deviation_m: float = 0.0
    seed: int = 0

    def off(self) -> NDArray[np.float64]:
        """(n, 3), metres."""
        return np.random.default_rng(self.seed).normal(scale=self.deviation_m, size=super().corners().shape)

    def corners(self) -> NDArray[np.float64]:
        return super().corners() + self.off()


def misprinted(
    seed: int, deviation_m: float, board: Checkerboard = BOARD, **others: Any
) -> tuple[Cell, NDArray[np.float64]]:
    """A cell as `cell` makes it, whose observations have the board as it should be; and what each corner is off it."""
    made = Misprinted(board.name, board.columns, board.rows, board.square_m, deviation_m=deviation_m, seed=seed)
    given = cell(seed, board=made, **others)
    return replace(given, observations=replace(given.observations, corners={"board": board.corners()})), made.off()


#: Speeds of the carriers about and along each axis: rad/s, m/s.
SPEED = np.repeat([0.4, 0.2], 3)


def moving(
    given: Cell, seed: int, offsets_s: Mapping[str, float], speed: NDArray[np.float64] = SPEED, *, alike: bool = False
) -> Cell:
    """The cell with A as it was `offsets_s` before each image of a sensor, and with the velocity that it had there.

    Velocities are drawn for each instant, or once for all.
    """
    stacks, A = stacks_of(given.observations)
    twist = np.random.default_rng(seed).normal(size=(1 if alike else len(A), 6)) * speed
    views = {}
    for stack in stacks:
        view = given.observations.views[stack.targets[0], stack.sensor]
        of_view = np.broadcast_to(twist, (len(A), 6))[stack.instant]
        before = view.A @ se3.expmap(-offsets_s.get(stack.sensor, 0.0) * of_view)
        views[stack.targets[0], stack.sensor] = replace(view, A=before, twist=of_view)
    return replace(given, observations=replace(given.observations, views=views))


A_NOISE = np.repeat([1e-3, 5e-4], 3)
CORNER_PX = 0.1


def model_and_point(small: Cell, *, about: str = "targetcarrier", exact: bool = False) -> tuple[Model, Point]:
    stacks, A = stacks_of(small.observations)
    cameras = small.observations.cameras
    names = small.observations.sensors
    model = Model(
        stacks, A, None if exact else A_NOISE, about, {name: name for name in names},  # type: ignore[arg-type]
        {name: prior_of(cameras[name], "nominal") for name in names}, {"board": np.full(4, 1e-3)}, CORNER_PX,
        tuple(stack.known.astype(float) for stack in stacks), bias_px={"board": 0.0},
    )  # fmt: skip
    rng = np.random.default_rng(7)
    moved = A if exact else A @ se3.expmap(rng.normal(size=(len(A), 6)) * A_NOISE)
    X, Y = small.near(rng, 1e-3)
    cameras_at = {name: cameras[name].parameters * (1.0 + 1e-3) for name in names}
    return model, Point(X, Y, moved, cameras_at, {"board": np.full(4, 5e-4)})


def slopes(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, key: int, size: int = 6, step: float = 1e-7
) -> Array:
    """The derivative (size,) of a graph's cost by one variable, by differences."""
    found = []
    for direction in step * np.eye(size):
        ends = []
        for sign in (1.0, -1.0):
            delta = gtsam.VectorValues()
            delta.insert(key, sign * direction)
            ends.append(graph.error(values.retract(delta)))
        found.append((ends[0] - ends[1]) / (2.0 * step))
    return np.array(found)


def information_by_instant(reduced: Reduced) -> Array:
    """(d, d): of all unknowns but A, whose errors are eliminated instant by instant."""
    s2 = CORNER_PX**2
    H = reduced.G / s2 + reduced.prior
    for C, M in zip(reduced.C, reduced.M, strict=True):
        H -= C.T @ np.linalg.solve(np.diag(A_NOISE**-2.0) + M / s2, C) / s2**2
    return H


def check_inverse(covariance: Array, information: Array) -> None:
    """They are inverse to each other, in units of the deviations."""
    size = np.sqrt(np.diagonal(covariance))
    scale = np.outer(size, size)
    np.testing.assert_allclose(covariance / scale, np.linalg.inv(information) / scale, rtol=1e-6, atol=1e-6)
