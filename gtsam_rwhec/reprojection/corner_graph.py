"""The GTSAM graph of corners: one factor an image, whose rows are computed for all images at once.

Variables

    x, y   poses of targets and sensors on their carriers
    a      the carriers' pose A at an instant, held by its measurement and its noise; absent where A is exact
    k      a camera's parameters, held by a prior; sensors may share a camera
    b      a board's shape, held by a prior; absent where it is not free
    p      how far a board's corners are off their places, held by a prior; absent where they are not free
    t      the offset of a sensor's clock, held by a weak prior; absent where it is not free

GTSAM asks each factor by itself, in any order. All rows are computed when the first factor is asked at new values.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from gtsam_rwhec.geometry.poses import Array
from gtsam_rwhec.reprojection.model import Model, Point


def key_of(letter: str, number: int) -> int:
    """A variable's key."""
    key: int = gtsam.symbol(letter, number)
    return key


@dataclass(eq=False)
class CornerGraph:
    """The graph of a model, with its variables' keys.

    A factor's vector is not the pixel errors but a turn of them, which has the same length: the linear rows of an image
    are as few as its variables have columns.
    """

    model: Model
    start: Point
    graph: gtsam.NonlinearFactorGraph = field(init=False)
    _at: dict[int, Array] = field(init=False, default_factory=dict)
    _point: Point = field(init=False)
    _errors: list[Array] = field(init=False, default_factory=list)
    _triangles: list[tuple[Array, dict[str, slice]]] = field(init=False, default_factory=list)

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
            for v in range(len(stack.instant)):
                self._add_view(s, v)

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

    def _add_view(self, s: int, v: int) -> None:
        stack = self.model.stacks[s]
        key_of_variable = {
            "X": self.x[stack.target],
            "Y": self.y[stack.sensor],
            "camera": self.k[self.model.camera_of[stack.sensor]],
            "A": key_of("a", int(stack.instant[v])),
            "shape": self.b.get(stack.target, 0),
            "time": self.t.get(stack.sensor, 0),
            "corners": self.p.get(stack.target, 0),
        }
        variables = self.model.variables_of(stack)
        width = 12 + len(self.start.cameras[self.model.camera_of[stack.sensor]])
        width += 6 * ("A" in variables) + len(self.model.free_shape(stack.target)) + ("time" in variables)
        width += 3 * len(stack.points) * ("corners" in variables)
        size = min(2 * stack.known.shape[1], width + 1)
        keys = [key_of_variable[name] for name in variables]

        def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any | None) -> NDArray[np.float64]:
            self._come_to(keys, values)
            if jacobians is None:
                length = np.zeros(size)
                length[0] = np.linalg.norm(self._errors[s][v])
                return length
            if not self._triangles:
                self._triangles = self.model.triangles(self._point)
            R, columns = self._triangles[s]
            for i, name in enumerate(variables):
                jacobians[i] = R[v][:, columns[name]]
            residual: NDArray[np.float64] = R[v][:, -1]
            return residual

        self.graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(size), keys, error))

    def _come_to(self, keys: list[int], values: gtsam.Values) -> None:
        """Compute all residuals at the values anew, if one of the variables with these keys has changed."""
        for key in keys:
            known = self._at.get(key)
            if known is None or not np.array_equal(known, _value(values, key)):
                self._point = self.point(values)
                self._at = {key: _value(values, key) for key in self._keys}
                self._errors, self._triangles = self.model.errors(self._point), []
                break


def _value(values: gtsam.Values, key: int) -> Array:
    if gtsam.symbolChr(key) in (ord("k"), ord("b"), ord("t"), ord("p")):
        vector: Array = values.atVector(key)
        return vector
    pose: Array = values.atPose3(key).matrix()
    return pose
