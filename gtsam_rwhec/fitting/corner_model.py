"""What is observed and what is known of it, and a point at which all of it has values."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from rwhec_factors import se3

from gtsam_rwhec.fitting.common_errors import whitened
from gtsam_rwhec.fitting.corner_residuals import Linear, Seen, Stack, linearised, pixel_errors, seen
from gtsam_rwhec.fitting.fit_options import About
from gtsam_rwhec.fitting.stated_intrinsics import CameraPrior
from gtsam_rwhec.geometry.poses import Array

#: A residual of this many deviations stands for a corner behind its camera: the step is refused, and stays finite.
BEHIND = 1e6


@dataclass(frozen=True, eq=False)
class Point:
    """Values of all variables.

    Poses by name (4, 4), A (I, 4, 4), cameras' parameters and boards' shapes by name; clocks' offsets by sensor, in
    seconds after the instants; how far corners (n, 3) are off their places by target, metres. Sensors and targets that
    are missing have none.
    """

    X: dict[str, Array]
    Y: dict[str, Array]
    A: Array
    cameras: dict[str, Array]
    shapes: dict[str, Array]
    offsets_s: dict[str, float] = field(default_factory=dict)
    corners: dict[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Model:
    """What is observed and what is known of it."""

    stacks: tuple[Stack, ...]
    #: (I, 4, 4): The carriers' poses as measured.
    A: Array
    #: (6,): Standard deviations of A's perturbation [omega, v], rad and m; None: A is exact.
    A_noise: Array | None
    #: The carrier whose axes and origin A's perturbation has: A Expmap(xi), or Expmap(xi) A.
    about: About
    #: The camera of each sensor: several sensors may share one.
    camera_of: dict[str, str]
    #: By camera. A deviation may be infinite.
    camera_priors: dict[str, CameraPrior]
    #: (4,) each. Deviations of a board's shape by target; zero: that number is not free.
    shape_priors: dict[str, Array]
    #: Standard deviation of a corner along each axis.
    corner_px: float
    #: Of each corner's squared residual, by stack.
    weights: tuple[Array, ...]
    #: Deviations, s, of the clocks' offsets that are free, by sensor; their means are zero.
    offset_priors: dict[str, float] = field(default_factory=dict)
    #: Deviations, metres, of corners from their places along each axis, by target whose corners are free.
    corner_priors: dict[str, float] = field(default_factory=dict)
    #: Standard deviation of a corner as it was stated: it counts where corners are too few to tell theirs.
    stated_px: float = 0.1
    #: Of a bias that all corners of a target share, as the detector finds them, pixels.
    bias_px: dict[str, float] = field(default_factory=dict)
    #: (V, 2n, k) each. One deviation of what the corners of an image share, pixels, by stack; empty: nothing.
    common: tuple[Array, ...] = ()

    @property
    def to_right(self) -> Array:
        """The matrices (I, 6, 6) that turn A's perturbations into right ones."""
        if self.about == "targetcarrier":
            return np.broadcast_to(np.eye(6), (len(self.A), 6, 6))
        return se3.adjoint(se3.inverse(self.A))

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the targets."""
        return tuple(dict.fromkeys(stack.target for stack in self.stacks))

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return tuple(dict.fromkeys(stack.sensor for stack in self.stacks))

    def errors(self, point: Point) -> list[Array]:
        """Residuals (V, 2n) of every stack, weighted, over the corners' deviation."""
        return [
            self._whitened(s, _finite(pixel_errors(stack, *self._arguments(stack, point)), root)[..., None])[..., 0]
            for s, (stack, root) in enumerate(zip(self.stacks, self._roots, strict=True))
        ]

    def of_instants(self, which: np.ndarray) -> Model:
        """The model of some instants' images (I,), with all frames' priors."""
        there = [which[stack.instant] for stack in self.stacks]
        kept = [s for s, at in enumerate(there) if at.any()]
        return replace(
            self,
            stacks=tuple(self.stacks[s].selected(there[s]) for s in kept),
            weights=tuple(self.weights[s][there[s]] for s in kept),
            common=tuple(self.common[s][there[s]] for s in kept) if self.common else (),
        )

    def _whitened(self, s: int, rows: Array) -> Array:
        """Weighted rows (V, 2n, m) of a stack, of unit noise."""
        return whitened(rows, self.common[s] * self._roots[s][..., None]) if self.common else rows

    def linearised(self, stack: Stack, point: Point) -> Linear:
        """Rows of a stack, in pixels; by the numbers of the board's shape that are free."""
        rows = linearised(stack, *self._arguments(stack, point))
        return replace(rows, shapes=rows.shapes[..., self.free_shape(stack.target)])

    def by_unknown(self, stack: Stack, rows: Linear) -> dict[tuple[str, str], Array]:
        """Derivatives (V, 2n, m) of a stack's rows by letter and name of each unknown but A and single corners."""
        found = {("x", stack.target): rows.by_X, ("y", stack.sensor): rows.by_Y}
        found["k", self.camera_of[stack.sensor]] = rows.by_camera
        if stack.target in self.shape_priors:
            found["b", stack.target] = rows.by_shape
        if stack.sensor in self.offset_priors:
            found["t", stack.sensor] = rows.by_time
        return found

    def seen(self, stack: Stack, point: Point) -> Seen:
        """A stack's corners on their way to the camera."""
        X, Y, A, _, shape, offset_s, corners = self._arguments(stack, point)
        return seen(stack, X, Y, A, shape, offset_s, corners)

    def _arguments(self, stack: Stack, point: Point) -> tuple[Array, Array, Array, Array, Array, float, Array | None]:
        camera = point.cameras[self.camera_of[stack.sensor]]
        poses = point.X[stack.target], point.Y[stack.sensor], point.A
        of_board = point.shapes[stack.target], point.offsets_s.get(stack.sensor, 0.0), point.corners.get(stack.target)
        return *poses, camera, *of_board

    @cached_property
    def _roots(self) -> list[Array]:
        return [np.repeat(np.sqrt(weights), 2, axis=1) / self.corner_px for weights in self.weights]

    def few_rows(self, point: Point) -> list[FewRows]:
        """Rows of every stack with the same cost and the same information as all of them, by stack."""
        result = []
        for s, (stack, root) in enumerate(zip(self.stacks, self._roots, strict=True)):
            rows = self.linearised(stack, point)
            variables = self.variables_of(stack)
            blocks = {name: getattr(rows, f"by_{name}") for name in variables if name not in ("corners", "A")}
            has = {name: name in variables for name in ("corners", "A")}
            number = [block.shape[2] for block in blocks.values()] + [3 * len(stack.points)] * has["corners"]
            ends = np.cumsum(number).tolist()
            columns = {name: slice(a, b) for name, a, b in zip(variables, [0, *ends], ends, strict=False)}
            J = self._whitened(s, np.concatenate(list(blocks.values()), axis=2) * root[..., None])
            B = rows.by_corners * root.reshape(*stack.known.shape, 2, 1) if has["corners"] else None
            J_A = self._whitened(s, rows.by_A * root[..., None]) if has["A"] else None
            r = self._whitened(s, _finite(rows.residual, root)[..., None])[..., 0]
            result.append(FewRows(*few_rows(Rows(J, B, r), J_A), columns))
        return result

    def vectors(self, point: Point) -> dict[tuple[str, str], Array]:
        """What is not known besides poses, by letter and name: "k" cameras, "b" shapes, "t" clocks, "p" corners."""
        return (
            {("k", name): point.cameras[name] for name in self.camera_priors}
            | {("b", name): point.shapes[name][self.free_shape(name)] for name in self.shape_priors}
            | {("t", name): np.array([point.offsets_s.get(name, 0.0)]) for name in self.offset_priors}
            | {("p", name): point.corners[name].ravel() for name in self.corner_priors}
        )

    def priors(self, point: Point) -> dict[tuple[str, str], CameraPrior]:
        """The prior of each of the `vectors`."""
        deviations: dict[tuple[str, str], float | Array] = {}
        deviations |= {("t", name): in_s for name, in_s in self.offset_priors.items()}
        deviations |= {("p", name): in_m for name, in_m in self.corner_priors.items()}
        deviations |= {("b", name): of[self.free_shape(name)] for name, of in self.shape_priors.items()}
        found = {("k", name): of for name, of in self.camera_priors.items()}
        vectors = self.vectors(point)
        for at, of in deviations.items():
            found[at] = CameraPrior(np.zeros(len(vectors[at])), of * np.ones(len(vectors[at])))
        return {at: found[at] for at in vectors}

    def free_shape(self, target: str) -> np.ndarray:
        """Which of the four numbers of a board's shape are free."""
        return np.flatnonzero(self.shape_priors.get(target, ()))

    def variables_of(self, stack: Stack) -> tuple[str, ...]:
        """X, Y, camera, and shape, time, corners and A where they are free, in this order."""
        free = [
            ("shape", stack.target in self.shape_priors),
            ("time", stack.sensor in self.offset_priors),
            ("corners", stack.target in self.corner_priors),
            ("A", self.A_noise is not None),
        ]
        return ("X", "Y", "camera", *(name for name, is_free in free if is_free))


@dataclass(frozen=True, eq=False)
class FewRows:
    """The rows of a stack's images that have A, and one triangle of the rest for all of them."""

    #: (V, 6, columns): Of each image, by all unknowns but A; the last column is the residual. V = 0 where A is exact.
    of_images: Array
    #: (V, 6, 6)
    by_A: Array
    #: (columns, columns): Of all images.
    together: Array
    #: Of each variable but A.
    columns: dict[str, slice]


def _finite(error: Array, root: Array) -> Array:
    """Weighted errors, finite behind the camera too."""
    return np.asarray(np.where(np.isfinite(error), error, BEHIND) * np.where(np.isfinite(error), root, root > 0.0))


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of V images with n corners: J (V, 2n, m), B (V, n, 2, 3) where corners are free, r (V, 2n)."""

    J: Array
    B: Array | None
    r: Array

    def squares(self) -> Array:
        """The sum over all images of [J, corners, r]' [J, corners, r]."""
        others = np.concatenate([self.J, self.r[..., None]], axis=2)
        flat = others.reshape(-1, others.shape[2])
        if self.B is None:
            return np.asarray(flat.T @ flat)
        n, m = self.B.shape[1], self.J.shape[2]
        Bt = _by_corner(self.B, n).transpose(0, 2, 1)
        own = np.zeros((n, 3, n, 3))
        own[np.arange(n), :, np.arange(n)] = Bt @ _by_corner(self.B, n)
        mixed = (Bt @ _by_corner(others, n)).reshape(3 * n, m + 1)
        both, of_others = mixed[:, :m], flat.T @ flat
        return np.block([
            [of_others[:m, :m], both.T, of_others[:m, m:]],
            [both, own.reshape(3 * n, 3 * n), mixed[:, m:]],
            [of_others[m:, :m], mixed[:, m:].T, of_others[m:, m:]],
        ])  # fmt: skip

    def times(self, Q: Array) -> Array:
        """Q' [J, corners, r] of each image (V, q, columns), with Q (V, 2n, q)."""
        Qt = Q.transpose(0, 2, 1)
        parts = [Qt @ self.J, Qt @ self.r[..., None]]
        if self.B is not None:
            V, n = self.B.shape[:2]
            of_corner = Q.reshape(V, n, 2, -1).transpose(0, 1, 3, 2) @ self.B  # (V, n, q, 3)
            parts.insert(1, of_corner.transpose(0, 2, 1, 3).reshape(V, -1, 3 * n))
        return np.concatenate(parts, axis=2)


def few_rows(rows: Rows, J_A: Array | None) -> tuple[Array, Array, Array]:
    """Rows with the same squares and products as those of all images, A's columns J_A (V, 2n, 6) among them.

    With J_A = Q R of each image, Q'[J_A, J, corners, r] are all rows in which A is. What the other rows add to the sums
    has no A: one triangle for all images together. Returned are Q'[J, corners, r] (V, 6, columns), R (V, 6, 6), both
    with V = 0 where A is none of the unknowns, and the triangle (columns, columns).
    """
    total = rows.squares()
    columns = len(total)
    Q, R = (np.zeros((0, 6, columns)), np.zeros((0, 6, 6))) if J_A is None else np.linalg.qr(J_A)
    of_A = rows.times(Q) if J_A is not None else Q
    flat = of_A.reshape(-1, columns)
    # a column of zeros stays one
    size = np.sqrt(np.maximum(np.diagonal(total), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh((total - flat.T @ flat) / size[:, None] / size)
    together: Array = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * size
    return of_A, R, together


def _by_corner(rows: Array, n: int) -> Array:
    """Rows (V, 2n, columns), or (V, n, 2, columns), as (n, 2V, columns)."""
    V = len(rows)
    result: Array = rows.reshape(V, n, 2, -1).transpose(1, 0, 2, 3).reshape(n, 2 * V, -1)
    return result
