"""What is observed and what is known of it, and a point at which all of it has values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from rwhec_factors import se3
from scipy.linalg.lapack import dpstrf

from gtsam_rwhec.fitting.common_errors import whitened, whitener
from gtsam_rwhec.fitting.corner_residuals import Linear, Places, Seen, Stack, linearised, pixel_errors, seen
from gtsam_rwhec.fitting.fit_options import About
from gtsam_rwhec.fitting.stated_intrinsics import CameraPrior
from gtsam_rwhec.geometry.poses import Array

#: An instant's row that is shorter than this share of its longest is rounding.
NO_ROW = 1e-8
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
    #: Of a bias that all corners of a target share, as the detector finds them, pixels; in the order of the targets.
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
        there = {target for stack in self.stacks for target in stack.targets}
        return tuple(name for name in self.bias_px if name in there)

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
        return whitened(rows, self._whiteners[s]) if self.common else rows

    @cached_property
    def _whiteners(self) -> list[Array]:
        return [whitener(common * root[..., None]) for common, root in zip(self.common, self._roots, strict=True)]

    def linearised(self, stack: Stack, point: Point) -> Linear:
        """Rows of a stack, in pixels; by the numbers of the boards' shapes that are free."""
        rows = linearised(stack, *self._arguments(stack, point))
        return replace(rows, shapes=rows.shapes[..., self.free_shape(stack.targets[0])])

    def by_unknown(self, stack: Stack, rows: Linear) -> dict[str, Array]:
        """Derivatives (V, 2n, m) of a stack's rows by the letter of each unknown but A and single corners."""
        found = {"x": rows.by_X, "y": rows.by_Y, "k": rows.by_camera}
        if stack.targets[0] in self.shape_priors:
            found["b"] = rows.by_shape
        if stack.sensor in self.offset_priors:
            found["t"] = rows.by_time
        return found

    def columns(self, stack: Stack, slots: Mapping[tuple[str, str], slice]) -> np.ndarray:
        """Where in the slots the unknowns of each target are (T, m): those of `by_unknown`, then single corners."""
        of_sensor, found = {"y": stack.sensor, "k": self.camera_of[stack.sensor], "t": stack.sensor}, []
        for letter in "xykbtp":
            names = [(letter, of_sensor.get(letter, target)) for target in stack.targets]
            if names[0] in slots:
                width = slots[names[0]].stop - slots[names[0]].start
                found.append(np.array([slots[name].start for name in names])[:, None] + np.arange(width))
        return np.concatenate(found, axis=1)

    def seen(self, stack: Stack, point: Point) -> Seen:
        """A stack's corners on their way to the camera."""
        X, Y, A, _, shape, offset_s, corners = self._arguments(stack, point)
        return seen(stack, X, Y, A, shape, offset_s, corners)

    def _arguments(self, stack: Stack, point: Point) -> tuple[Array, Array, Array, Array, Array, float, Array | None]:
        camera = point.cameras[self.camera_of[stack.sensor]]
        X, shapes = (np.array([of[target] for target in stack.targets]) for of in (point.X, point.shapes))
        at_s, corners = point.offsets_s.get(stack.sensor, 0.0), point.corners.get(stack.targets[0])
        return X, point.Y[stack.sensor], point.A, camera, shapes, at_s, corners

    @cached_property
    def _roots(self) -> list[Array]:
        return [np.repeat(np.sqrt(weights), 2, axis=1) / self.corner_px for weights in self.weights]

    def sums(self, point: Point) -> Sums:
        """Of all rows, weighted and of unit noise, by the model's `slots`; without A where it is exact."""
        slots = self.slots(point)
        result = Sums.zeros(len(self.A), slots)
        for s, (stack, root) in enumerate(zip(self.stacks, self._roots, strict=True)):
            rows = self.linearised(stack, point)
            J = np.concatenate([*self.by_unknown(stack, rows).values(), rows.by_A], axis=2) * root[..., None]
            every = self._whitened(s, np.concatenate([J, _finite(rows.residual, root)[..., None]], axis=2))
            B = rows.by_corners * root.reshape(*stack.known.shape, 2, 1) if stack.targets[0] in point.corners else None
            of_A = None if self.A_noise is None else every[..., -7:-1]
            places = stack.places(self.columns(stack, slots), len(result.squares))
            result.add(stack, places, Rows(every[..., :-7], B, every[..., -1]), of_A)
        return result

    def slots(self, point: Point) -> dict[tuple[str, str], slice]:
        """The rows of every unknown but A, by letter and name: "x" targets, "y" sensors, and the `vectors`."""
        widths = {("x", name): 6 for name in self.targets} | {("y", name): 6 for name in self.sensors}
        widths |= {at: len(vector) for at, vector in self.vectors(point).items()}
        ends = np.cumsum(list(widths.values())).tolist()
        return {at: slice(end - width, end) for (at, width), end in zip(widths.items(), ends, strict=True)}

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

    def kind_of(self, target: str) -> object:
        """What targets have alike that share a stack: which numbers of their shapes are free; single corners, none."""
        return target if target in self.corner_priors else tuple(self.free_shape(target))

    def free_shape(self, target: str) -> np.ndarray:
        """Which of the four numbers of a board's shape are free."""
        return np.flatnonzero(self.shape_priors.get(target, ()))


def _finite(error: Array, root: Array) -> Array:
    """Weighted errors, finite behind the camera too."""
    return np.asarray(np.where(np.isfinite(error), error, BEHIND) * np.where(np.isfinite(error), root, root > 0.0))


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of V images with n corners: J (V, 2n, m), B (V, n, 2, 3) where corners are free, r (V, 2n)."""

    J: Array
    B: Array | None
    r: Array

    def squares(self, stack: Stack) -> Array:
        """Sums (T, columns, columns) over the images of each target of [J, corners, r]' [J, corners, r]."""
        others = np.concatenate([self.J, self.r[..., None]], axis=2)
        if len(stack.targets) > 1:
            of_targets = (rows.reshape(-1, others.shape[2]) for rows in np.split(others, stack.first[1:]))
            return np.array([rows.T @ rows for rows in of_targets])
        flat = others.reshape(-1, others.shape[2])
        if self.B is None:
            return np.asarray(flat.T @ flat)[None]
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
        ])[None]  # fmt: skip

    def times(self, Q: Array) -> Array:
        """Q' [J, corners, r] of each image (V, q, columns), with Q (V, 2n, q)."""
        Qt = Q.transpose(0, 2, 1)
        parts = [Qt @ self.J, Qt @ self.r[..., None]]
        if self.B is not None:
            V, n = self.B.shape[:2]
            of_corner = Q.reshape(V, n, 2, -1).transpose(0, 1, 3, 2) @ self.B  # (V, n, q, 3)
            parts.insert(1, of_corner.transpose(0, 2, 1, 3).reshape(V, -1, 3 * n))
        return np.concatenate(parts, axis=2)


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over all rows, by the d columns of all unknowns but A, and the residual's, which is the last.

    squares (d + 1, d + 1) are those of all columns; of_A (I, 6, d + 1) the products of A's columns with them, by
    instant, and M (I, 6, 6) those of A's with A's.
    """

    squares: Array
    of_A: Array
    M: Array

    @staticmethod
    def zeros(instants: int, slots: Mapping[tuple[str, str], slice]) -> Sums:
        """Sums of no rows."""
        d = max(at.stop for at in slots.values())
        return Sums(np.zeros((d + 1, d + 1)), np.zeros((instants, 6, d + 1)), np.zeros((instants, 6, 6)))

    def copy(self) -> Sums:
        """The same sums, to add to."""
        return Sums(self.squares.copy(), self.of_A.copy(), self.M.copy())

    def add(self, stack: Stack, places: Places, rows: Rows, J_A: Array | None, sign: float = 1.0) -> None:
        """Add a stack's rows, with those by A, J_A (V, 2n, 6), or without."""
        _add(self.squares, places[0], sign * rows.squares(stack))
        if J_A is not None:
            _add(self.of_A, places[1], sign * rows.times(J_A))
            _add(self.M, places[2], sign * (J_A.transpose(0, 2, 1) @ J_A))

    def few_rows(self) -> tuple[Array, Array, Array]:
        """Rows with these sums: Q'[J, r] (I, 6, d + 1) and Q'J_A (I, 6, 6) of each instant, and one triangle for all.

        With J_A = Q R of an instant's rows, Q'[J_A, J, r] are all rows in which A is. What the other rows add has no A.
        """
        values, vectors = np.linalg.eigh(self.M)
        root = np.sqrt(np.maximum(values, 0.0))
        there = root > NO_ROW * root[:, -1:]
        R = np.where(there, root, 0.0)[..., None] * vectors.transpose(0, 2, 1)
        of_A = (vectors / np.where(there, root, np.inf)[:, None]).transpose(0, 2, 1) @ self.of_A
        flat = of_A.reshape(-1, len(self.squares))
        # a column of zeros stays one
        size = np.sqrt(np.maximum(np.diagonal(self.squares), np.finfo(float).tiny))
        triangle, order, rank, _ = dpstrf(
            (self.squares - flat.T @ flat) / size[:, None] / size, tol=np.finfo(float).eps
        )
        together = np.zeros_like(self.squares)
        together[:rank, order - 1] = np.triu(triangle)[:rank]
        return of_A, R, together * size


def _add(sums: Array, places: np.ndarray, values: Array) -> None:
    """Add values to sums at places of their flat form, which may be there twice."""
    sums += np.bincount(places.ravel(), values.ravel(), sums.size).reshape(sums.shape)


def _by_corner(rows: Array, n: int) -> Array:
    """Rows (V, 2n, columns), or (V, n, 2, columns), as (n, 2V, columns)."""
    V = len(rows)
    result: Array = rows.reshape(V, n, 2, -1).transpose(1, 0, 2, 3).reshape(n, 2 * V, -1)
    return result
