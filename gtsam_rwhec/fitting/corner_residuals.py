"""Corners in images as residuals: pixel errors over their deviation, with derivatives by everything that is not known.

A corner p of a target's board is seen by a sensor at the pixel of P = Y^-1 A X p', by the camera's parameters. The
board may be larger than stated, and bent about any axis, with l the largest distance of a corner from its origin:

    p' = (1 + s) p + (w_x x^2 + w_y y^2 + w_xy x y) / l^2 e_z

Each corner may be off its place: p' + d. A is the carriers' pose at the instant of the image. Where the sensor's clock
is off by t seconds, it is the pose at that time: A Expmap(t twist), with the carriers' velocity at the instant.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.cameras.camera import Camera
from gtsam_rwhec.fitting.observations import Observations
from gtsam_rwhec.fitting.stated_intrinsics import pixels_and_derivatives
from gtsam_rwhec.geometry.poses import Array

#: The shape of a board: s (a share), w_x, w_y and w_xy (metres).
SHAPE = 4
#: A corner must be this far in front of its camera, metres.
NEAREST_M = 1e-6


#: Where products are in the flat forms of sums (`corner_model.Sums`): (T, m + 1, m + 1), (V, 6, m + 1) and (V, 6, 6).
Places = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Stack:
    """All images by one sensor of targets that are alike: they have as many corners, and as many unknowns."""

    targets: tuple[str, ...]
    sensor: str
    #: (V,): Which of the targets each image has, in their order; each has some.
    target: np.ndarray
    #: (V,): Which pose of the carriers each image has.
    instant: np.ndarray
    #: (T, n, 3): Each target's corners in its frame, metres.
    points: Array
    #: (V, n, 2): Zero where a corner was not seen.
    pixels: Array
    known: np.ndarray
    #: Its model; its parameters are a variable.
    camera: Camera
    #: (V, 6): The carriers' velocity at each image, [omega rad/s, v m/s].
    twist: Array | None = None

    def selected(self, which: np.ndarray) -> Stack:
        """The images that a mask or an index array selects, in their order, and the targets that are in them."""
        twist = None if self.twist is None else self.twist[which]
        there, target = np.unique(self.target[which], return_inverse=True)
        return replace(
            self, targets=tuple(self.targets[t] for t in there), target=target, instant=self.instant[which],
            points=self.points[there], pixels=self.pixels[which], known=self.known[which], twist=twist,
        )  # fmt: skip

    @cached_property
    def first(self) -> np.ndarray:
        """The first image (T,) of each target."""
        return np.flatnonzero(np.diff(self.target, prepend=-1))

    @property
    def pairs(self) -> Iterator[tuple[tuple[str, str], slice]]:
        """Each target with the sensor, and its images."""
        ends = [*self.first[1:].tolist(), len(self.target)]
        for target, begin, end in zip(self.targets, self.first.tolist(), ends, strict=True):
            yield (target, self.sensor), slice(begin, end)

    def each(self, values: Array) -> Array:
        """Values of the targets (T, ...) as values of the images (V, ...); as they are where there is one target."""
        return values if len(self.targets) == 1 else np.asarray(values[self.target])

    def sums(self, values: Array) -> Array:
        """Sums (T, ...) by target of values of the images (V, ...)."""
        return np.add.reduceat(values, self.first)

    def places(self, columns: np.ndarray, size: int) -> Places:
        """Of its products by the unknowns in ``columns`` (T, m), and the residual's, which is the last of ``size``."""
        at = np.pad(columns, ((0, 0), (0, 1)), constant_values=size - 1)
        by_A = 6 * self.instant[:, None] + np.arange(6)
        of_A = by_A[:, :, None] * size + self.each(at)[:, None]
        return at[:, :, None] * size + at[:, None], of_A, 6 * by_A[:, :, None] + np.arange(6)


@dataclass(frozen=True, eq=False)
class Linear:
    """Residuals of a stack (V, 2n), in pixels, and their derivatives (V, 2n, m) by each variable.

    Poses move as T Expmap([omega, v]), A at its instant. All of them move the target's pose in the sensor's frame, B =
    Y^-1 A Expmap(t w) X, so the derivatives by B turn into theirs by adjoints, when they are asked for. A residual is
    infinite where a corner is behind its camera.
    """

    #: (V, 2n)
    residual: Array
    #: (V, 2n, 6)
    by_B: Array
    #: (V, 2n, m)
    by_camera: Array
    #: (V, 4, 4)
    B: Array
    #: (V, 4, 4), or (1, 4, 4) where the stack has one target.
    X: Array
    #: (V, n, 3, k), or (1, n, 3, k): Derivatives of the corners' places by the numbers of the shape.
    shapes: Array
    #: (V, 6)
    twist: Array | None
    offset_s: float

    @property
    def by_X(self) -> Array:
        """By X: B Expmap(xi)."""
        return self.by_B

    @property
    def by_Y(self) -> Array:
        """By Y: Expmap(-xi) B = B Expmap(-Ad(B^-1) xi)."""
        return -(self.by_B @ se3.adjoint(se3.inverse(self.B)))

    @property
    def by_A(self) -> Array:
        """By A at its instant: A Expmap(xi) Expmap(t w) = A Expmap(t w) Expmap(Ad xi), the adjoint of Expmap(-t w)."""
        later = self._by_later_A
        if self.twist is None or self.offset_s == 0.0:
            return later
        return later @ se3.adjoint(se3.expmap(-self.offset_s * self.twist))

    @property
    def by_time(self) -> Array:
        """By the time offset (V, 2n, 1): Expmap((t + e) w) = Expmap(t w) Expmap(e w). Zero of a stack without w."""
        if self.twist is None:
            return np.zeros((*self.residual.shape, 1))
        return self._by_later_A @ self.twist[..., None]

    @property
    def by_corners(self) -> Array:
        """Each corner's residuals by its own place (V, n, 2, 3)."""
        return self.by_B[..., 3:].reshape(len(self.residual), -1, 2, 3)

    @property
    def by_shape(self) -> Array:
        """By the numbers of the shape."""
        return (self.by_corners @ self.shapes).reshape(*self.residual.shape, -1)

    @property
    def _by_later_A(self) -> Array:
        """By A at the image's own time."""
        return self.by_B @ se3.adjoint(se3.inverse(self.X))


def stacks_of(
    observations: Observations, kind: Callable[[str], object] = lambda target: None
) -> tuple[tuple[Stack, ...], Array]:
    """The stacks of observations, and the carriers' poses A (I, 4, 4) at all instants: equal poses are one instant.

    Targets of one `kind` with as many corners share a stack.
    """
    every = np.concatenate([view.A for view in observations.views.values()])
    ends = np.cumsum([0, *(len(view.A) for view in observations.views.values())])
    _, first, index = np.unique(every.reshape(len(every), 16), axis=0, return_index=True, return_inverse=True)
    # in the order of first appearance
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    instant = rank[index.ravel()]
    alike: dict[tuple[str, int, bool, object], dict[str, np.ndarray]] = {}
    for number, ((target, sensor), view) in enumerate(observations.views.items()):
        key = sensor, view.pixels.shape[1], view.twist is None, kind(target)
        alike.setdefault(key, {})[target] = instant[ends[number] : ends[number + 1]]
    result = []
    for key, instants in alike.items():
        sensor = key[0]
        views = [observations.views[target, sensor] for target in instants]
        pixels = np.concatenate([view.pixels for view in views])
        known = np.asarray(np.isfinite(pixels).all(axis=2))
        result.append(
            Stack(
                tuple(instants),
                sensor,
                np.repeat(np.arange(len(views)), [len(view.A) for view in views]),
                np.concatenate(list(instants.values())),
                np.array([observations.corners[target] for target in instants]),
                np.where(known[:, :, None], pixels, 0.0),
                known,
                observations.cameras[sensor],
                np.concatenate(twists) if (twists := [v.twist for v in views if v.twist is not None]) else None,
            )
        )
    return tuple(result), every[first[order]]


def shaped(points: Array, shape: Array) -> tuple[Array, Array]:
    """The corners (..., n, 3) of boards with shapes (..., 4), and their derivatives (..., n, 3, 4) by them."""
    size = np.linalg.norm(points, axis=-1).max(axis=-1)[..., None]
    x, y = points[..., 0] / size, points[..., 1] / size
    by_shape = np.zeros((*points.shape, SHAPE))
    by_shape[..., 0] = points
    by_shape[..., 2, 1:] = np.stack([x * x, y * y, x * y], axis=-1)
    return points + (by_shape @ shape[..., None, :, None])[..., 0], by_shape


@dataclass(frozen=True, eq=False)
class Seen:
    """A stack's corners on their way to the camera."""

    #: (V, n, 3), or (1, n, 3) of one target: In its frame, shaped; `by_shape` (V, n, 3, 4) are its derivatives.
    p: Array
    by_shape: Array
    #: (V, 4, 4): Poses T_sensor_target.
    B: Array
    #: (V, n, 3): In the sensor's frame, their depths, and normalised coordinates; 1 and 0 for corners that were not
    #: seen.
    P: Array
    z: Array
    x: Array
    #: Seen, and behind the camera.
    behind: np.ndarray

    @property
    def radius(self) -> Array:
        """Normalised radii (V, n); 0 for corners that were not seen."""
        return np.asarray(np.linalg.norm(self.x, axis=2))

    def errors(self, stack: Stack, pixels: Array) -> Array:
        """Errors (V, 2n) of predicted pixels; infinite behind the camera."""
        error = np.where(stack.known[..., None], pixels - stack.pixels, 0.0)
        error[self.behind] = np.inf
        return error.reshape(len(error), -1)


def seen(stack: Stack, X: Array, Y: Array, A: Array, shape: Array, offset_s: float, moved: Array | None) -> Seen:
    """A stack's corners on their way to the camera, at a point; `linearised` says what its numbers are."""
    p, by_shape = map(stack.each, shaped(stack.points, shape))
    if moved is not None:
        p = p + moved
    B = se3.inverse(Y) @ A[stack.instant]
    if stack.twist is not None and offset_s != 0.0:
        B = B @ se3.expmap(offset_s * stack.twist)
    B = B @ stack.each(X)
    P = p @ B[:, :3, :3].transpose(0, 2, 1) + B[:, None, :3, 3]
    behind = stack.known & (P[..., 2] < NEAREST_M)
    z = np.where(stack.known & ~behind, P[..., 2], 1.0)
    x = np.where(stack.known[..., None], P[..., :2] / z[..., None], 0.0)
    return Seen(p, by_shape, B, P, z, x, behind)


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
    at = seen(stack, X, Y, A, shape, offset_s, moved)
    pixels = stack.camera.with_parameters(parameters).pixels(at.x)
    return at.errors(stack, pixels)


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
    """Residuals and derivatives of a stack at X (T, 4, 4), Y (4, 4), A (I, 4, 4), a camera and shapes (T, 4).

    Of one target they may be (4, 4) and (4,). `moved` (n, 3) is how far its corners are off their places, metres. The
    images were taken `offset_s` after their instants.
    """
    V, n = stack.known.shape
    at = seen(stack, X, Y, A, shape, offset_s, moved)
    x, z = at.x, at.z
    pixels, by_x, by_parameters = pixels_and_derivatives(stack.camera, parameters, x)
    by_P = np.empty((V, n, 2, 3))  # d x / d P = [I, -x] / z
    by_P[..., :2] = by_x
    by_P[..., 2] = -(by_x[..., 0] * x[..., :1] + by_x[..., 1] * x[..., 1:])
    by_P *= (stack.known / z)[..., None, None]
    by_B = np.empty((V, n, 2, 6))
    by_p = (by_P.reshape(V, 2 * n, 3) @ at.B[:, :3, :3]).reshape(V, n, 2, 3)
    by_B[..., 3:] = by_p
    p = at.p[..., None, :]  # row' (omega x p) = omega' (p x row)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        by_B[..., i] = p[..., j] * by_p[..., k] - p[..., k] * by_p[..., j]
    by_parameters *= stack.known[..., None, None]
    return Linear(
        at.errors(stack, pixels),
        by_B.reshape(V, 2 * n, 6),
        by_parameters.reshape(V, 2 * n, -1),
        at.B,
        stack.each(X).reshape(-1, 4, 4),
        at.by_shape,
        stack.twist,
        offset_s,
    )
