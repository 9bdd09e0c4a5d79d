"""A X = Y B with a known carrier pose A: the variables are the extrinsics, and optionally a scale and a time offset."""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from rwhec_factors.arguments import check_pose, check_time_offset, checked_twists
from rwhec_factors.measurement import CarrierJacobians, Residual, measurement_factor
from rwhec_factors.values import number_of


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

    Raises
    ------
    TypeError, ValueError
        If A or B is not a valid pose, the factor cannot hold the noise, two keys are equal, or an offset has no twist.
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
