"""A X = Y B with the carriers' poses as variables of the user's own graph."""

from __future__ import annotations

from typing import Literal, get_args

import gtsam
import numpy as np

from rwhec_factors.measurement import Prediction, Residual, measurement_factor
from rwhec_factors.values import pose_of

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
    """One measurement of a target from a carrier whose pose P is a variable, as a robot's in a SLAM graph is.

    With ``pose="sensorcarrier_in_targetcarrier"`` (the default) P = T_targetcarrier_sensorcarrier, for instance
    T_world_robot: A = P^-1. With "targetcarrier_in_sensorcarrier" P = T_sensorcarrier_targetcarrier = A itself, for
    instance T_base_hand where the target is on the hand.

    Residual: that of ``robot_world_hand_eye_factor`` at A; with ``scale_key`` that of the scaled one.

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
        Of B's right perturbation, dimension 6.
    scale_key : int, optional
        Key of a 1-vector s, the last key: t_B = s * (true length).
    residual : "geodesic" or "chordal"
    pose : "sensorcarrier_in_targetcarrier" or "targetcarrier_in_sensorcarrier"

    Raises
    ------
    TypeError, ValueError
        For what is no pose or no noise model, noise that cannot be honoured, or keys that are not all different.
    """
    if pose not in get_args(Carrier):
        raise ValueError(f"pose={pose!r} is not one of {', '.join(map(repr, get_args(Carrier)))}")
    inverted = pose == "sensorcarrier_in_targetcarrier"
    what = "P = T_targetcarrier_sensorcarrier" if inverted else "P = T_sensorcarrier_targetcarrier"

    def predict(values: gtsam.Values, wanted: bool) -> Prediction:
        carrier = pose_of(values, pose_key, what)
        X = pose_of(values, target_key, "X = T_targetcarrier_target")
        Y = pose_of(values, sensor_key, "Y = T_sensorcarrier_sensor")
        if inverted:
            T_carrier_sensor = carrier.compose(Y)  # T_targetcarrier_sensor
            predicted = T_carrier_sensor.inverse().compose(X)
        else:
            predicted = Y.inverse().compose(carrier.compose(X))
        if not wanted:
            return Prediction(predicted, Y, [])
        by_sensor = -predicted.inverse().AdjointMap()
        # A Expmap(d) moves the prediction by Ad(X^-1) d; P = A^-1 moves it as Y does, seen from P.
        by_pose = by_sensor @ Y.inverse().AdjointMap() if inverted else X.inverse().AdjointMap()
        return Prediction(predicted, Y, [by_pose, np.eye(6), by_sensor])

    return measurement_factor([pose_key, target_key, sensor_key], sensor_key, B, noise, predict, scale_key, residual)


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
    """One measurement where both carriers move: a robot's camera that sees a tag on another robot.

    P_i = T_world_sensorcarrier and P_j = T_world_targetcarrier in one common frame: A = P_i^-1 P_j.

    Residual: that of ``robot_world_hand_eye_factor`` at A; with ``scale_key`` that of the scaled one.

    Parameters
    ----------
    sensorcarrier_key, targetcarrier_key : int
        Keys of P_i and P_j, Pose3.
    target_key, sensor_key : int
        Keys of X = T_targetcarrier_target and Y = T_sensorcarrier_sensor, Pose3.
    B, noise, scale_key, residual
        As in ``pose_robot_world_hand_eye_factor``.

    Raises
    ------
    TypeError, ValueError
        As there.
    """

    def predict(values: gtsam.Values, wanted: bool) -> Prediction:
        P_i = pose_of(values, sensorcarrier_key, "P_i = T_world_sensorcarrier")
        P_j = pose_of(values, targetcarrier_key, "P_j = T_world_targetcarrier")
        X = pose_of(values, target_key, "X = T_targetcarrier_target")
        Y = pose_of(values, sensor_key, "Y = T_sensorcarrier_sensor")
        predicted = P_i.compose(Y).inverse().compose(P_j.compose(X))
        if not wanted:
            return Prediction(predicted, Y, [])
        by_sensor = -predicted.inverse().AdjointMap()
        by_sensorcarrier = by_sensor @ Y.inverse().AdjointMap()
        return Prediction(predicted, Y, [by_sensorcarrier, X.inverse().AdjointMap(), np.eye(6), by_sensor])

    keys = [sensorcarrier_key, targetcarrier_key, target_key, sensor_key]
    return measurement_factor(keys, sensor_key, B, noise, predict, scale_key, residual)
