"""A X = Y B with a known carrier pose A: extrinsics as the only variables, and with them a scale or a time offset."""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from rwhec_factors.measurement import Prediction, Residual, check_pose, measurement_factor
from rwhec_factors.se3 import Array
from rwhec_factors.values import number_of, pose_of


def robot_world_hand_eye_factor(
    target_key: int,
    sensor_key: int,
    A: gtsam.Pose3,
    B: gtsam.Pose3,
    noise: gtsam.noiseModel.Base,
    *,
    residual: Residual = "geodesic",
    time_offset_key: int | None = None,
    twist: ArrayLike | None = None,
) -> gtsam.CustomFactor:
    """Tie a target's and a sensor's extrinsics by one measurement: A X = Y B.

    Residual, with P = Y^-1 A X::

        geodesic   Log(B^-1 P)                                  (6,), rotation (rad) first, then translation (m)
        chordal    [vec(R_A R_X - R_Y R_B), R_A t_X + t_A - t_Y - R_Y t_B]   (12,)

    The geodesic one is what a right perturbation of B would have to be for A X = Y B to hold, so that any 6 x 6
    covariance of B, in GTSAM's order, is honoured as it is. The chordal one is that of the certified cost.

    Parameters
    ----------
    target_key : int
        Key of X = T_targetcarrier_target, a Pose3.
    sensor_key : int
        Key of Y = T_sensorcarrier_sensor, a Pose3.
    A : gtsam.Pose3
        T_sensorcarrier_targetcarrier, known; metres.
    B : gtsam.Pose3
        T_sensor_target, measured; metres.
    noise : gtsam.noiseModel.Base
        Of B's right perturbation, dimension 6, rotation (rad) first; robust ones too. For the chordal residual
        isotropic in each: Diagonal.Sigmas of [r, r, r, t, t, t] is kappa = 1 / (2 r^2), sigma = t.
    residual : "geodesic" or "chordal"
    time_offset_key : int, optional
        Key of a 1-vector d in seconds, the factor's third key: B's stamp t is the carriers' t + d, A(t + d) =
        A Expmap(d twist). Needs ``twist``.
    twist : (6,), optional
        The carriers' velocity at the stamp, [omega (rad/s), v (m/s)], in the target carrier's frame as A's right
        perturbations are: Log(A(t)^-1 A(t + h)) / h for small h.

    Raises
    ------
    TypeError
        For what is no pose or no noise model.
    ValueError
        For a noise model that cannot be honoured, keys that are not all different, an offset without a twist.
    """
    return _factor(target_key, sensor_key, None, A, B, noise, residual, time_offset_key, twist)


def scaled_robot_world_hand_eye_factor(
    target_key: int,
    sensor_key: int,
    scale_key: int,
    A: gtsam.Pose3,
    B: gtsam.Pose3,
    noise: gtsam.noiseModel.Base,
    *,
    residual: Residual = "geodesic",
    time_offset_key: int | None = None,
    twist: ArrayLike | None = None,
) -> gtsam.CustomFactor:
    """As ``robot_world_hand_eye_factor``, with B's translation measured to an unknown scale.

    Residual, with P = Y^-1 A X and S(R, t) = (R, s t)::

        geodesic   Log(B^-1 S(P))
        chordal    [vec(R_A R_X - R_Y R_B), s (R_A t_X + t_A - t_Y) - R_Y t_B]

    Parameters
    ----------
    target_key, sensor_key : int
        Keys of X and Y, Pose3, in true metres.
    scale_key : int
        Key of s, a 1-vector (``numpy.array([1.0])``; a float in Values cannot be pickled): t_B = s * (true length). The
        factor's last key.
    A, B, noise, residual, time_offset_key, twist
        As there; B and its noise in measured lengths.

    Raises
    ------
    TypeError, ValueError
        As there.
    """
    return _factor(target_key, sensor_key, scale_key, A, B, noise, residual, time_offset_key, twist)


def _factor(
    target_key: int,
    sensor_key: int,
    scale_key: int | None,
    A: gtsam.Pose3,
    B: gtsam.Pose3,
    noise: gtsam.noiseModel.Base,
    residual: Residual,
    time_offset_key: int | None,
    twist: ArrayLike | None,
) -> gtsam.CustomFactor:
    check_pose(A, "A")
    if (time_offset_key is None) != (twist is None):
        raise ValueError("a time offset needs both its key (time_offset_key=) and the carriers' twist (twist=)")
    velocity = None if twist is None else checked_twist(twist)

    def predict(values: gtsam.Values, wanted: bool) -> Prediction:
        X = pose_of(values, target_key, "X = T_targetcarrier_target")
        Y = pose_of(values, sensor_key, "Y = T_sensorcarrier_sensor")
        A_now = A
        if time_offset_key is not None and velocity is not None:
            offset = number_of(values, time_offset_key, "the time offset in seconds")
            A_now = A.compose(gtsam.Pose3.Expmap(offset * velocity))
        P = Y.inverse().compose(A_now.compose(X))
        if not wanted:
            return Prediction(P, Y, [])
        # X Expmap(d) moves P by d, Y Expmap(d) by -Ad(P^-1) d, A Expmap(d) by Ad(X^-1) d.
        jacobians = [np.eye(6), -P.inverse().AdjointMap()]
        if velocity is not None:
            jacobians.append((X.inverse().AdjointMap() @ velocity)[:, None])
        return Prediction(P, Y, jacobians)

    keys = [target_key, sensor_key] + ([] if time_offset_key is None else [time_offset_key])
    return measurement_factor(keys, sensor_key, B, noise, predict, scale_key, residual)


def checked_twist(twist: ArrayLike) -> Array:
    """Six finite numbers.

    Raises
    ------
    ValueError
        For anything else.
    """
    velocity = np.asarray(twist, dtype=np.float64)
    if velocity.shape != (6,) or not np.isfinite(velocity).all():
        raise ValueError(f"the twist is {velocity}; give six finite numbers, [omega (rad/s), v (m/s)]")
    return velocity
