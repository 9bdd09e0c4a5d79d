"""One measurement B = T_sensor_target as a factor, whatever predicts it: the residuals, and how they are put together.

Every factor of one measurement predicts P = T_sensor_target (true metres) from its variables, and compares it with B,
whose translation is scale times the true one:

- geodesic: Log(B^-1 S(P)), S(R, t) = (R, scale t); (6,), rotation (rad) first. What a right perturbation of B would
  have to be for the equation to hold: any 6 x 6 covariance of B, in GTSAM's order, is honoured as it is.
- chordal: R_Y [vec(R_P - R_B), scale t_P - t_B]; (12,), columns of the rotation first. With isotropic noise its cost is
  that of the certified solution (RWHEC paper, eq. 18).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import gtsam
import numpy as np

from rwhec_factors import noise_models
from rwhec_factors.se3 import Array, hat
from rwhec_factors.values import name_of, number_of

Residual = Literal["geodesic", "chordal"]

#: -hat(e_1), -hat(e_2), -hat(e_3), stacked: (hat(omega) e_i = -hat(e_i) omega).
_COLUMNS = -hat(np.eye(3))


@dataclass(frozen=True)
class Prediction:
    """B as the variables have it.

    Attributes
    ----------
    pose : gtsam.Pose3
        P = T_sensor_target, true metres.
    sensor : gtsam.Pose3
        Y, whose axes the chordal residual is in.
    jacobians : list of arrays
        Of P's right perturbation by each variable: (6, 6) by a pose's right perturbation, (6, 1) by a number; in the
        order of the factor's keys, the scale's left out. Empty where none were asked for.
    """

    pose: gtsam.Pose3
    sensor: gtsam.Pose3
    jacobians: list[Array]


Predict = Callable[[gtsam.Values, bool], Prediction]


def measurement_factor(
    keys: list[int],
    sensor_key: int,
    B: gtsam.Pose3,
    noise: gtsam.noiseModel.Base,
    predict: Predict,
    scale_key: int | None,
    residual: Residual,
) -> gtsam.CustomFactor:
    """A factor of one measurement.

    Parameters
    ----------
    keys : list of int
        Of the variables that ``predict`` reads, in the order of its Jacobians.
    sensor_key : int
        Which of them is Y.
    B : gtsam.Pose3
    noise : gtsam.noiseModel.Base
        Of B's right perturbation, dimension 6; robust ones too.
    predict : callable
        Values and whether Jacobians are wanted -> Prediction.
    scale_key : int or None
        Key of a 1-vector; the last key of the factor.
    residual : "geodesic" or "chordal"

    Raises
    ------
    TypeError, ValueError
        For what is no pose, noise that cannot be honoured, keys that are not all different, an unknown residual.
    """
    check_pose(B, "B")
    if residual not in get_args(Residual):
        raise ValueError(f"residual={residual!r} is not one of {', '.join(map(repr, get_args(Residual)))}")
    model = noise_models.checked(noise, 6, "B (its right perturbation)")
    if residual == "chordal":
        model = noise_models.chordal(model, "B")
    keys = check_keys([*keys, *([] if scale_key is None else [scale_key])])
    turned_by = keys.index(sensor_key)
    B_inverse, R_B, t_B = B.inverse(), B.rotation().matrix(), B.translation()

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Any] | None) -> Array:
        wanted = jacobians is not None
        scale = 1.0 if scale_key is None else number_of(values, scale_key, "the scale (measured / true length)")
        prediction = predict(values, wanted)
        if residual == "geodesic":
            value, by_pose, by_scale = geodesic(prediction.pose, B_inverse, scale, wanted)
        else:
            R_Y = prediction.sensor.rotation().matrix()
            value, by_pose, by_scale, turning = chordal(prediction.pose, R_B, t_B, R_Y, scale, wanted)
        if jacobians is not None:
            for i, block in enumerate(prediction.jacobians):
                jacobians[i] = np.asfortranarray(by_pose @ block)
            if residual == "chordal":
                jacobians[turned_by] = np.asfortranarray(jacobians[turned_by] + turning)
            if scale_key is not None:
                jacobians[len(keys) - 1] = by_scale[:, None]
        return value

    return gtsam.CustomFactor(model, keys, error)


def geodesic(P: gtsam.Pose3, B_inverse: gtsam.Pose3, scale: float, wanted: bool) -> tuple[Array, Array, Array]:
    """Log(B^-1 S(P)) (6,), its derivatives by P's right perturbation (6, 6) and by the scale (6,), if wanted."""
    scaled = P if scale == 1.0 else gtsam.Pose3(P.rotation(), scale * P.translation())
    value: Array = gtsam.Pose3.Logmap(B_inverse.compose(scaled))
    if not wanted:
        return value, _NOTHING, _NOTHING
    # Log(E Expmap(d)) = e + Jr^-1(e) d; S(P Expmap([w, v])) = S(P) Expmap([w, scale v]); dS/dscale is v = R' t.
    inverse_jacobian = gtsam.Pose3.LogmapDerivative(value)
    by_pose = inverse_jacobian * np.r_[1.0, 1.0, 1.0, scale, scale, scale]
    return value, by_pose, inverse_jacobian[:, 3:] @ P.rotation().unrotate(P.translation())


def chordal(
    P: gtsam.Pose3, R_B: Array, t_B: Array, R_Y: Array, scale: float, wanted: bool
) -> tuple[Array, Array, Array, Array]:
    """R_Y [R_P - R_B, scale t_P - t_B] (12,); by P (12, 6), by the scale (12,), and by R_Y's own turning (12, 6)."""
    R_P, t_P = P.rotation().matrix(), P.translation()
    columns = np.column_stack([R_P - R_B, scale * t_P - t_B])  # (3, 4)
    value: Array = (R_Y @ columns).ravel(order="F")
    if not wanted:
        return value, _NOTHING, _NOTHING, _NOTHING
    turned = R_Y @ R_P
    by_pose, turning, by_scale = np.zeros((12, 6)), np.zeros((12, 6)), np.zeros(12)
    by_pose[:9, :3] = (turned @ _COLUMNS).reshape(9, 3)
    by_pose[9:, 3:] = scale * turned
    turning[:, :3] = (-R_Y @ hat(columns.T)).reshape(12, 3)
    by_scale[9:] = R_Y @ t_P
    return value, by_pose, by_scale, turning


_NOTHING = np.zeros(0)


def check_pose(pose: object, what: str) -> None:
    """Refuse what is no gtsam.Pose3, or not finite."""
    if not isinstance(pose, gtsam.Pose3):
        raise TypeError(f"{what} is a {type(pose).__name__}; give a gtsam.Pose3")
    if not np.isfinite(pose.matrix()).all():
        raise ValueError(f"{what} has entries that are NaN or infinite; leave the measurement out:\n{pose.matrix()}")


def check_keys(keys: list[int]) -> list[int]:
    """Refuse a key that is there twice."""
    if len(set(keys)) != len(keys):
        raise ValueError(f"the keys {', '.join(map(name_of, keys))} are not all different; each variable has its own")
    return keys
