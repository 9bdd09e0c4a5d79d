"""The GTSAM graph of corners: a factor an image, and one for all images of a pair, computed for all of them at once.

Variables

    x, y   poses of targets and sensors on their carriers
    a      the carriers' pose A at an instant, held by its measurement and its noise; absent where A is exact
    k      a camera's parameters, held by a prior; sensors may share a camera
    b      a board's shape, held by a prior; absent where it is not free
    p      how far a board's corners are off their places, held by a prior; absent where they are not free
    t      the offset of a sensor's clock, held by a weak prior; absent where it is not free

An image's factor has the six linear rows in which its A is; what the other rows say has no A, and is summed over all
images of a target by a sensor (`row_sums`). GTSAM asks each factor by itself, in any order: all rows are computed when
the first factor is asked at new values.
"""

from __future__ import annotations

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
    _at: dict[int, bytes] = field(init=False, default_factory=dict)
    _point: Point = field(init=False)
    _errors: list[Array] = field(init=False, default_factory=list)
    _rows: list[FewRows] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        model = self.model
        self.x = {name: key_of("x", i) for i, name in enumerate(model.targets)}
        self.y = {name: key_of("y", i) for i, name in enumerate(model.sensors)}
        self.k = {name: key_of("k", i) for i, name in enumerate(model.camera_priors)}
        self.b = {name: key_of("b", i) for i, name in enumerate(model.shape_priors)}
        self.t = {name: key_of("t", i) for i, name in enumerate(model.offset_priors)}
        self.p = {name: key_of("p", i) for i, name in enumerate(model.corner_priors)}
        carriers = range(len(model.A)) if model.A_noise is not None else ()
        self._keys = [
            *self.x.values(), *self.y.values(), *self.k.values(), *self.b.values(), *self.t.values(),
            *self.p.values(), *(key_of("a", i) for i in carriers),
        ]  # fmt: skip
        self.graph = gtsam.NonlinearFactorGraph()
        self._add_priors()
        for s, stack in enumerate(model.stacks):
            self._add_pair(s)
            for v in range(len(stack.instant) if model.A_noise is not None else 0):
                self._add_image(s, v)

    def values(self, point: Point) -> gtsam.Values:
        """A point as GTSAM's values."""
        values = gtsam.Values()
        for keys, poses in ((self.x, point.X), (self.y, point.Y)):
            for name, key in keys.items():
                values.insert(key, gtsam.Pose3(poses[name]))
        if self.model.A_noise is not None:
            for i, T in enumerate(point.A):
                values.insert(key_of("a", i), gtsam.Pose3(T))
        for name, key in self.k.items():
            values.insert(key, np.asarray(point.cameras[name], dtype=float))
        for name, key in self.b.items():
            values.insert(key, point.shapes[name][self.model.free_shape(name)])
        for name, key in self.t.items():
            values.insert(key, np.array([point.offsets_s.get(name, 0.0)]))
        for name, key in self.p.items():
            values.insert(key, point.corners[name].ravel())
        return values

    def point(self, values: gtsam.Values) -> Point:
        """GTSAM's values as a point."""
        A = self.model.A
        if self.model.A_noise is not None:
            A = np.array([values.atPose3(key_of("a", i)).matrix() for i in range(len(A))])
        return Point(
            {name: values.atPose3(key).matrix() for name, key in self.x.items()},
            {name: values.atPose3(key).matrix() for name, key in self.y.items()},
            A,
            {name: values.atVector(key) for name, key in self.k.items()},
            {name: self._shape(values, name) for name in self.start.shapes},
            self.start.offsets_s | {name: float(values.atVector(key)[0]) for name, key in self.t.items()},
            {name: values.atVector(key).reshape(-1, 3) for name, key in self.p.items()},
        )

    def _shape(self, values: gtsam.Values, name: str) -> Array:
        shape = self.start.shapes[name].copy()
        if name in self.b:
            shape[self.model.free_shape(name)] = values.atVector(self.b[name])
        return shape

    def covariance(self, values: gtsam.Values, slots: Mapping[tuple[str, str], slice]) -> tuple[Array, float]:
        """The covariance (d, d) of the unknowns in `slots`, all else eliminated; and how far off the optimum is.

        That is the length of one more Gauss-Newton step in deviations. Slots have ("x", target), ("y", sensor),
        ("k", camera), ("b", target), ("t", sensor) and ("p", target).
        """
        linear = self.graph.linearize(values)
        of_letter = {"x": self.x, "y": self.y, "k": self.k, "b": self.b, "t": self.t, "p": self.p}
        keys = [of_letter[letter][name] for letter, name in slots]
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
        for name, key in self.k.items():
            mean, deviation = model.camera_priors[name]
            # an infinite deviation is a weight of zero
            self.graph.add(gtsam.PriorFactorVector(key, mean, gtsam.noiseModel.Diagonal.Precisions(deviation**-2.0)))
        for name, key in self.b.items():
            deviation = model.shape_priors[name][model.free_shape(name)]
            noise = gtsam.noiseModel.Diagonal.Sigmas(deviation)
            self.graph.add(gtsam.PriorFactorVector(key, np.zeros(len(deviation)), noise))
        for name, key in self.t.items():
            noise = gtsam.noiseModel.Isotropic.Sigma(1, model.offset_priors[name])
            self.graph.add(gtsam.PriorFactorVector(key, np.zeros(1), noise))
        for name, key in self.p.items():
            number = self.start.corners[name].size
            noise = gtsam.noiseModel.Isotropic.Sigma(number, model.corner_priors[name])
            self.graph.add(gtsam.PriorFactorVector(key, np.zeros(number), noise))

    def _variables_of(self, s: int) -> dict[str, int]:
        """The keys of a stack's variables by their names in `Model`, without A."""
        stack = self.model.stacks[s]
        keys = {
            "X": self.x[stack.target],
            "Y": self.y[stack.sensor],
            "camera": self.k[self.model.camera_of[stack.sensor]],
            "shape": self.b.get(stack.target, 0),
            "time": self.t.get(stack.sensor, 0),
            "corners": self.p.get(stack.target, 0),
        }
        return {name: keys[name] for name in self.model.variables_of(stack) if name != "A"}

    def _add_pair(self, s: int) -> None:
        """What a stack's rows say without A. Where A is free, its images' factors have the cost."""
        variables = self._variables_of(s)
        size = self._columns(s) + 1
        exact = self.model.A_noise is None

        def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any | None) -> NDArray[np.float64]:
            self._come_to(self._keys, values)
            if jacobians is None:
                length = np.zeros(size)
                length[0] = np.linalg.norm(self._errors[s]) if exact else 0.0
                return length
            rows = self._rows_there()[s]
            for i, name in enumerate(variables):
                jacobians[i] = rows.together[:, rows.columns[name]]
            return np.asarray(rows.together[:, -1])

        self.graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(size), list(variables.values()), error))

    def _add_image(self, s: int, v: int) -> None:
        variables = self._variables_of(s)
        keys = [*variables.values(), key_of("a", int(self.model.stacks[s].instant[v]))]

        def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any | None) -> NDArray[np.float64]:
            self._come_to(keys, values)
            if jacobians is None:
                length = np.zeros(6)
                length[0] = np.linalg.norm(self._errors[s][v])
                return length
            rows = self._rows_there()[s]
            for i, name in enumerate(variables):
                jacobians[i] = rows.of_images[v][:, rows.columns[name]]
            jacobians[len(variables)] = rows.by_A[v]
            return np.asarray(rows.of_images[v][:, -1])

        self.graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6), keys, error))

    def _columns(self, s: int) -> int:
        """How many columns a stack's variables have without A."""
        stack, start = self.model.stacks[s], self.start
        numbers = {
            "camera": len(start.cameras[self.model.camera_of[stack.sensor]]),
            "shape": len(self.model.free_shape(stack.target)),
            "time": 1,
            "corners": 3 * len(stack.points),
        }
        return sum(numbers.get(name, 6) for name in self._variables_of(s))

    def _rows_there(self) -> list[FewRows]:
        """The linear rows at the values that were come to."""
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
                self._errors, self._rows = self.model.errors(self._point), []
                break


def _value(values: gtsam.Values, key: int) -> bytes:
    """A variable's value: this is asked a hundred thousand times."""
    if key >> LETTER in _VECTORS:
        value: bytes = values.atVector(key).tobytes()
    else:
        value = values.atPose3(key).matrix().tobytes()
    return value
