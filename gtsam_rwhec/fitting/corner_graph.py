"""The GTSAM graph of corners: a factor an instant, and one for all images of a pair, computed for all of them at once.

Variables

    x, y   poses of targets and sensors on their carriers
    a      the carriers' pose A at an instant, held by its measurement and its noise; absent where A is exact
    k      a camera's parameters, held by a prior; sensors may share a camera
    b      a board's shape, held by a prior; absent where it is not free
    p      how far a board's corners are off their places, held by a prior; absent where they are not free
    t      the offset of a sensor's clock, held by a weak prior; absent where it is not free

An instant's factor has of each of its images the six linear rows in which A is; what the other rows say has no A, and
is summed over all images of a target by a sensor (`row_sums`). GTSAM asks each factor by itself, in any order: all rows
are computed when the first factor is asked at new values. It costs much to ask a factor in Python: images share one.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from gtsam_rwhec.fitting.corner_model import FewRows, Model, Point
from gtsam_rwhec.geometry.poses import Array

#: A symbol's letter is in the bits of its key from this one on.
LETTER = 56
#: Letters of the variables that are vectors; the others are poses.
_VECTORS = frozenset(map(ord, "kbtp"))
#: A factor has at most so many images of an instant: most of its derivatives are zeros, and they are stored.
AT_ONCE = 32


def key_of(letter: str, number: int) -> int:
    """A variable's key."""
    key: int = gtsam.symbol(letter, number)
    return key


@dataclass(eq=False)
class CornerGraph:
    """The graph of a model, with its variables' keys.

    A factor's vector is not the pixel errors but a turn of them: all factors together have their length, and the linear
    rows are as few as can be. Asked without derivatives, the pair's factor has the whole length.
    """

    model: Model
    start: Point
    graph: gtsam.NonlinearFactorGraph = field(init=False)
    keys: dict[tuple[str, str], int] = field(init=False)  #: By a variable's letter and name; without those of A
    _at: dict[int, bytes] = field(init=False, default_factory=dict)
    _point: Point = field(init=False)
    #: (V,) of each stack: the squared length of each image's errors
    _squares: list[Array] = field(init=False, default_factory=list)
    _rows: list[FewRows] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        model = self.model
        vectors = model.vectors(self.start)
        names = [*(("x", name) for name in model.targets), *(("y", name) for name in model.sensors), *vectors]
        letters = [letter for letter, _ in names]
        self.keys = {at: key_of(at[0], letters[:i].count(at[0])) for i, at in enumerate(names)}
        self._widths = {at: len(vectors.get(at, np.zeros(6))) for at in names}
        carriers = range(len(model.A)) if model.A_noise is not None else ()
        self._keys = [*self.keys.values(), *(key_of("a", i) for i in carriers)]
        self.graph = gtsam.NonlinearFactorGraph()
        self._add_priors()
        images: dict[int, list[tuple[int, int]]] = defaultdict(list)
        for s, stack in enumerate(model.stacks):
            self._add_pair(s)
            for v, instant in enumerate(stack.instant.tolist() if model.A_noise is not None else ()):
                images[instant].append((s, v))
        for instant, of_instant in images.items():
            for first in range(0, len(of_instant), AT_ONCE):
                self._add_images(instant, of_instant[first : first + AT_ONCE])

    def values(self, point: Point) -> gtsam.Values:
        """A point as GTSAM's values."""
        values = gtsam.Values()
        for letter, poses in (("x", point.X), ("y", point.Y)):
            for name, T in poses.items():
                values.insert(self.keys[letter, name], gtsam.Pose3(T))
        if self.model.A_noise is not None:
            for i, T in enumerate(point.A):
                values.insert(key_of("a", i), gtsam.Pose3(T))
        for at, value in self.model.vectors(point).items():
            values.insert(self.keys[at], np.asarray(value, dtype=float))
        return values

    def point(self, values: gtsam.Values) -> Point:
        """GTSAM's values as a point."""
        start = self.start
        found: dict[str, dict[str, Array]] = {letter: {} for letter in "xykbtp"}
        for (letter, name), key in self.keys.items():
            found[letter][name] = values.atPose3(key).matrix() if letter in "xy" else values.atVector(key)
        A = self.model.A
        if self.model.A_noise is not None:
            A = np.array([values.atPose3(key_of("a", i)).matrix() for i in range(len(A))])
        shapes = {name: shape.copy() for name, shape in start.shapes.items()}
        for name, free in found["b"].items():
            shapes[name][self.model.free_shape(name)] = free
        offsets_s = start.offsets_s | {name: float(offset[0]) for name, offset in found["t"].items()}
        corners = {name: off.reshape(-1, 3) for name, off in found["p"].items()}
        return Point(found["x"], found["y"], A, found["k"], shapes, offsets_s, corners)

    def covariance(self, values: gtsam.Values, slots: Mapping[tuple[str, str], slice]) -> tuple[Array, float]:
        """The covariance (d, d) of the unknowns in `slots`, all else eliminated; and how far off the optimum is.

        That is the length of one more Gauss-Newton step in deviations. Slots have ("x", target), ("y", sensor),
        ("k", camera), ("b", target), ("t", sensor) and ("p", target).
        """
        linear = self.graph.linearize(values)
        keys = [self.keys[at] for at in slots]
        marginal = linear.marginal(keys)
        ordering = gtsam.Ordering()
        for key in keys:
            ordering.push_back(key)
        information, gradient = marginal.hessian(ordering)
        size = np.sqrt(np.diagonal(information))
        inverse = np.linalg.inv(information / size[:, None] / size) / size[:, None] / size
        joint: Array = 0.5 * (inverse + inverse.T)
        return joint, float(np.sqrt(gradient @ joint @ gradient))

    def _add_priors(self) -> None:
        model = self.model
        if model.A_noise is not None:
            columns = model.to_right * model.A_noise
            for i, (T, covariance) in enumerate(zip(model.A, columns @ columns.transpose(0, 2, 1), strict=True)):
                noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
                self.graph.add(gtsam.PriorFactorPose3(key_of("a", i), gtsam.Pose3(T), noise))
        for at, prior in model.priors(self.start).items():
            # an infinite deviation is a weight of zero, and small ones are no constraints either
            noise = gtsam.noiseModel.Gaussian.SqrtInformation(prior.root, False)
            self.graph.add(gtsam.PriorFactorVector(self.keys[at], prior.mean, noise))
            if np.isfinite(prior.aspect):
                rows = np.zeros((len(prior.mean), len(prior.mean)))
                rows[0] = prior.tie
                noise = gtsam.noiseModel.Gaussian.SqrtInformation(rows)
                self.graph.add(gtsam.PriorFactorVector(self.keys[at], prior.mean, noise))

    def _variables_of(self, s: int) -> dict[str, tuple[str, str]]:
        """The letters and names of a stack's variables by their names in `Model`, without A."""
        stack = self.model.stacks[s]
        names = {
            "X": ("x", stack.target),
            "Y": ("y", stack.sensor),
            "camera": ("k", self.model.camera_of[stack.sensor]),
            "shape": ("b", stack.target),
            "time": ("t", stack.sensor),
            "corners": ("p", stack.target),
        }
        return {name: names[name] for name in self.model.variables_of(stack) if name != "A"}

    def _add_pair(self, s: int) -> None:
        """What a stack's rows say without A. Where A is free, its images' factors have the cost."""
        variables = self._variables_of(s)
        size = sum(self._widths[at] for at in variables.values()) + 1
        exact = self.model.A_noise is None

        def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any | None) -> NDArray[np.float64]:
            self._come_to(self._keys, values)
            if jacobians is None:
                length = np.zeros(size)
                length[0] = np.sqrt(self._squares[s].sum()) if exact else 0.0
                return length
            rows = self._rows_there()[s]
            for i, name in enumerate(variables):
                jacobians[i] = rows.together[:, rows.columns[name]]
            return np.asarray(rows.together[:, -1])

        keys = [self.keys[at] for at in variables.values()]
        self.graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(size), keys, error))

    def _add_images(self, instant: int, images: list[tuple[int, int]]) -> None:
        """One factor for images (s, v) of an instant."""
        variables = [self._variables_of(s) for s, _ in images]
        names = list(dict.fromkeys(at for of_image in variables for at in of_image.values()))
        places = [[(names.index(at), name) for name, at in of_image.items()] for of_image in variables]
        keys, widths = [*(self.keys[at] for at in names), key_of("a", instant)], [self._widths[at] for at in names]
        size = 6 * len(images)

        def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any | None) -> NDArray[np.float64]:
            self._come_to(keys, values)
            residual = np.zeros(size)
            if jacobians is None:
                residual[0] = np.sqrt(sum(self._squares[s][v] for s, v in images))
                return residual
            blocks, by_A = [np.zeros((size, width)) for width in widths], np.zeros((size, 6))
            for j, (s, v) in enumerate(images):
                rows, own = self._rows_there()[s], slice(6 * j, 6 * j + 6)
                of_image = rows.of_images[v]
                for i, name in places[j]:
                    blocks[i][own] = of_image[:, rows.columns[name]]
                by_A[own], residual[own] = rows.by_A[v], of_image[:, -1]
            for i, block in enumerate([*blocks, by_A]):
                jacobians[i] = block
            return residual

        self.graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(size), keys, error))

    def _rows_there(self) -> list[FewRows]:
        """The linear rows at the values last visited."""
        if not self._rows:
            self._rows = self.model.few_rows(self._point)
        return self._rows

    def _come_to(self, keys: list[int], values: gtsam.Values) -> None:
        """Compute all residuals at the values anew, if one of the variables with these keys has changed."""
        at = self._at
        for key in keys:
            if key not in at or at[key] != _value(values, key):
                self._point = self.point(values)
                self._at = {key: _value(values, key) for key in self._keys}
                self._squares, self._rows = [(e**2).sum(axis=1) for e in self.model.errors(self._point)], []
                break


def _value(values: gtsam.Values, key: int) -> bytes:
    """A variable's value: this is asked a hundred thousand times."""
    if key >> LETTER in _VECTORS:
        value: bytes = values.atVector(key).tobytes()
    else:
        value = values.atPose3(key).matrix().tobytes()
    return value
