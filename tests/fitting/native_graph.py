"""The same problem as `CornerGraph`, of GTSAM's own factors: one a corner, for the lens models that GTSAM has.

Its variables are Z = X^-1 and V_i = X^-1 A_i^-1, the carriers' poses seen from the board, tied by A's measurement; the
sensors' poses Y; the cameras; and the board's corners, held by a prior of a nanometre.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gtsam
import gtsam_unstable
import numpy as np
from numpy.typing import NDArray
from rwhec_factors import se3

from gtsam_rwhec.fitting.corner_graph import key_of
from gtsam_rwhec.fitting.corner_model import Model, Point

Array = NDArray[np.float64]
#: GTSAM's calibration of a lens model, by its name and number of coefficients.
KINDS = {("pinhole", 0): "Cal3_S2", ("radtan", 4): "Cal3DS2", ("equidistant", 4): "Cal3Fisheye"}
#: GTSAM's skew is the third of its parameters; here it is zero.
SKEW, SKEW_DEVIATION = 2, 1e-6
POINT_M = 1e-9


@dataclass(eq=False)
class NativeGraph:
    """The graph of a model with one flat board, whose carriers' poses are noisy."""

    model: Model
    start: Point
    graph: gtsam.NonlinearFactorGraph = field(init=False)

    def __post_init__(self) -> None:
        model = self.model
        assert model.A_noise is not None
        assert len(model.targets) == 1
        assert not model.shape_priors
        self.kind = {
            model.camera_of[stack.sensor]: KINDS[stack.camera.model, len(stack.camera.D)] for stack in model.stacks
        }
        self.y = {name: key_of("y", i) for i, name in enumerate(model.sensors)}
        self.k = {name: key_of("k", i) for i, name in enumerate(model.camera_priors)}
        (self.points,) = model.stacks[0].points
        self.graph = gtsam.NonlinearFactorGraph()
        self._add_priors()
        pixel_noise = gtsam.noiseModel.Isotropic.Sigma(2, model.corner_px)
        for stack in model.stacks:
            camera = model.camera_of[stack.sensor]
            factor = getattr(gtsam_unstable, f"ProjectionFactorPPPC{self.kind[camera]}")
            y, k = self.y[stack.sensor], self.k[camera]
            for v, i in enumerate(stack.instant.tolist()):
                for j in np.flatnonzero(stack.known[v]).tolist():
                    self.graph.add(
                        factor(stack.pixels[v, j], pixel_noise, key_of("v", i), y, key_of("p", j), k, True, False)
                    )

    def _add_priors(self) -> None:
        model, noise = self.model, gtsam.noiseModel
        assert model.A_noise is not None
        # V_i = Z (A Expmap(xi))^-1 is off the measured Z A^-1 by Expmap(-Ad_A xi) on the right
        to_left = se3.adjoint(model.A) @ model.to_right * model.A_noise
        for i, (T, covariance) in enumerate(
            zip(se3.inverse(model.A), to_left @ to_left.transpose(0, 2, 1), strict=True)
        ):
            self.graph.add(
                gtsam.BetweenFactorPose3(
                    key_of("z", 0), key_of("v", i), gtsam.Pose3(T), noise.Gaussian.Covariance(covariance)
                )
            )
        for name, key in self.k.items():
            prior = model.camera_priors[name]
            others = np.insert(np.insert(prior.precision, SKEW, 0.0, axis=0), SKEW, 0.0, axis=1)
            others[SKEW, SKEW] = SKEW_DEVIATION**-2
            factor = getattr(gtsam, f"PriorFactor{self.kind[name]}")
            information = noise.Gaussian.Information(others)
            self.graph.add(factor(key, self._calibration(name, prior.mean), information))
        for j, p in enumerate(self.points):
            self.graph.add(gtsam.PriorFactorPoint3(key_of("p", j), p, noise.Isotropic.Sigma(3, POINT_M)))

    def _calibration(self, name: str, parameters: Array) -> Any:
        return getattr(gtsam, self.kind[name])(np.insert(parameters, SKEW, 0.0))

    def values(self, point: Point) -> gtsam.Values:
        """A point as GTSAM's values."""
        values, (X,) = gtsam.Values(), point.X.values()
        values.insert(key_of("z", 0), gtsam.Pose3(se3.inverse(X)))
        for i, A in enumerate(point.A):
            values.insert(key_of("v", i), gtsam.Pose3(se3.inverse(A @ X)))
        for name, key in self.y.items():
            values.insert(key, gtsam.Pose3(point.Y[name]))
        for name, key in self.k.items():
            values.insert(key, self._calibration(name, point.cameras[name]))
        for j, p in enumerate(self.points):
            values.insert(key_of("p", j), p)
        return values

    def point(self, values: gtsam.Values) -> Point:
        """GTSAM's values as a point."""
        Z = values.atPose3(key_of("z", 0)).matrix()
        V = np.array([values.atPose3(key_of("v", i)).matrix() for i in range(len(self.model.A))])
        # the wheel's Cal3Fisheye.vector() and Cal3Unified.vector() leave parameters out, localCoordinates do not
        cameras = {}
        for name, key in self.k.items():
            mean = self.model.camera_priors[name].mean
            found = getattr(values, f"at{self.kind[name]}")(key)
            cameras[name] = mean + np.delete(self._calibration(name, mean).localCoordinates(found), SKEW)
        return Point(
            {self.model.targets[0]: se3.inverse(Z)},
            {name: values.atPose3(key).matrix() for name, key in self.y.items()},
            se3.inverse(V) @ Z,
            cameras,
            self.start.shapes,
        )

    def covariance(self, values: gtsam.Values) -> Array:
        """Of X, the sensors' poses and the cameras' parameters, in this order, all else eliminated."""
        keys = [key_of("z", 0), *self.y.values(), *self.k.values()]
        ordering = gtsam.Ordering()
        for key in keys:
            ordering.push_back(key)
        information, _ = self.graph.linearize(values).marginal(keys).hessian(ordering)
        size = np.sqrt(np.diagonal(information))
        joint = np.linalg.inv(information / size[:, None] / size) / size[:, None] / size
        # X = Z^-1: Z Expmap(d) is X Expmap(-Ad_Z d)
        turn = np.eye(len(joint))
        turn[:6, :6] = -se3.adjoint(values.atPose3(key_of("z", 0)).matrix()[None])[0]
        skews, begin = [], 6 + 6 * len(self.y)
        for name in self.k:
            skews.append(begin + SKEW)
            begin += len(self.model.camera_priors[name].mean) + 1
        rows = np.delete(np.arange(len(joint)), skews)
        turned: Array = (turn @ joint @ turn.T)[np.ix_(rows, rows)]
        return turned
