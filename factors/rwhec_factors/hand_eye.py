"""AX = XB: a sensor's own motions against its carrier's, without a target. Here A Y = Y B."""

from __future__ import annotations

import gtsam
import numpy as np

from rwhec_factors.measurement import Prediction, Residual, check_pose, measurement_factor
from rwhec_factors.values import pose_of


def hand_eye_factor(
    sensor_key: int,
    A: gtsam.Pose3,
    B: gtsam.Pose3,
    noise: gtsam.noiseModel.Base,
    *,
    scale_key: int | None = None,
    residual: Residual = "geodesic",
) -> gtsam.CustomFactor:
    """One motion, of the carrier and of the sensor between the same two instants: A Y = Y B.

    Residual, with P = Y^-1 A Y and S(R, t) = (R, s t)::

        geodesic   Log(B^-1 S(P))                                            (6,)
        chordal    [vec(R_A R_Y - R_Y R_B), s (R_A t_Y + t_A - t_Y) - R_Y t_B]   (12,)

    Parameters
    ----------
    sensor_key : int
        Key of Y = T_carrier_sensor (the X of AX = XB), a Pose3.
    A : gtsam.Pose3
        The carrier's motion, T_before_after; metres. From two of its poses: T_world_before^-1 T_world_after.
    B : gtsam.Pose3
        The sensor's motion, T_before_after; metres (times the scale).
    noise : gtsam.noiseModel.Base
        Of B's right perturbation, dimension 6.
    scale_key : int, optional
        Key of a 1-vector s, the last key: t_B = s * (true length), as a monocular odometry's is.
    residual : "geodesic" or "chordal"

    Raises
    ------
    TypeError, ValueError
        For what is no pose or no noise model, noise that cannot be honoured, or keys that are not all different.
    """
    check_pose(A, "A")

    def predict(values: gtsam.Values, wanted: bool) -> Prediction:
        Y = pose_of(values, sensor_key, "Y = T_carrier_sensor")
        predicted = Y.inverse().compose(A.compose(Y))
        return Prediction(predicted, Y, [np.eye(6) - predicted.inverse().AdjointMap()] if wanted else [])

    return measurement_factor([sensor_key], sensor_key, B, noise, predict, scale_key, residual)


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
    """A sensor's motion between two poses of its carrier that are variables: odometry of a sensor off its frame.

    P_i = T_world_carrier before and P_j after: A = P_i^-1 P_j; the residual is that of ``hand_eye_factor`` at A.

    Parameters
    ----------
    pose_before_key, pose_after_key : int
        Keys of P_i and P_j, Pose3.
    sensor_key : int
        Key of Y = T_carrier_sensor, a Pose3.
    B, noise, scale_key, residual
        As in ``hand_eye_factor``.

    Raises
    ------
    TypeError, ValueError
        As there.
    """

    def predict(values: gtsam.Values, wanted: bool) -> Prediction:
        before = pose_of(values, pose_before_key, "P_i = T_world_carrier")
        after = pose_of(values, pose_after_key, "P_j = T_world_carrier")
        Y = pose_of(values, sensor_key, "Y = T_carrier_sensor")
        predicted = before.compose(Y).inverse().compose(after.compose(Y))
        if not wanted:
            return Prediction(predicted, Y, [])
        to_sensor = Y.inverse().AdjointMap()
        by_first_end = -predicted.inverse().AdjointMap()
        return Prediction(predicted, Y, [by_first_end @ to_sensor, to_sensor, np.eye(6) + by_first_end])

    keys = [pose_before_key, pose_after_key, sensor_key]
    return measurement_factor(keys, sensor_key, B, noise, predict, scale_key, residual)
