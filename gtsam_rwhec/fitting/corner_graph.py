"""The GTSAM graph of corners: a factor an instant, and one for all images of a pair, computed for all of them at once.

Variables

    x, y   poses of targets and sensors on their carriers
    a      the carriers' pose A at an instant, held by its measurement and its noise; absent where A is exact
    k      a camera's parameters, held by a prior; sensors may share a camera
    b      a board's shape, held by a prior; absent where it is not free
    p      how far a board's corners are off their places, held by a prior; absent where they are not free
    t      the offset of a sensor's clock, held by a weak prior; absent where it is not free

An instant's factor has six linear rows, in which its A is; what the other rows of its images say has no A, and is
summed over all of them in one factor (`Sums.few_rows`). GTSAM asks each factor by itself, in any order: all rows are
computed when the first factor is asked at new values.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from gtsam_rwhec.fitting.corner_model import Model, Point
from gtsam_rwhec.fitting.corner_noise import Noise, Reduced, errors_of_A
from gtsam_rwhec.fitting.joint_covariance import ArrowInverse
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
    rows are as few as can be. Asked without derivatives, the instants' factors have the whole length, or that of all
    images where A is exact.
    """

    model: Model
    start: Point
    graph: gtsam.NonlinearFactorGraph = field(init=False)
    slots: dict[tuple[str, str], slice] = field(init=False)  #: Columns of each variable but those of A
    keys: dict[tuple[str, str], int] = field(init=False)  #: By a variable's letter and name; without those of A
    _at: dict[int, bytes] = field(init=False, default_factory=dict)
    _point: Point = field(init=False)
    #: (I,): the squared length of each instant's errors
    _squares: Array = field(init=False)
    _rows: tuple[Array, Array, Array] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        model, is_exact = self.model, self.model.A_noise is None
        self.slots = model.slots(self.start)
        letters = [letter for letter, _ in self.slots]
        self.keys = {at: key_of(at[0], letters[:i].count(at[0])) for i, at in enumerate(self.slots)}
        self._keys = [*self.keys.values(), *(key_of("a", i) for i in range(0 if is_exact else len(model.A)))]
        self.graph = gtsam.NonlinearFactorGraph()
        self._add_priors()
        self._add_together()
        there = np.zeros((len(model.A), max(at.stop for at in self.slots.values())), dtype=bool)
        for stack in () if is_exact else model.stacks:
            there[stack.instant[:, None], stack.each(model.columns(stack, self.slots))] = True
        for instant in np.flatnonzero(there.any(axis=1)).tolist():
            self._add_instant(instant, [at for at, columns in self.slots.items() if there[instant, columns.start]])

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
        rows = np.concatenate([np.arange(self.slots[at].start, self.slots[at].stop) for at in slots])
        _, reduced, noise = self._reduced(values)
        try:
            inverse, found = self._changed(reduced, noise)
        except np.linalg.LinAlgError:  # inverted all the same, to tell what is not determined
            information = reduced.information(noise)
            size = np.sqrt(np.diagonal(information))
            return (np.linalg.inv(information / size[:, None] / size) / size[:, None] / size)[
                np.ix_(rows, rows)
            ], np.inf
        joint = inverse.at(rows, rows)
        size = np.sqrt(np.diagonal(joint))
        step = found[rows] / size
        return joint, float(np.sqrt(step @ np.linalg.solve(joint / size[:, None] / size, step)))

    def step(self, values: gtsam.Values) -> gtsam.VectorValues:
        """Gauss and Newton's; LinAlgError where there is none."""
        point, reduced, noise = self._reduced(values)
        _, found = self._changed(reduced, noise)
        step = gtsam.VectorValues()
        for at, key in self.keys.items():
            step.insert(key, found[self.slots[at]])
        if self.model.A_noise is not None:
            off_A, turned = errors_of_A(self.model, point)
            change = found[len(reduced.G) :].reshape(-1, 6) * self.model.A_noise - off_A
            for i, moved in enumerate((turned @ change[..., None])[..., 0]):
                step.insert(key_of("a", i), moved)
        return step

    def _reduced(self, values: gtsam.Values) -> tuple[Point, Reduced, Noise]:
        """The sums of unit noise at values, and A's noise."""
        point, S = self.point(values), self.model.A_noise
        return point, Reduced.whitened(self.model, point), Noise(1.0, *(0.0, 0.0) if S is None else S[[0, 3]].tolist())

    @staticmethod
    def _changed(reduced: Reduced, noise: Noise) -> tuple[ArrowInverse, Array]:
        """The covariance of all, and the best change: targets or carriers are eliminated first."""
        sums, inverse, _ = reduced.joint(noise)
        return inverse, reduced.estimate(noise, sums, inverse)[1]

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

    def _add_together(self) -> None:
        """What all rows say without A. Where A is free, the instants' factors have the cost."""
        size = max(at.stop for at in self.slots.values()) + 1

        def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any | None) -> NDArray[np.float64]:
            self._come_to(self._keys, values)
            if jacobians is None:
                length = np.zeros(size)
                length[0] = np.sqrt(self._squares.sum()) if self.model.A_noise is None else 0.0
                return length
            _, _, together = self._rows_there()
            for i, columns in enumerate(self.slots.values()):
                jacobians[i] = together[:, columns]
            return np.asarray(together[:, -1])

        self.graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(size), list(self.keys.values()), error))

    def _add_instant(self, instant: int, names: list[tuple[str, str]]) -> None:
        """The rows that have an instant's A, and the variables that its images see."""
        keys = [*(self.keys[at] for at in names), key_of("a", instant)]

        def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any | None) -> NDArray[np.float64]:
            self._come_to(keys, values)
            if jacobians is None:
                residual = np.zeros(6)
                residual[0] = np.sqrt(self._squares[instant])
                return residual
            of_A, R, _ = self._rows_there()
            for i, at in enumerate(names):
                jacobians[i] = of_A[instant, :, self.slots[at]]
            jacobians[len(names)] = R[instant]
            return np.asarray(of_A[instant, :, -1])

        self.graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6), keys, error))

    def _rows_there(self) -> tuple[Array, Array, Array]:
        """The linear rows at the values last visited."""
        if self._rows is None:
            self._rows = self.model.sums(self._point).few_rows()
        return self._rows

    def _come_to(self, keys: list[int], values: gtsam.Values) -> None:
        """Compute all residuals at the values anew, if one of the variables with these keys has changed."""
        at = self._at
        for key in keys:
            if key not in at or at[key] != _value(values, key):
                self._point = self.point(values)
                self._at = {key: _value(values, key) for key in self._keys}
                self._squares, self._rows = np.zeros(len(self.model.A)), None
                for stack, errors in zip(self.model.stacks, self.model.errors(self._point), strict=True):
                    np.add.at(self._squares, stack.instant, (errors**2).sum(axis=1))
                break


def _value(values: gtsam.Values, key: int) -> bytes:
    """A variable's value: this is asked a hundred thousand times."""
    if key >> LETTER in _VECTORS:
        value: bytes = values.atVector(key).tobytes()
    else:
        value = values.atPose3(key).matrix().tobytes()
    return value
