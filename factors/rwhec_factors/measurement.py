"""One measurement B = T_sensor_target as a factor: the prediction, the two residuals, and the Jacobians.

Every factor of one measurement predicts P = Y^-1 A X = T_sensor_target (true metres). The factors differ only in what
A depends on. P is compared with B, whose translation is scale times the true one:

- geodesic: Log(B^-1 S(P)), S(R, t) = (R, scale t); (6,), rotation (rad) first. It is the right perturbation of B that
  makes A X = Y B hold, so the factor takes any 6 x 6 covariance of B, in GTSAM's order.
- chordal: R_Y [vec(R_P - R_B), scale t_P - t_B]; (12,), columns of the rotation first. With isotropic noise its cost is
  the certified solution's (RWHEC paper, eq. 18).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import gtsam
import numpy as np

from rwhec_factors import noise_models
from rwhec_factors.arguments import check_choice, check_keys, check_pose
from rwhec_factors.se3 import HATS, Array, hat
from rwhec_factors.values import number_of, pose_of

Residual = Literal["geodesic", "chordal"]

#: This function gives the Jacobian (6, m) of A's right perturbation, by key.
CarrierJacobians = Callable[[], dict[int, Array]]
#: This function of the values gives A = T_sensorcarrier_targetcarrier and its Jacobians, which are computed on demand.
Carriers = Callable[[gtsam.Values], tuple[gtsam.Pose3, CarrierJacobians]]


def measurement_factor(
    keys: list[int],
    target_key: int,
    sensor_key: int,
    carriers: Carriers,
    B: gtsam.Pose3,
    noise: gtsam.noiseModel.Base,
    scale_key: int | None,
    residual: Residual,
) -> gtsam.CustomFactor:
    """The factor of one measurement.

    Parameters
    ----------
    keys : list of int
        The factor's keys in their order, the scale's left out: it is the last one.
    target_key, sensor_key : int
        Keys of X and Y. In A Y = Y B both are the key of Y.
    carriers : callable
        Gives A and its Jacobians.
    B : gtsam.Pose3
    noise : gtsam.noiseModel.Base
        Noise of B's right perturbation, dimension 6; robust models too.
    scale_key : int or None
        Key of a 1-vector s: t_B = s * (true length).
    residual : "geodesic" or "chordal"

    Raises
    ------
    TypeError, ValueError
        If B is not a valid pose, the factor cannot hold the noise, two keys are equal, or the residual is unknown.
    """
    check_pose(B, "B")
    check_choice("residual", residual, Residual)
    model = noise_models.checked(noise, 6, "B (its right perturbation)")
    if residual == "chordal":
        model = noise_models.chordal(model, "B")
    keys = [*keys, *([] if scale_key is None else [scale_key])]
    check_keys(keys)
    B_inverse, R_B, t_B = B.inverse(), B.rotation().matrix(), B.translation()

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Any] | None) -> Array:
        scale = 1.0 if scale_key is None else number_of(values, scale_key, "the scale (measured / true length)")
        A, by_carriers = carriers(values)
        Y = pose_of(values, sensor_key, "Y = T_sensorcarrier_sensor")
        X = Y if target_key == sensor_key else pose_of(values, target_key, "X = T_targetcarrier_target")
        P = Y.inverse().compose(A.compose(X))
        value: Array
        if residual == "geodesic":
            # Without a scale P itself: a new Pose3 takes three times as long as the rest of the residual.
            scaled = P if scale == 1.0 else gtsam.Pose3(P.rotation(), scale * P.translation())
            value = gtsam.Pose3.Logmap(B_inverse.compose(scaled))
        else:
            columns = np.column_stack([P.rotation().matrix() - R_B, scale * P.translation() - t_B])
            value = (Y.rotation().matrix() @ columns).ravel(order="F")
        if jacobians is None:
            return value
        derivatives = _by_geodesic if residual == "geodesic" else _by_chordal
        by_P, by_turning, by_scale = derivatives(value, P, Y.rotation().matrix(), scale)
        # X Expmap(d) moves P by d, Y Expmap(d) by -Ad(P^-1) d, A Expmap(d) by Ad(X^-1) d.
        by_A = by_P @ X.inverse().AdjointMap()
        blocks = {key: by_A @ block for key, block in by_carriers().items()}
        by_Y = by_turning - by_P @ P.inverse().AdjointMap()
        blocks |= {sensor_key: by_P + by_Y} if target_key == sensor_key else {target_key: by_P, sensor_key: by_Y}
        if scale_key is not None:
            blocks[scale_key] = by_scale[:, None]
        for i, key in enumerate(keys):
            jacobians[i] = np.asfortranarray(blocks[key])
        return value

    return gtsam.CustomFactor(model, keys, error)


def _by_geodesic(value: Array, P: gtsam.Pose3, R_Y: Array, scale: float) -> tuple[Array, Array, Array]:
    """Derivatives by P's right perturbation (6, 6), by R_Y with P held (none), and by the scale (6,)."""
    # Log(E Expmap(d)) = e + Jr^-1(e) d; S(P Expmap([w, v])) = S(P) Expmap([w, scale v]); dS/dscale is v = R' t.
    inverse_jacobian = gtsam.Pose3.LogmapDerivative(value)
    by_P = inverse_jacobian * np.r_[1.0, 1.0, 1.0, scale, scale, scale]
    return by_P, np.zeros((6, 6)), inverse_jacobian[:, 3:] @ P.rotation().unrotate(P.translation())


def _by_chordal(value: Array, P: gtsam.Pose3, R_Y: Array, scale: float) -> tuple[Array, Array, Array]:
    """Derivatives by P's right perturbation (12, 6), by R_Y with P held (12, 6), and by the scale (12,)."""
    R = R_Y @ P.rotation().matrix()  # R_A R_X
    by_P, by_turning, by_scale = np.zeros((12, 6)), np.zeros((12, 6)), np.zeros(12)
    by_P[:9, :3] = -(R @ HATS).reshape(9, 3)
    by_P[9:, 3:] = scale * R
    by_turning[:, :3] = (-R_Y @ hat(value.reshape(4, 3) @ R_Y)).reshape(12, 3)
    by_scale[9:] = R_Y @ P.translation()
    return by_P, by_turning, by_scale
