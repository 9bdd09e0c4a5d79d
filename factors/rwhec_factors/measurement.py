"""One measurement B = T_sensor_target as a factor: the prediction, the two residuals, and the Jacobians.

Every factor of one measurement predicts P = Y^-1 A X = T_sensor_target (true metres). The factors differ only in what
A depends on. P is compared with B, whose translation is scale times the true one:

- geodesic: Log(B^-1 S(P)), S(R, t) = (R, scale t); (6,), rotation (rad) first. It is the right perturbation of B that
  makes A X = Y B hold, so the factor takes any 6 x 6 covariance of B, in GTSAM's order.
- chordal: R_Y [vec(R_P - R_B), scale t_P - t_B]; (12,), columns of the rotation first. With isotropic noise its cost is
  the certified solution's (RWHEC paper, eq. 18).

Every factor raises a TypeError or ValueError that names the argument if A or B is not a valid pose, the factor cannot
hold the noise, two keys are equal, or a time offset has no twist.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from rwhec_factors import noise_models
from rwhec_factors.arguments import (
    check_choice,
    check_keys,
    check_pose,
    check_time_offset,
    checked_twists,
    number_of,
    pose_of,
)
from rwhec_factors.se3 import HATS, Array, hat

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


def robot_world_hand_eye_factor(
    target_key: int,
    sensor_key: int,
    A: gtsam.Pose3,
    B: gtsam.Pose3,
    noise: gtsam.noiseModel.Base,
    *,
    scale_key: int | None = None,
    residual: Residual = "geodesic",
    time_offset_key: int | None = None,
    twist: ArrayLike | None = None,
) -> gtsam.CustomFactor:
    """The factor of one measurement of a target by a sensor: A X = Y B.

    The residual, with P = Y^-1 A X and S(R, t) = (R, s t), where s is 1 without ``scale_key``::

        geodesic   Log(B^-1 S(P))                               (6,), rotation (rad) first, then translation (m)
        chordal    [vec(R_A R_X - R_Y R_B), s (R_A t_X + t_A - t_Y) - R_Y t_B]   (12,)

    The geodesic residual is the right perturbation of B that makes A X = Y B hold, so the factor takes any 6 x 6
    covariance of B, in GTSAM's order. The chordal residual is the certified cost's.

    Parameters
    ----------
    target_key : int
        Key of X = T_targetcarrier_target, a Pose3, true metres.
    sensor_key : int
        Key of Y = T_sensorcarrier_sensor, a Pose3, true metres.
    A : gtsam.Pose3
        T_sensorcarrier_targetcarrier, known; metres.
    B : gtsam.Pose3
        T_sensor_target, measured; metres (times the scale).
    noise : gtsam.noiseModel.Base
        Noise of B's right perturbation, dimension 6, rotation (rad) first, in measured lengths; robust models too. The
        chordal residual needs isotropic noise: Diagonal.Sigmas of [r, r, r, t, t, t], kappa = 1 / (2 r^2), sigma = t.
    scale_key : int, optional
        Key of a 1-vector s (``numpy.array([1.0])``; a float in Values cannot be pickled), the factor's last key:
        t_B = s * (true length).
    residual : "geodesic" or "chordal"
    time_offset_key : int, optional
        Key of a 1-vector d in seconds, the factor's third key: B's stamp t is the carriers' t + d, A(t + d) =
        A Expmap(d twist). Needs ``twist``.
    twist : (6,), optional
        The carriers' velocity at the stamp, [omega (rad/s), v (m/s)], in the target carrier's frame like A's right
        perturbations: Log(A(t)^-1 A(t + h)) / h for small h.
    """
    check_pose(A, "A")
    check_time_offset(time_offset_key, twist)
    velocity = np.zeros(6) if twist is None else checked_twists(twist, (6,))

    def carriers(values: gtsam.Values) -> tuple[gtsam.Pose3, CarrierJacobians]:
        if time_offset_key is None:
            return A, dict
        offset = number_of(values, time_offset_key, "the time offset in seconds")
        return A.compose(gtsam.Pose3.Expmap(offset * velocity)), lambda: {time_offset_key: velocity[:, None]}

    keys = [target_key, sensor_key] + ([] if time_offset_key is None else [time_offset_key])
    return measurement_factor(keys, target_key, sensor_key, carriers, B, noise, scale_key, residual)


Carrier = Literal["sensorcarrier_in_targetcarrier", "targetcarrier_in_sensorcarrier"]


def pose_robot_world_hand_eye_factor(
    pose_key: int,
    target_key: int,
    sensor_key: int,
    B: gtsam.Pose3,
    noise: gtsam.noiseModel.Base,
    *,
    scale_key: int | None = None,
    residual: Residual = "geodesic",
    pose: Carrier = "sensorcarrier_in_targetcarrier",
) -> gtsam.CustomFactor:
    """The factor of one measurement from a carrier whose pose P is a variable, such as a robot's in a SLAM graph.

    With ``pose="sensorcarrier_in_targetcarrier"`` (the default) P = T_targetcarrier_sensorcarrier, for instance
    T_world_robot: A = P^-1. With "targetcarrier_in_sensorcarrier" P = T_sensorcarrier_targetcarrier = A itself, for
    instance T_base_hand where the target is on the hand. The residual is ``robot_world_hand_eye_factor``'s with this A.

    Parameters
    ----------
    pose_key : int
        Key of P, a Pose3.
    target_key : int
        Key of X = T_targetcarrier_target, a Pose3.
    sensor_key : int
        Key of Y = T_sensorcarrier_sensor, a Pose3.
    B : gtsam.Pose3
        T_sensor_target, measured; metres (times the scale).
    noise : gtsam.noiseModel.Base
        Noise of B's right perturbation, dimension 6.
    scale_key : int, optional
        Key of a 1-vector s, the factor's last key: t_B = s * (true length).
    residual : "geodesic" or "chordal"
    pose : "sensorcarrier_in_targetcarrier" or "targetcarrier_in_sensorcarrier"
    """
    check_choice("pose", pose, Carrier)
    inverted = pose == "sensorcarrier_in_targetcarrier"
    what = "P = T_targetcarrier_sensorcarrier" if inverted else "P = T_sensorcarrier_targetcarrier"

    def carriers(values: gtsam.Values) -> tuple[gtsam.Pose3, CarrierJacobians]:
        P = pose_of(values, pose_key, what)
        # (P Expmap(d))^-1 = P^-1 Expmap(-Ad(P) d)
        if inverted:
            return P.inverse(), lambda: {pose_key: -P.AdjointMap()}
        return P, lambda: {pose_key: np.eye(6)}

    keys = [pose_key, target_key, sensor_key]
    return measurement_factor(keys, target_key, sensor_key, carriers, B, noise, scale_key, residual)


def two_pose_robot_world_hand_eye_factor(
    sensorcarrier_key: int,
    targetcarrier_key: int,
    target_key: int,
    sensor_key: int,
    B: gtsam.Pose3,
    noise: gtsam.noiseModel.Base,
    *,
    scale_key: int | None = None,
    residual: Residual = "geodesic",
) -> gtsam.CustomFactor:
    """The factor of one measurement where both carriers move: a robot's camera sees a tag on another robot.

    P_i = T_world_sensorcarrier and P_j = T_world_targetcarrier in one common frame: A = P_i^-1 P_j. The residual is
    ``robot_world_hand_eye_factor``'s with this A.

    Parameters
    ----------
    sensorcarrier_key, targetcarrier_key : int
        Keys of P_i and P_j, Pose3.
    target_key, sensor_key, B, noise, scale_key, residual
        As in ``pose_robot_world_hand_eye_factor``.
    """
    names = ("P_i = T_world_sensorcarrier", "P_j = T_world_targetcarrier")
    carriers = between(sensorcarrier_key, targetcarrier_key, names)
    keys = [sensorcarrier_key, targetcarrier_key, target_key, sensor_key]
    return measurement_factor(keys, target_key, sensor_key, carriers, B, noise, scale_key, residual)


def between(first_key: int, second_key: int, names: tuple[str, str]) -> Carriers:
    """A = P_i^-1 P_j of two pose variables; ``names`` describe them in errors."""

    def carriers(values: gtsam.Values) -> tuple[gtsam.Pose3, CarrierJacobians]:
        A = pose_of(values, first_key, names[0]).between(pose_of(values, second_key, names[1]))
        # (P_i Expmap(d))^-1 P_j = A Expmap(-Ad(A^-1) d)
        return A, lambda: {first_key: -A.inverse().AdjointMap(), second_key: np.eye(6)}

    return carriers


def hand_eye_factor(
    sensor_key: int,
    A: gtsam.Pose3,
    B: gtsam.Pose3,
    noise: gtsam.noiseModel.Base,
    *,
    scale_key: int | None = None,
    residual: Residual = "geodesic",
) -> gtsam.CustomFactor:
    """The factor of one motion, of the carrier and of the sensor between the same two instants: A Y = Y B.

    The residual, with P = Y^-1 A Y and S(R, t) = (R, s t)::

        geodesic   Log(B^-1 S(P))                                            (6,)
        chordal    [vec(R_A R_Y - R_Y R_B), s (R_A t_Y + t_A - t_Y) - R_Y t_B]   (12,)

    Parameters
    ----------
    sensor_key : int
        Key of Y = T_sensorcarrier_sensor (the X of AX = XB), a Pose3.
    A : gtsam.Pose3
        The carrier's motion, T_before_after; metres. From two of its poses: T_world_before^-1 T_world_after.
    B : gtsam.Pose3
        The sensor's motion, T_before_after; metres (times the scale).
    noise : gtsam.noiseModel.Base
        Noise of B's right perturbation, dimension 6.
    scale_key : int, optional
        Key of a 1-vector s, the factor's last key: t_B = s * (true length), as in a monocular odometry.
    residual : "geodesic" or "chordal"
    """
    check_pose(A, "A")
    return measurement_factor(
        [sensor_key], sensor_key, sensor_key, lambda values: (A, dict), B, noise, scale_key, residual
    )


def pose_hand_eye_factor(
    pose_before_key: int,
    pose_after_key: int,
    sensor_key: int,
    B: gtsam.Pose3,
    noise: gtsam.noiseModel.Base,
    *,
    scale_key: int | None = None,
    residual: Residual = "geodesic",
) -> gtsam.CustomFactor:
    """The factor of a sensor's motion between two poses of its carrier that are variables.

    P_i = T_world_carrier before and P_j after: A = P_i^-1 P_j. The residual is ``hand_eye_factor``'s with this A.

    Parameters
    ----------
    pose_before_key, pose_after_key : int
        Keys of P_i and P_j, Pose3.
    sensor_key, B, noise, scale_key, residual
        As in ``hand_eye_factor``.

    Raises
    ------
    TypeError, ValueError
        As in ``hand_eye_factor``.
    """
    carriers = between(pose_before_key, pose_after_key, ("P_i = T_world_carrier", "P_j = T_world_carrier"))
    keys = [pose_before_key, pose_after_key, sensor_key]
    return measurement_factor(keys, sensor_key, sensor_key, carriers, B, noise, scale_key, residual)
