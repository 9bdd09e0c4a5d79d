"""Corners in images as residuals: pixel errors over their deviation, with derivatives by everything that is not known.

A corner p of a target's board is seen by a sensor at the pixel of P = Y^-1 A X p', by the camera's parameters. The
board may be larger than stated, and bent: p' = (1 + s) p + (w_x (x / l)^2 + w_y (y / l)^2) e_z, l the largest distance
of a corner from the board's origin; and each corner may be off its place: p' + d. A is the carriers' pose at the
instant of the image. Where the sensor's clock is off by t seconds, it is the pose at that time: A Expmap(t twist), with
the carriers' velocity at the instant.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.reprojection.lens import pixels_and_derivatives, pixels_of
from gtsam_rwhec.reprojection.observations import Observations
from gtsam_rwhec.vision.camera import Camera

#: The shape of a board: s (a share), w_x and w_y (metres).
SHAPE = 3
#: A corner must be this far in front of its camera, metres.
NEAREST_M = 1e-6


@dataclass(frozen=True, eq=False)
class Stack:
    """All images of one target by one sensor.

    Attributes
    ----------
    target, sensor : str
    instant : (V,) integers
        Which pose of the carriers each image has.
    points : (n, 3) array
        Corners in the target's frame, metres.
    pixels : (V, n, 2) array
        Zero where a corner was not seen.
    known : (V, n) booleans
    camera : Camera
        Its model; its parameters are a variable.
    twist : (V, 6) array, optional
        The carriers' velocity at each image, [omega rad/s, v m/s].
    """

    target: str
    sensor: str
    instant: np.ndarray
    points: Array
    pixels: Array
    known: np.ndarray
    camera: Camera
    twist: Array | None = None

    def selected(self, which: np.ndarray) -> Stack:
        """The images that a mask or an index array selects."""
        twist = None if self.twist is None else self.twist[which]
        return replace(
            self, instant=self.instant[which], pixels=self.pixels[which], known=self.known[which], twist=twist
        )


@dataclass(frozen=True, eq=False)
class Linear:
    """Residuals of a stack (V, 2n), in pixels, and their derivatives (V, 2n, m) by each variable.

    Poses move as T Expmap([omega, v]), A at its instant. Of a stack without velocities, those by the time offset are
    zero. Each corner's residuals have derivatives (V, n, 2, 3) by its own place. A residual is infinite where a corner
    is behind its camera.
    """

    residual: Array
    by_X: Array
    by_Y: Array
    by_A: Array
    by_camera: Array
    by_shape: Array
    by_time: Array
    by_corners: Array


def stacks_of(observations: Observations) -> tuple[tuple[Stack, ...], Array]:
    """The stacks of observations, and the carriers' poses A (I, 4, 4) at all instants: equal poses are one instant."""
    every = np.concatenate([view.A for view in observations.views.values()])
    _, first, index = np.unique(every.reshape(len(every), 16), axis=0, return_index=True, return_inverse=True)
    # in the order of first appearance
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    instant = rank[index.ravel()]
    result, begin = [], 0
    for (target, sensor), view in observations.views.items():
        end = begin + len(view.A)
        known = view.known
        result.append(
            Stack(
                target,
                sensor,
                instant[begin:end],
                observations.corners[target],
                np.where(known[:, :, None], view.pixels, 0.0),
                known,
                observations.cameras[sensor],
                view.twist,
            )
        )
        begin = end
    return tuple(result), every[first[order]]


def shaped(points: Array, shape: Array) -> tuple[Array, Array]:
    """The corners (n, 3) of a board with a shape (3,), and their derivatives (n, 3, 3) by it."""
    squared = (points[:, :2] / np.linalg.norm(points, axis=1).max()) ** 2
    by_shape = np.zeros((len(points), 3, SHAPE))
    by_shape[:, :, 0] = points
    by_shape[:, 2, 1:] = squared
    return points + by_shape @ shape, by_shape


@dataclass(frozen=True, eq=False)
class _Seen:
    """A stack's corners on their way to the camera.

    Attributes
    ----------
    p, q : (n, 3) arrays
        In the target's frame, shaped, and in its carrier's; `by_shape` (n, 3, 3) are derivatives of `p`.
    R : (V, 3, 3) array
        Rotations T_sensor_targetcarrier.
    P, z, x : (V, n, 3), (V, n) and (V, n, 2) arrays
        In the sensor's frame, their depths, and normalised coordinates; 1 and 0 for corners that were not seen.
    behind : (V, n) booleans
        Seen, and behind the camera.
    """

    p: Array
    by_shape: Array
    q: Array
    R: Array
    P: Array
    z: Array
    x: Array
    behind: np.ndarray

    def errors(self, stack: Stack, pixels: Array) -> Array:
        error = np.where(stack.known[..., None], pixels - stack.pixels, 0.0)
        error[self.behind] = np.inf
        return error.reshape(len(error), -1)


def _seen(stack: Stack, X: Array, Y: Array, A: Array, shape: Array, offset_s: float, moved: Array | None) -> _Seen:
    p, by_shape = shaped(stack.points, shape)
    if moved is not None:
        p = p + moved
    q = p @ X[:3, :3].T + X[:3, 3]
    B = se3.inverse(Y) @ A[stack.instant]
    if stack.twist is not None and offset_s != 0.0:
        B = B @ se3.expmap(offset_s * stack.twist)
    R = B[:, :3, :3]
    P = q @ R.transpose(0, 2, 1) + B[:, None, :3, 3]
    behind = stack.known & (P[..., 2] < NEAREST_M)
    z = np.where(stack.known & ~behind, P[..., 2], 1.0)
    x = np.where(stack.known[..., None], P[..., :2] / z[..., None], 0.0)
    return _Seen(p, by_shape, q, R, P, z, x, behind)


def pixel_errors(
    stack: Stack,
    X: Array,
    Y: Array,
    A: Array,
    parameters: Array,
    shape: Array,
    offset_s: float = 0.0,
    moved: Array | None = None,
) -> Array:
    """Errors (V, 2n) of a stack in pixels: as `linearised`, without derivatives."""
    seen = _seen(stack, X, Y, A, shape, offset_s, moved)
    pixels = pixels_of(stack.camera, parameters, seen.x)
    return seen.errors(stack, pixels)


def depths(
    stack: Stack, X: Array, Y: Array, A: Array, shape: Array, offset_s: float = 0.0, moved: Array | None = None
) -> Array:
    """Depths (V, n) of a stack's corners in front of the sensor, metres; 1 where a corner was not seen."""
    return _seen(stack, X, Y, A, shape, offset_s, moved).z


def linearised(
    stack: Stack,
    X: Array,
    Y: Array,
    A: Array,
    parameters: Array,
    shape: Array,
    offset_s: float = 0.0,
    moved: Array | None = None,
) -> Linear:
    """Residuals and derivatives of a stack at X, Y (4, 4), the instants' poses A (I, 4, 4), a camera and a shape.

    `moved` (n, 3) is how far corners are off their places on the board, metres. The images were taken t = `offset_s`
    after their instants: A Expmap(xi) Expmap(t w) = A Expmap(t w) Expmap(Ad xi) with the adjoint of Expmap(-t w), and
    Expmap((t + e) w) = Expmap(t w) Expmap(e w).
    """
    V, n = stack.known.shape
    at = _seen(stack, X, Y, A, shape, offset_s, moved)
    x, z, R, P, q, p = at.x, at.z, at.R, at.P, at.q, at.p
    pixels, by_x, by_parameters = pixels_and_derivatives(stack.camera, parameters, x)
    to_x = np.concatenate([np.broadcast_to(np.eye(2), (V, n, 2, 2)), -x[..., None]], axis=-1) / z[..., None, None]
    seen = stack.known[:, :, None, None]
    by_P = np.where(seen, by_x @ to_x, 0.0)
    by_q = by_P @ R[:, None]  # (V, n, 2, 3)
    minus_hat_q = -se3.hat(q)
    by_p = by_q @ X[:3, :3]

    def rows(block: Array) -> Array:
        return np.ascontiguousarray(block.reshape(V, 2 * n, -1))

    by_A = rows(np.concatenate([by_q @ minus_hat_q, by_q], axis=-1))
    by_time = np.zeros((V, 2 * n, 1))
    if stack.twist is not None:
        by_time = by_A @ stack.twist[..., None]
        if offset_s != 0.0:
            by_A = by_A @ se3.adjoint(se3.expmap(-offset_s * stack.twist))

    return Linear(
        at.errors(stack, pixels),
        rows(np.concatenate([by_p @ -se3.hat(p), by_p], axis=-1)),
        rows(np.concatenate([by_P @ se3.hat(P.reshape(-1, 3)).reshape(V, n, 3, 3), -by_P], axis=-1)),
        by_A,
        rows(np.where(seen, by_parameters, 0.0)),
        rows(by_p @ at.by_shape),
        by_time,
        by_p,
    )
